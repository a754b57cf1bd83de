"""Rules of the primitives that reduce or accumulate along axes: sums, products, extrema."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable

import numpy as np

from envs.physics.arrays import as_objects, is_numeric, pack
from envs.physics.primitives import apply

NUMERIC = {
    "add": np.sum,
    "mul": np.prod,
    "max": np.max,
    "min": np.min,
    "and": lambda x, axes: np.all(x, axes) if x.dtype == bool else np.bitwise_and.reduce(x, axes),
    "or": lambda x, axes: np.any(x, axes) if x.dtype == bool else np.bitwise_or.reduce(x, axes),
}


def _reduce(name: str, aval, x, *, axes, **_):
    """Reduces the axes by a binary primitive."""
    if is_numeric(x) or not x.size:  # the latter also of symbols: there are none
        numbers = x if is_numeric(x) else x.astype(aval.dtype)
        return np.asarray(NUMERIC[name](numbers, tuple(axes))).astype(aval.dtype)
    rest = [d for d in range(x.ndim) if d not in axes]
    rows = x.transpose([*rest, *axes]).reshape(-1, int(np.prod([x.shape[d] for d in axes], dtype=int)))
    combine = functools.partial(apply, name, dtype=np.dtype(aval.dtype))
    return pack([reduce_pairwise(combine, list(row)) for row in rows], aval.shape)


def reduce_pairwise(combine: Callable, items: list):
    """Combines one or more items as a balanced tree, for shorter chains and smaller rounding errors.

    >>> reduce_pairwise("({} {})".format, ["a", "b", "c", "d", "e"])
    '(((a b) (c d)) e)'
    """
    while len(items) > 1:
        pairs = [combine(*items[i : i + 2]) for i in range(0, len(items) - 1, 2)]
        items = pairs + items[len(items) - len(items) % 2 :]
    return items[0]


def _accumulate(name: str, aval, x, *, axis, reverse):
    """Combines each element along an axis with all before it."""
    combine = functools.partial(apply, name, dtype=np.dtype(aval.dtype))
    lines = np.moveaxis(as_objects(x), axis, -1)
    lines = lines[..., ::-1] if reverse else lines
    result = np.empty(lines.shape, object)
    for place in np.ndindex(*lines.shape[:-1]):
        result[place] = list(itertools.accumulate(lines[place], combine))
    result = np.moveaxis(result[..., ::-1] if reverse else result, -1, axis)
    return result.astype(aval.dtype) if is_numeric(x) else result


RULES = {
    "reduce_sum": functools.partial(_reduce, "add"),
    "reduce_prod": functools.partial(_reduce, "mul"),
    "reduce_max": functools.partial(_reduce, "max"),
    "reduce_min": functools.partial(_reduce, "min"),
    "reduce_and": functools.partial(_reduce, "and"),
    "reduce_or": functools.partial(_reduce, "or"),
    "cumsum": functools.partial(_accumulate, "add"),
    "cumprod": functools.partial(_accumulate, "mul"),
    "cummax": functools.partial(_accumulate, "max"),
    "cummin": functools.partial(_accumulate, "min"),
}
