"""Arrays of scalar expressions.

An array is either numeric, if all its elements are known, or of dtype object, with an `Expression` or a Python number
for each element. Both move elements in the same way.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from envs.physics.expressions import Expression
from envs.physics.primitives import choose

Array = np.ndarray


def is_numeric(*arrays: Array) -> bool:
    """Whether all elements of all arrays are known."""
    return all(array.dtype != object for array in arrays)


def as_objects(x: Array) -> Array:
    """The array with dtype object, whose elements are Python numbers and expressions."""
    return x if x.dtype == object else x.astype(object)


def promote(*arrays: Array) -> tuple[Array, ...]:
    """The arrays unchanged if all are numeric; else all with dtype object, so that they can exchange elements.

    >>> [x.dtype.kind for x in promote(np.ones(2), np.ones(2, object))]
    ['O', 'O']
    """
    return arrays if is_numeric(*arrays) else tuple(map(as_objects, arrays))


def pack(elements: list, shape: tuple[int, ...]) -> Array:
    """An object array from its elements, in order."""
    array = np.empty(len(elements), object)
    array[:] = elements
    return array.reshape(shape)


def simplify_dtype(array: Array, dtype) -> Array:
    """The array, numeric if no element depends on the data."""
    array = np.asarray(array)
    if array.dtype == object and not any(isinstance(x, Expression) for x in array.flat):
        return array.astype(dtype)
    return array


def choose_array(index: Expression, cases: Sequence[Array], dtype) -> Array:
    """cases[index], with the index clamped to the valid range."""
    options = zip(*(as_objects(case).flat for case in cases), strict=True)
    return pack([choose(index, *option, dtype=np.dtype(dtype)) for option in options], cases[0].shape)


def find_dtype(array: Array) -> np.dtype:
    """The dtype of the elements, of which one is an expression if the array is not numeric."""
    return next(x.dtype for x in array.flat if isinstance(x, Expression)) if array.dtype == object else array.dtype
