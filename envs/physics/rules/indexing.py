"""Rules of the primitives that read and write elements at computed indices.

An index that depends on the data becomes a select between all elements that it may mean.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence

import jax
import numpy as np

from envs.physics.arrays import Array, as_objects, choose_array, is_numeric, pack, promote
from envs.physics.expressions import Expression, Scalar, is_constant
from envs.physics.primitives import UnsupportedPrimitiveError, apply, select
from envs.physics.rules.elementwise import RULES as ELEMENTWISE

# An index that depends on the data may mean at most so many places; each costs a comparison and a select per element.
MOST_PLACES = 512

BOOL = np.dtype(bool)


def _read_window(x: Array, start: Sequence[Scalar], sizes, dtype) -> Array:
    """x[start : start + sizes], with the start clamped so that the window lies inside."""
    limits = np.subtract(x.shape, sizes)
    known = [index if is_constant(index) else None for index in start]
    x = x[
        tuple(
            slice(None) if index is None else slice(at := min(max(int(index), 0), limit), at + size)
            for index, limit, size in zip(known, limits, sizes, strict=True)
        )
    ]
    for axis, index in enumerate(start):
        if not is_constant(index):
            places = (range(at, at + sizes[axis]) for at in range(limits[axis] + 1))
            x = choose_array(index, [x.take(place, axis) for place in places], dtype)
    return x


def _write_window(
    x: Array, start: Sequence[Scalar], update: Array, combine: Callable[[Array, Array], Array], dtype
) -> None:
    """x[start : start + sizes] = combine(x[start : start + sizes], update), if the window lies inside."""
    limits = np.subtract(x.shape, update.shape)
    choices = [
        range(limit + 1) if isinstance(index, Expression) else [int(index)] if 0 <= index <= limit else []
        for index, limit in zip(start, limits, strict=True)
    ]
    for place in itertools.product(*choices):
        window = _window(x, place, update.shape)
        is_here = _equals(start, place)
        window[...] = _select_array(is_here, window, combine(window, update), dtype)


def _equals(start: Sequence[Scalar], place: Sequence[int]) -> Scalar:
    """Whether the index is this one."""
    tests = (apply("eq", index, at, dtype=BOOL) for index, at in zip(start, place, strict=True))
    return functools.reduce(functools.partial(apply, "and", dtype=BOOL), tests, True)


def _select_array(condition: Scalar, on_false: Array, on_true: Array, dtype) -> Array:
    """`on_true` if the condition is true, else `on_false`."""
    if is_constant(condition):
        return on_true if condition else on_false
    pairs = zip(as_objects(on_false).flat, as_objects(on_true).flat, strict=True)
    return pack([select(condition, *pair, dtype=np.dtype(dtype)) for pair in pairs], on_false.shape)


def _window(x: Array, start, sizes) -> Array:
    return x[tuple(slice(s, s + size) for s, size in zip(start, sizes, strict=True))]


def _clamp(start: Sequence[Scalar], limits) -> list[Scalar]:
    return [
        apply("clamp", 0, index, int(limit), dtype=index.dtype if isinstance(index, Expression) else np.dtype(int))
        for index, limit in zip(start, limits, strict=True)
    ]


def _is_outside(start: Sequence[Scalar], limits) -> Scalar:
    """Whether the index is outside of [0, limits]."""
    tests = (
        apply(op, index, bound, dtype=BOOL)
        for index, limit in zip(start, limits, strict=True)
        for op, bound in (("lt", 0), ("gt", int(limit)))
    )
    return functools.reduce(functools.partial(apply, "or", dtype=BOOL), tests, False)


def _check_cost(name: str, start: Sequence[Scalar], limits) -> None:
    """Raises UnsupportedPrimitiveError for an index that may mean too many places."""
    places = math.prod(int(limit) + 1 for index, limit in zip(start, limits, strict=True) if not is_constant(index))
    if places > MOST_PLACES:
        raise UnsupportedPrimitiveError(
            f"{name}: an index that depends on the data may mean {places} places, more than {MOST_PLACES}"
        )


# --- slices -----------------------------------------------------------------------------------------------------------


def _dynamic_slice(aval, x, *start, slice_sizes):
    indices = [index.item() for index in start]
    _check_cost("dynamic_slice", indices, np.subtract(x.shape, slice_sizes))
    return _read_window(x, indices, slice_sizes, aval.dtype)


def _dynamic_update_slice(aval, x, update, *start):
    limits = np.subtract(x.shape, update.shape)
    indices = [index.item() for index in start]
    _check_cost("dynamic_update_slice", indices, limits)
    return _write(x, update, [(_clamp(indices, limits), update)], lambda old, new: new, aval.dtype)


def _write(x: Array, updates: Array, writes: Sequence[tuple[Sequence[Scalar], Array]], combine, dtype) -> Array:
    """x after writing windows, each given by its index and update."""
    is_known = all(is_constant(index) for start, _ in writes for index in start)
    result = promote(x, updates)[0].copy() if is_known else as_objects(x).copy()
    for start, update in writes:
        _write_window(result, start, update, combine, dtype)
    return result


# --- gather and scatter -----------------------------------------------------------------------------------------------


def _gather(aval, x, indices, *, dimension_numbers, slice_sizes, mode, fill_value=None, **_):
    numbers = dimension_numbers
    dropped = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    limits = np.subtract(x.shape, slice_sizes)
    window_shape = [aval.shape[d] for d in numbers.offset_dims]
    result = np.empty((*indices.shape[:-1], *window_shape), x.dtype if is_numeric(indices) else object)
    for batch in np.ndindex(*indices.shape[:-1]):
        fixed = zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True)
        start = _full_index(x.ndim, indices[batch], numbers.start_index_map, {d: batch[at] for d, at in fixed})
        _check_cost("gather", start, limits)
        window = np.squeeze(_read_window(x, start, slice_sizes, aval.dtype), dropped)
        if "FILL" in str(mode):
            fill = fill_value if fill_value is not None else _out_of_bounds_value(aval.dtype)
            filled = np.full(window.shape, fill, aval.dtype)
            window = _select_array(_is_outside(start, limits), window, filled, aval.dtype)
        result[(*batch, ...)] = window
    batch_dims = [d for d in range(len(aval.shape)) if d not in numbers.offset_dims]
    return np.moveaxis(result, range(result.ndim), [*batch_dims, *numbers.offset_dims])


def _full_index(ndim: int, index: Array, axes: Sequence[int], fixed: dict[int, int]) -> list[Scalar]:
    """The index of a window in an array of `ndim` axes: `index` in `axes`, `fixed` in others, and 0 in the rest."""
    given = dict(zip(axes, as_objects(index), strict=True)) | fixed
    return [given.get(axis, 0) for axis in range(ndim)]


def _out_of_bounds_value(dtype):
    if dtype.kind in "fb":
        return np.nan if dtype.kind == "f" else True
    return np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max


def _scatter(aval, x, indices, updates, *, dimension_numbers, mode, update_jaxpr, **_):
    numbers = dimension_numbers
    window_dims = [d for d in range(x.ndim) if d not in (*numbers.inserted_window_dims, *numbers.operand_batching_dims)]
    sizes = np.ones(x.ndim, int)
    sizes[window_dims] = [updates.shape[d] for d in numbers.update_window_dims]
    batch_dims = [d for d in range(updates.ndim) if d not in numbers.update_window_dims]
    parts = updates.transpose([*batch_dims, *numbers.update_window_dims])
    limits = np.subtract(x.shape, sizes)
    writes = []
    for batch in np.ndindex(*indices.shape[:-1]):
        fixed = zip(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True)
        start = _full_index(
            x.ndim, indices[batch], numbers.scatter_dims_to_operand_dims, {d: batch[at] for d, at in fixed}
        )
        _check_cost("scatter", start, limits)
        start = _clamp(start, limits) if "CLIP" in str(mode) else start
        writes.append((start, parts[(*batch, ...)].reshape(sizes)))
    return _write(x, updates, writes, _combiner(update_jaxpr, aval.dtype), aval.dtype)


def _combiner(update_jaxpr, dtype) -> Callable[[Array, Array], Array]:
    """The function by which a scatter combines old and new elements: replacement, or one primitive."""
    if update_jaxpr is None or not update_jaxpr.eqns:
        return lambda old, new: new
    (equation,) = update_jaxpr.eqns
    rule = ELEMENTWISE[equation.primitive.name]
    return lambda old, new: rule(jax.ShapeDtypeStruct(old.shape, dtype), old, new)


RULES = {
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "gather": _gather,
    "scatter": _scatter,
    "scatter-add": _scatter,
    "scatter-sub": _scatter,
    "scatter-mul": _scatter,
    "scatter-min": _scatter,
    "scatter-max": _scatter,
}
