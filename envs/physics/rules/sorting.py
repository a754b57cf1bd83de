"""Rules of the primitives that depend on the order of the elements along an axis."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator

import numpy as np

from envs.physics.arrays import as_objects, find_dtype, is_numeric, pack
from envs.physics.expressions import Expression, Scalar
from envs.physics.primitives import UnsupportedPrimitiveError, apply

# A sorting network of n elements has about n (log2 n)^2 / 4 exchanges: 543 for 64.
MOST_SORTED = 64

NUMBER = np.dtype(np.int32)

_test = functools.partial(apply, dtype=np.dtype(bool))


def _find_extremum(better: str, aval, x, *, axes, index_dtype, **_):
    """The index of the extremum along one axis; `better` is "lt" or "gt"."""
    (axis,) = axes
    lines = np.moveaxis(as_objects(x), axis, -1)
    places = np.ndindex(*lines.shape[:-1])
    return pack([_first_best(better, list(lines[place]), np.dtype(index_dtype)) for place in places], aval.shape)


def _first_best(better: str, items: list, index_dtype: np.dtype):
    """The index of the first extremum, or of the first NaN if there is one."""
    dtype = next((item.dtype for item in items if isinstance(item, Expression)), np.dtype(float))
    best, index = items[0], 0
    for i, item in enumerate(items[1:], start=1):
        first_nan = _test("and", _test("ne", item, item), _test("eq", best, best))
        is_better = _test("or", _test(better, item, best), first_nan)
        best = apply("select_n", is_better, best, item, dtype=dtype)
        index = apply("select_n", is_better, index, i, dtype=index_dtype)
    return index


def _sort(aval, *arrays, dimension, num_keys, **_):
    if is_numeric(*arrays):
        order = np.lexsort(tuple(reversed(arrays[:num_keys])), axis=dimension)
        return tuple(np.take_along_axis(array, order, dimension) for array in arrays)
    return _sort_along("sort", arrays, dimension, num_keys, is_descending=False)


def _top_k(aval, x, *, k, axis=-1, **_):
    numbers = np.arange(x.shape[axis], dtype=NUMBER)
    indices = np.moveaxis(np.broadcast_to(numbers, np.moveaxis(x, axis, -1).shape), -1, axis)
    arrays = _sort_along("top_k", (x, indices), axis, 1, is_descending=True)
    return tuple(np.take(array, range(k), axis) for array in arrays)


def _sort_along(name: str, arrays, axis: int, num_keys: int, *, is_descending: bool) -> tuple:
    """The arrays, each line along the axis in the order of the first `num_keys`; equal ones keep their order."""
    lines = [np.moveaxis(as_objects(array), axis, -1).copy() for array in arrays]
    size = lines[0].shape[-1]
    if size > MOST_SORTED and not is_numeric(*arrays):
        raise UnsupportedPrimitiveError(
            f"{name}: {size} elements, more than {MOST_SORTED}, whose order depends on the data"
        )
    dtypes = [*map(find_dtype, arrays), NUMBER]
    has_values = len(arrays) > num_keys  # which rows with equal keys must not exchange
    precedes = functools.partial(_precedes, num_keys=num_keys, is_descending=is_descending, is_stable=has_values)
    for place in np.ndindex(*lines[0].shape[:-1]):
        rows = _sort_rows(list(zip(*(line[place] for line in lines), strict=True)), dtypes, precedes)
        for line, column in zip(lines, zip(*rows, strict=True), strict=False):
            line[place] = column
    return tuple(np.moveaxis(line, -1, axis) for line in lines)


def _sort_rows(rows: list[tuple], dtypes: list[np.dtype], precedes: Callable[[tuple, tuple], Scalar]) -> list[tuple]:
    """The rows in order, each with its number at the end."""
    rows = [(*row, number) for number, row in enumerate(rows)]
    for i, j in list_exchanges(len(rows)):
        exchange = precedes(rows[j], rows[i])
        pairs = list(zip(rows[i], rows[j], dtypes, strict=True))
        rows[i] = tuple(apply("select_n", exchange, x, y, dtype=dtype) for x, y, dtype in pairs)
        rows[j] = tuple(apply("select_n", exchange, y, x, dtype=dtype) for x, y, dtype in pairs)
    return rows


def list_exchanges(size: int) -> Iterator[tuple[int, int]]:
    """The places to compare and exchange, in order, of Batcher's odd-even merge sort.

    >>> list(list_exchanges(4))
    [(0, 1), (2, 3), (0, 2), (1, 3), (1, 2)]
    """
    sorted_size = 1  # of the runs that are merged next
    while sorted_size < size:
        distance = sorted_size
        while distance:
            for begin in range(distance % sorted_size, size - distance, 2 * distance):
                for i in range(begin, min(begin + distance, size - distance)):
                    if i // (2 * sorted_size) == (i + distance) // (2 * sorted_size):
                        yield i, i + distance
            distance //= 2
        sorted_size *= 2


def _precedes(x: tuple, y: tuple, *, num_keys: int, is_descending: bool, is_stable: bool) -> Scalar:
    """Whether row x comes before row y: by the first key in which they differ, then by number."""
    result = _test("lt", x[-1], y[-1]) if is_stable else False
    for pair in reversed(list(zip(x[:num_keys], y[:num_keys], strict=True))):
        a, b = reversed(pair) if is_descending else pair
        not_after = _test("not", _is_less(b, a))
        result = not_after if result is True else _test("or", _is_less(a, b), _test("and", not_after, result))
    return result


def _is_less(x: Scalar, y: Scalar) -> Scalar:
    """Whether x < y, where a NaN is greater than all numbers."""
    return _test("or", _test("lt", x, y), _test("and", _test("ne", y, y), _test("eq", x, x)))


RULES = {
    "argmin": functools.partial(_find_extremum, "lt"),
    "argmax": functools.partial(_find_extremum, "gt"),
    "sort": _sort,
    "top_k": _top_k,
}
