"""Rules of the elementwise primitives."""

from __future__ import annotations

import functools

import numpy as np

from envs.physics.arrays import Array, as_objects, is_numeric, pack
from envs.physics.folding import NUMPY, fold
from envs.physics.primitives import apply

# The parameters that change the result of a primitive.
MEANINGFUL = {"round": ("rounding_method",), "integer_pow": ("y",), "convert_element_type": ("new_dtype",)}


def _map_elements(name: str, aval, /, *arrays: Array, **params) -> Array:
    """Applies a primitive to arrays, element by element; scalars are broadcast."""
    params = tuple((key, _hashable(params[key])) for key in MEANINGFUL.get(name, ()))
    if is_numeric(*arrays):
        return fold(name, *arrays, dtype=aval.dtype, params=params)
    arrays = np.broadcast_arrays(*map(as_objects, arrays))
    operands = zip(*(array.flat for array in arrays), strict=True)
    return pack([apply(name, *row, dtype=np.dtype(aval.dtype), params=params) for row in operands], aval.shape)


def _hashable(parameter):
    return int(parameter) if hasattr(parameter, "value") else parameter  # enumerations by their number


# `add_any` is the sum of cotangents.
RULES = {name: functools.partial(_map_elements, name) for name in NUMPY} | {
    "add_any": functools.partial(_map_elements, "add")
}
