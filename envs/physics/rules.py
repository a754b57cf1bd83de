"""One rule per jax primitive: what it does to arrays of scalar expressions.

A rule takes numpy arrays and the primitive's parameters, and gives the results as a tuple of numpy arrays. An array
is either numeric (all its elements are known) or of dtype object, with an `Expression` or a Python number in every
place. Most rules need not know which: moving elements about is the same for both, and object arrays do arithmetic
with the elements' operators.

Adding a primitive is adding one function here: `@rule("name")` above `def _(aval, x, y, *, parameter)`, where `aval`
has the shape and dtype of the (first) result. A primitive without a rule raises `UnsupportedPrimitive`.
"""

from __future__ import annotations

import functools
import itertools
import operator
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from envs.physics.expressions import NUMPY, Expression, apply, choose, fold, snap

Array = np.ndarray


class UnsupportedPrimitive(ValueError):
    """A primitive, or a use of one, that has no scalar form; the message begins with its name."""


RULES: dict[str, Callable[..., Any]] = {}


def rule(*names: str):
    """Enters a function into RULES under the primitives' names."""

    def enter(function):
        RULES.update(dict.fromkeys(names, function))
        return function

    return enter


def is_numeric(*arrays: Array) -> bool:
    return all(array.dtype != object for array in arrays)


def as_objects(x: Array) -> Array:
    """The same elements as Python numbers and expressions."""
    return x if x.dtype == object else x.astype(object)


# --- elementwise ------------------------------------------------------------------------------------------------------

# The parameters that change what an elementwise primitive computes; the others say how.
MEANINGFUL = {"round": ("rounding_method",), "integer_pow": ("y",), "convert_element_type": ("new_dtype",)}


def _elementwise(name: str):
    def elementwise(aval, *arrays, **params):
        params = tuple((key, _hashable(params[key])) for key in MEANINGFUL.get(name, ()))
        if is_numeric(*arrays):
            return fold(name, *arrays, dtype=aval.dtype, params=params)
        function = functools.partial(apply, name, dtype=np.dtype(aval.dtype), params=params)
        arrays = np.broadcast_arrays(*map(as_objects, arrays))
        elements = [function(*operands) for operands in zip(*(array.flat for array in arrays), strict=True)]
        return pack(elements, aval.shape)

    return elementwise


def _hashable(parameter):
    return int(parameter) if hasattr(parameter, "value") else parameter  # enumerations by their number


for _name in NUMPY:
    RULES[_name] = _elementwise(_name)


def pack(elements: list, shape: tuple[int, ...]) -> Array:
    """An object array from its elements in order."""
    array = np.empty(len(elements), object)
    array[:] = elements
    return array.reshape(shape)


def choose_array(index: Expression, cases: list[Array], aval) -> Array:
    """cases[index], the index clamped into the range."""
    options = zip(*(as_objects(case).flat for case in cases), strict=True)
    return pack([choose(index, *option, dtype=np.dtype(aval.dtype)) for option in options], aval.shape)


@rule("copy", "optimization_barrier")
def _(aval, x, **_):
    return x


# --- moving elements --------------------------------------------------------------------------------------------------


@rule("broadcast_in_dim")
def _(aval, x, *, shape, broadcast_dimensions, **_):
    inner = [1] * len(shape)
    for size, dimension in zip(x.shape, broadcast_dimensions, strict=True):
        inner[dimension] = size
    return np.broadcast_to(x.reshape(inner), shape)


@rule("reshape", "squeeze")
def _(aval, x, **_):
    return x.reshape(aval.shape)


@rule("transpose")
def _(aval, x, *, permutation):
    return x.transpose(permutation)


@rule("rev")
def _(aval, x, *, dimensions):
    return np.flip(x, dimensions)


@rule("slice")
def _(aval, x, *, start_indices, limit_indices, strides):
    return x[tuple(map(slice, start_indices, limit_indices, strides or [None] * x.ndim))]


@rule("concatenate")
def _(aval, *arrays, dimension):
    return np.concatenate(_alike(arrays), dimension)


@rule("stack")
def _(aval, *arrays, axis):
    return np.stack(_alike(arrays), axis)


@rule("tile")
def _(aval, x, *, reps):
    return np.tile(x, reps)


@rule("split")
def _(aval, x, *, sizes, axis):
    return tuple(np.split(x, np.cumsum(sizes)[:-1], axis))


@rule("unstack")
def _(aval, x, *, axis):
    return tuple(np.moveaxis(x, axis, 0))


@rule("pad")
def _(aval, x, value, *, padding_config):
    if any(low < 0 or high < 0 for low, high, _ in padding_config):
        raise UnsupportedPrimitive("pad: negative padding")
    x, value = _alike((x, value))
    result = np.full(aval.shape, value, x.dtype)
    inside = tuple(
        slice(low, low + (size - 1) * (inner + 1) + 1 if size else low, inner + 1)
        for size, (low, _, inner) in zip(x.shape, padding_config, strict=True)
    )
    result[inside] = x
    return result


@rule("iota")
def _(aval, *, dimension, shape, dtype, **_):
    along = [1] * len(shape)
    along[dimension] = shape[dimension]
    return np.broadcast_to(np.arange(shape[dimension], dtype=dtype).reshape(along), shape)


@rule("empty")
def _(aval, **_):
    """What nobody reads before it is written; zeros."""
    return np.zeros(aval.shape, aval.dtype)


def _alike(arrays):
    return arrays if is_numeric(*arrays) else tuple(map(as_objects, arrays))


@rule("platform_index")
def _(aval, *, platforms):
    """Which of the implementations for different platforms is the one for this one; they compute the same."""
    here = next((i for i, names in enumerate(platforms) if names is None or jax.default_backend() in names), 0)
    return np.asarray(here, aval.dtype)


@rule("dynamic_slice")
def _(aval, x, *start, slice_sizes):
    limits = np.subtract(x.shape, slice_sizes)
    axis, index = _traced_index("dynamic_slice", start)
    if axis is None:
        return _window(x, np.clip(np.array([int(s) for s in start], int), 0, limits), slice_sizes)
    known = [0 if i == axis else int(s) for i, s in enumerate(start)]
    windows = [
        _window(x, np.clip([*known[:axis], at, *known[axis + 1 :]], 0, limits), slice_sizes)
        for at in range(limits[axis] + 1)
    ]
    return choose_array(index, windows, aval)


@rule("dynamic_update_slice")
def _(aval, x, update, *start):
    if not is_numeric(*start):
        raise UnsupportedPrimitive("dynamic_update_slice: the place depends on the data")
    start = np.clip(np.array([int(s) for s in start], int), 0, np.subtract(x.shape, update.shape))
    x, update = _alike((x, update))
    result = x.copy()
    _window(result, start, update.shape)[...] = update
    return result


def _window(x: Array, start, sizes) -> Array:
    return x[tuple(slice(s, s + size) for s, size in zip(start, sizes, strict=True))]


def _traced_index(name: str, indices) -> tuple[int | None, Expression | None]:
    """The one index that is an expression, with its place; (None, None) if all are known."""
    traced = [(i, index.item()) for i, index in enumerate(indices) if isinstance(index.item(), Expression)]
    if len(traced) > 1:
        raise UnsupportedPrimitive(f"{name}: more than one index depends on the data")
    return traced[0] if traced else (None, None)


@rule("gather")
def _(aval, x, indices, *, dimension_numbers, slice_sizes, mode, fill_value=None, **_):
    numbers = dimension_numbers
    batch_shape = indices.shape[:-1]
    window_shape = [aval.shape[d] for d in numbers.offset_dims]
    dropped = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    limits = np.subtract(x.shape, slice_sizes)
    result = np.empty((*batch_shape, *window_shape), x.dtype)
    for batch in np.ndindex(*batch_shape):
        start = np.zeros(x.ndim, int)
        start[list(numbers.operand_batching_dims)] = [batch[d] for d in numbers.start_indices_batching_dims]
        traced = _traced_index("gather", [np.asarray(i, object) for i in indices[batch]])
        if traced[0] is not None:
            raise UnsupportedPrimitive("gather: an index depends on the data")
        start[list(numbers.start_index_map)] = indices[batch]
        outside = np.any((start < 0) | (start > limits))
        if outside and "FILL" in str(mode):
            result[(*batch, ...)] = fill_value if fill_value is not None else _out_of_bounds_value(aval.dtype)
        else:
            window = _window(x, np.clip(start, 0, limits), slice_sizes)
            result[(*batch, ...)] = np.squeeze(window, dropped)
    batch_dims = [d for d in range(len(aval.shape)) if d not in numbers.offset_dims]
    return np.moveaxis(result, range(result.ndim), [*batch_dims, *numbers.offset_dims])


def _out_of_bounds_value(dtype):
    return np.nan if np.issubdtype(dtype, np.floating) else np.iinfo(dtype).min


@rule("scatter", "scatter-add", "scatter-sub", "scatter-mul", "scatter-min", "scatter-max")
def _(aval, x, indices, updates, *, dimension_numbers, mode, update_jaxpr, **_):
    if not is_numeric(indices):
        raise UnsupportedPrimitive("scatter: an index depends on the data")
    numbers = dimension_numbers
    combine = _combiner(update_jaxpr)
    x, updates = _alike((x, updates))
    result = x.copy()
    kept = [d for d in range(x.ndim) if d not in (*numbers.inserted_window_dims, *numbers.operand_batching_dims)]
    sizes = np.ones(x.ndim, int)
    sizes[kept] = [updates.shape[d] for d in numbers.update_window_dims]
    batch_dims = [d for d in range(updates.ndim) if d not in numbers.update_window_dims]
    updates = updates.transpose([*batch_dims, *numbers.update_window_dims])
    limits = np.subtract(x.shape, sizes)
    for batch in np.ndindex(*indices.shape[:-1]):
        start = np.zeros(x.ndim, int)
        start[list(numbers.operand_batching_dims)] = [batch[d] for d in numbers.scatter_indices_batching_dims]
        start[list(numbers.scatter_dims_to_operand_dims)] = indices[batch]
        if np.any((start < 0) | (start > limits)):
            if "CLIP" not in str(mode):
                continue
            start = np.clip(start, 0, limits)
        window = _window(result, start, sizes)
        window[...] = combine(window, updates[(*batch, ...)].reshape(window.shape), aval)
    return result


def _combiner(update_jaxpr):
    """How a scatter joins what is there with what comes: it takes the place, or one primitive joins them."""
    if update_jaxpr is None or not update_jaxpr.eqns:
        return lambda old, new, aval: new
    (equation,) = update_jaxpr.eqns
    return lambda old, new, aval: RULES[equation.primitive.name](jax.ShapeDtypeStruct(old.shape, aval.dtype), old, new)


# --- reductions -------------------------------------------------------------------------------------------------------


def _reduction(name: str):
    """Folds the axes with a binary primitive, as a balanced tree: shorter chains and smaller rounding errors."""

    def reduce(aval, x, *, axes, **_):
        if is_numeric(x):
            return _NUMERIC_REDUCTIONS[name](x, tuple(axes)).astype(aval.dtype)
        rest = [d for d in range(x.ndim) if d not in axes]
        rows = x.transpose([*rest, *axes]).reshape(-1, int(np.prod([x.shape[d] for d in axes], dtype=int)))
        function = functools.partial(apply, name, dtype=np.dtype(aval.dtype))
        return pack([tree(function, list(row)) for row in rows], aval.shape)

    return reduce


_NUMERIC_REDUCTIONS = {
    "add": lambda x, axes: np.sum(x, axes),
    "mul": lambda x, axes: np.prod(x, axes),
    "max": lambda x, axes: np.max(x, axes),
    "min": lambda x, axes: np.min(x, axes),
    "and": lambda x, axes: np.all(x, axes) if x.dtype == bool else np.bitwise_and.reduce(x, axes),
    "or": lambda x, axes: np.any(x, axes) if x.dtype == bool else np.bitwise_or.reduce(x, axes),
}
_OF_NOTHING = {"add": 0, "mul": 1, "and": True, "or": False, "max": -np.inf, "min": np.inf}

for _name, _binary in {
    "reduce_sum": "add",
    "reduce_prod": "mul",
    "reduce_max": "max",
    "reduce_min": "min",
    "reduce_and": "and",
    "reduce_or": "or",
}.items():
    RULES[_name] = _reduction(_binary)


def tree(function: Callable, items: list):
    """function(function(a, b), function(c, d)), ... of at least one item."""
    while len(items) > 1:
        pairs = [function(*items[i : i + 2]) for i in range(0, len(items) - 1, 2)]
        items = pairs + items[len(items) - len(items) % 2 :]
    return items[0]


def _cumulative(name: str):
    def cumulate(aval, x, *, axis, reverse):
        function = functools.partial(apply, name, dtype=np.dtype(aval.dtype))
        lines = np.moveaxis(as_objects(x), axis, -1)
        lines = lines[..., ::-1] if reverse else lines
        result = np.empty(lines.shape, object)
        for place in np.ndindex(*lines.shape[:-1]):
            result[place] = list(itertools.accumulate(lines[place], function))
        result = np.moveaxis(result[..., ::-1] if reverse else result, -1, axis)
        return result.astype(aval.dtype) if is_numeric(x) else result

    return cumulate


for _name, _binary in {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}.items():
    RULES[_name] = _cumulative(_binary)


def _arg_extremum(better: str):
    def search(aval, x, *, axes, index_dtype, **_):
        (axis,) = axes
        lines = np.moveaxis(as_objects(x), axis, -1)
        places = np.ndindex(*lines.shape[:-1])
        return pack([_first_best(better, list(lines[place]), np.dtype(index_dtype)) for place in places], aval.shape)

    return search


def _first_best(better: str, items: list, index_dtype: np.dtype):
    """The place of the first extremum; of the first NaN if there is one."""
    dtype = next((item.dtype for item in items if isinstance(item, Expression)), np.dtype(float))
    truth = functools.partial(apply, dtype=np.dtype(bool))
    best, index = items[0], 0
    for i, item in enumerate(items[1:], start=1):
        first_nan = truth("and", truth("ne", item, item), truth("eq", best, best))
        found = truth("or", truth(better, item, best), first_nan)
        best = apply("select_n", found, best, item, dtype=dtype)
        index = apply("select_n", found, index, i, dtype=index_dtype)
    return index


RULES["argmin"], RULES["argmax"] = _arg_extremum("lt"), _arg_extremum("gt")


@rule("sort")
def _(aval, *arrays, dimension, num_keys, **_):
    if not is_numeric(*arrays):
        raise UnsupportedPrimitive("sort: the order depends on the data")
    order = np.lexsort(tuple(reversed(arrays[:num_keys])), axis=dimension)
    return tuple(np.take_along_axis(array, order, dimension) for array in arrays)


# --- linear algebra ---------------------------------------------------------------------------------------------------


@rule("dot_general")
def _(aval, x, y, *, dimension_numbers, **_):
    (contract_x, contract_y), (batch_x, batch_y) = dimension_numbers
    free_x = [d for d in range(x.ndim) if d not in (*contract_x, *batch_x)]
    free_y = [d for d in range(y.ndim) if d not in (*contract_y, *batch_y)]
    shape = [x.shape[d] for d in batch_x], [x.shape[d] for d in free_x], [y.shape[d] for d in free_y]
    inner = int(np.prod([x.shape[d] for d in contract_x], dtype=int))
    batch, rows, columns = (int(np.prod(sizes, dtype=int)) for sizes in shape)
    x = x.transpose([*batch_x, *free_x, *contract_x]).reshape(batch, rows, inner)
    y = y.transpose([*batch_y, *free_y, *contract_y]).reshape(batch, columns, inner)
    if is_numeric(x, y):
        result = np.einsum("brk,bck->brc", x, y).astype(aval.dtype)
        if aval.dtype.kind == "f":
            result = snap(result, np.einsum("brk,bck->brc", np.abs(x), np.abs(y)))
        return result.reshape(aval.shape)
    x, y = as_objects(x), as_objects(y)
    zero = aval.dtype.type(0).item()
    elements = [
        tree(operator.add, list(map(operator.mul, x[b, r], y[b, c]))) if inner else zero
        for b in range(batch)
        for r in range(rows)
        for c in range(columns)
    ]
    return pack(elements, aval.shape)


@rule("cholesky")
def _(aval, x, **_):
    """L with L L' = x, row by row: L_ij = (x_ij - sum_k L_ik L_jk) / L_jj, L_ii = sqrt(x_ii - sum_k L_ik^2)."""
    result = np.full(x.shape, 0.0, object)
    x, size = as_objects(x), x.shape[-1]
    for batch in np.ndindex(*x.shape[:-2]):
        lower = result[batch]
        for i, j in zip(*np.tril_indices(size), strict=True):
            rest = x[batch][i, j] - sum(lower[i, :j] * lower[j, :j])
            lower[i, j] = (
                apply("sqrt", rest, dtype=aval.dtype) if i == j else apply("div", rest, lower[j, j], dtype=aval.dtype)
            )
    return result


@rule("triangular_solve")
def _(aval, a, b, *, left_side, lower, transpose_a, unit_diagonal, **_):
    """x with a x = b (or x a = b) by substitution, from the end of `a` where one unknown stands alone."""
    a, b = as_objects(a), as_objects(b)
    if transpose_a:
        a, lower = a.swapaxes(-1, -2), not lower
    if not left_side:
        a, b, lower = a.swapaxes(-1, -2), b.swapaxes(-1, -2), not lower
    result = np.empty(b.shape, object)
    size = a.shape[-1]
    for *batch, column in np.ndindex(*b.shape[:-2], b.shape[-1]):
        matrix, x = a[tuple(batch)], result[(*batch, slice(None), column)]
        for i in range(size) if lower else reversed(range(size)):
            done = slice(0, i) if lower else slice(i + 1, size)
            rest = b[(*batch, i, column)] - sum(matrix[i, done] * x[done])
            x[i] = rest if unit_diagonal else apply("div", rest, matrix[i, i], dtype=aval.dtype)
    return result if left_side else result.swapaxes(-1, -2)
