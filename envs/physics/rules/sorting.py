"""Rules of the primitives that depend on the order of the elements along an axis."""

from __future__ import annotations

import functools

import numpy as np

from envs.physics.arrays import as_objects, is_numeric, pack
from envs.physics.expressions import Expression
from envs.physics.primitives import UnsupportedPrimitiveError, apply


def _find_extremum(better: str, aval, x, *, axes, index_dtype, **_):
    """The index of the extremum along one axis; `better` is "lt" or "gt"."""
    (axis,) = axes
    lines = np.moveaxis(as_objects(x), axis, -1)
    places = np.ndindex(*lines.shape[:-1])
    return pack([_first_best(better, list(lines[place]), np.dtype(index_dtype)) for place in places], aval.shape)


def _first_best(better: str, items: list, index_dtype: np.dtype):
    """The index of the first extremum, or of the first NaN if there is one."""
    dtype = next((item.dtype for item in items if isinstance(item, Expression)), np.dtype(float))
    test = functools.partial(apply, dtype=np.dtype(bool))
    best, index = items[0], 0
    for i, item in enumerate(items[1:], start=1):
        first_nan = test("and", test("ne", item, item), test("eq", best, best))
        is_better = test("or", test(better, item, best), first_nan)
        best = apply("select_n", is_better, best, item, dtype=dtype)
        index = apply("select_n", is_better, index, i, dtype=index_dtype)
    return index


def _sort(aval, *arrays, dimension, num_keys, **_):
    if not is_numeric(*arrays):
        raise UnsupportedPrimitiveError("sort: the order depends on the data")
    order = np.lexsort(tuple(reversed(arrays[:num_keys])), axis=dimension)
    return tuple(np.take_along_axis(array, order, dimension) for array in arrays)


RULES = {
    "argmin": functools.partial(_find_extremum, "lt"),
    "argmax": functools.partial(_find_extremum, "gt"),
    "sort": _sort,
}
