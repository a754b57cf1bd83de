"""Rules of the primitives that change only the shape or order of elements."""

from __future__ import annotations

import numpy as np

from envs.physics.arrays import promote
from envs.physics.primitives import UnsupportedPrimitiveError


def _copy(aval, x, **_):
    return x


def _broadcast_in_dim(aval, x, *, shape, broadcast_dimensions, **_):
    inner = [1] * len(shape)
    for size, dimension in zip(x.shape, broadcast_dimensions, strict=True):
        inner[dimension] = size
    return np.broadcast_to(x.reshape(inner), shape)


def _reshape(aval, x, **_):
    return x.reshape(aval.shape)


def _transpose(aval, x, *, permutation):
    return x.transpose(permutation)


def _rev(aval, x, *, dimensions):
    return np.flip(x, dimensions)


def _slice(aval, x, *, start_indices, limit_indices, strides):
    return x[tuple(map(slice, start_indices, limit_indices, strides or [None] * x.ndim))]


def _concatenate(aval, *arrays, dimension):
    return np.concatenate(promote(*arrays), dimension)


def _stack(aval, *arrays, axis):
    return np.stack(promote(*arrays), axis)


def _tile(aval, x, *, reps):
    return np.tile(x, reps)


def _split(aval, x, *, sizes, axis):
    return tuple(np.split(x, np.cumsum(sizes)[:-1], axis))


def _unstack(aval, x, *, axis):
    return tuple(np.moveaxis(x, axis, 0))


def _pad(aval, x, value, *, padding_config):
    if any(low < 0 or high < 0 for low, high, _ in padding_config):
        raise UnsupportedPrimitiveError("pad: negative padding")
    x, value = promote(x, value)
    result = np.full(aval.shape, value, x.dtype)
    inside = tuple(
        slice(low, low + (size - 1) * (inner + 1) + 1 if size else low, inner + 1)
        for size, (low, _, inner) in zip(x.shape, padding_config, strict=True)
    )
    result[inside] = x
    return result


RULES = {
    "copy": _copy,
    "optimization_barrier": _copy,
    "broadcast_in_dim": _broadcast_in_dim,
    "reshape": _reshape,
    "squeeze": _reshape,
    "transpose": _transpose,
    "rev": _rev,
    "slice": _slice,
    "concatenate": _concatenate,
    "stack": _stack,
    "tile": _tile,
    "split": _split,
    "unstack": _unstack,
    "pad": _pad,
}
