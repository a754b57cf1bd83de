"""Rules of the primitives that make arrays from their parameters alone."""

from __future__ import annotations

import jax
import numpy as np


def _iota(aval, *, dimension, shape, dtype, **_):
    counts = [1] * len(shape)
    counts[dimension] = shape[dimension]
    return np.broadcast_to(np.arange(shape[dimension], dtype=dtype).reshape(counts), shape)


def _empty(aval, **_):
    """An array that is written before it is read; zeros."""
    return np.zeros(aval.shape, aval.dtype)


def _platform_index(aval, *, platforms):
    """The index of the implementation for this platform; all compute the same."""
    here = next((i for i, names in enumerate(platforms) if names is None or jax.default_backend() in names), 0)
    return np.asarray(here, aval.dtype)


RULES = {"iota": _iota, "empty": _empty, "platform_index": _platform_index}
