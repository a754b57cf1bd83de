"""Numbers of a model: numpy constants where they are known when tracing, else what the caller hands in."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

if TYPE_CHECKING:
    import mujoco
    from mujoco import mjx

SMALL = 1e-15  # mjMINVAL


def get_number(model: mujoco.MjModel, mx: mjx.Model, name: str) -> Any:
    """A field of the model, as a float64 numpy array where `mx` has MjModel's value, else as it is in `mx`.

    >>> get_number(model, mx, "opt.timestep")  # doctest: +SKIP
    0.002
    """
    ours, given = model, mx
    for part in name.split("."):
        ours, given = getattr(ours, part), getattr(given, part, None)
    if given is None:
        return np.array(ours)
    if is_traced(given):
        return given
    given = np.asarray(given)
    same = np.array_equal(given, np.reshape(np.asarray(ours, given.dtype), given.shape))
    return np.reshape(ours, given.shape).copy() if same else given


def is_traced(*values: Any) -> bool:
    """Whether one of the values is an argument of the function that is traced, or depends on one."""
    return any(isinstance(value, Tracer) for value in values)


def is_zero(value: Any) -> bool:
    """Whether the value is known to be 0 everywhere when tracing."""
    return not is_traced(value) and not np.any(np.asarray(value))


def module_of(*values: Any):
    """`jax.numpy` if one of the values is traced, else `numpy`: operations on constants need not be traced."""
    return jnp if is_traced(*values) else np


def snap(value: Any) -> Any:
    """Constants within rounding of 0, 1 or -1 exactly so, that products with them cost nothing."""
    if is_traced(value):
        return value
    nearest = np.round(value)
    return np.where((np.abs(value - nearest) < 4 * np.finfo(float).eps) & (np.abs(nearest) <= 1), nearest, value)


def at_least_small(value: Any) -> Any:
    """A divisor: the value, or a very small number where it is smaller."""
    return module_of(value).maximum(value, SMALL)
