"""Rules of the primitives that read and write elements at computed indices."""

from __future__ import annotations

import jax
import numpy as np

from envs.physics.arrays import Array, choose_array, is_numeric, promote
from envs.physics.expressions import Expression
from envs.physics.primitives import UnsupportedPrimitiveError
from envs.physics.rules.elementwise import RULES as ELEMENTWISE


def _dynamic_slice(aval, x, *start, slice_sizes):
    limits = np.subtract(x.shape, slice_sizes)
    traced = _traced_index("dynamic_slice", start)
    if traced is None:
        return _window(x, np.clip(np.array([int(s) for s in start], int), 0, limits), slice_sizes)
    axis, index = traced
    known = [0 if i == axis else int(s) for i, s in enumerate(start)]
    windows = [
        _window(x, np.clip([*known[:axis], at, *known[axis + 1 :]], 0, limits), slice_sizes)
        for at in range(limits[axis] + 1)
    ]
    return choose_array(index, windows, aval)


def _dynamic_update_slice(aval, x, update, *start):
    if not is_numeric(*start):
        raise UnsupportedPrimitiveError("dynamic_update_slice: the index depends on the data")
    start = np.clip(np.array([int(s) for s in start], int), 0, np.subtract(x.shape, update.shape))
    x, update = promote(x, update)
    result = x.copy()
    _window(result, start, update.shape)[...] = update
    return result


def _window(x: Array, start, sizes) -> Array:
    return x[tuple(slice(s, s + size) for s, size in zip(start, sizes, strict=True))]


def _traced_index(name: str, indices) -> tuple[int, Expression] | None:
    """(position, index) of the one index that is an expression; None if all are known."""
    traced = [(i, index.item()) for i, index in enumerate(indices) if isinstance(index.item(), Expression)]
    if len(traced) > 1:
        raise UnsupportedPrimitiveError(f"{name}: more than one index depends on the data")
    return traced[0] if traced else None


def _gather(aval, x, indices, *, dimension_numbers, slice_sizes, mode, fill_value=None, **_):
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
        if traced is not None:
            raise UnsupportedPrimitiveError("gather: an index depends on the data")
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


def _scatter(aval, x, indices, updates, *, dimension_numbers, mode, update_jaxpr, **_):
    if not is_numeric(indices):
        raise UnsupportedPrimitiveError("scatter: an index depends on the data")
    numbers = dimension_numbers
    combine = _combiner(update_jaxpr)
    x, updates = promote(x, updates)
    result = x.copy()
    window_dims = [d for d in range(x.ndim) if d not in (*numbers.inserted_window_dims, *numbers.operand_batching_dims)]
    sizes = np.ones(x.ndim, int)
    sizes[window_dims] = [updates.shape[d] for d in numbers.update_window_dims]
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
    """The function by which a scatter combines old and new elements: replacement, or one primitive."""
    if update_jaxpr is None or not update_jaxpr.eqns:
        return lambda old, new, aval: new
    (equation,) = update_jaxpr.eqns
    rule = ELEMENTWISE[equation.primitive.name]
    return lambda old, new, aval: rule(jax.ShapeDtypeStruct(old.shape, aval.dtype), old, new)


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
