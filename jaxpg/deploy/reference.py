"""The formula of a controller in numpy: what every written format, and JAX itself, is measured by."""

from __future__ import annotations

import itertools
import math

import numpy as np

from jaxpg.deploy.controller import FARTHEST, Controller
from jaxpg.features import BOUND, monomials

ROWS = 500  # computed at once: an observation may have ten thousand features


def commands(controller: Controller, obs: np.ndarray, dtype: type = np.float64, stretch: float = 1.0) -> np.ndarray:
    """`[N, n]` to `[N, m]`, every operation in this precision.

        command = limit * clip(squash(f(phi(z))), -1, 1),    z = (s - m) * scale

    and 0 where a |z_i| is not within `FARTHEST` or a number of the last layer is not finite.

    Args:
      controller: its numbers, float32.
      obs: s.
      dtype: of the arithmetic.
      stretch: z is multiplied by it: to see how much depends on its last digits.
    """
    parts = np.array_split(obs, max(len(obs) // ROWS, 1))
    return np.concatenate([_commands(controller, part, dtype, stretch) for part in parts])


def _commands(controller: Controller, obs: np.ndarray, dtype: type, stretch: float) -> np.ndarray:
    with np.errstate(all="ignore"):  # what is not finite is looked for at the end
        z = (obs.astype(dtype) - controller.mean.astype(dtype)) * controller.scale.astype(dtype) * dtype(stretch)
        x = FEATURES[controller.features](z, controller.order)
        for layer in controller.layers[:-1]:
            x = ACTIVATIONS[controller.activation](_affine(layer, x))
        action = _affine(controller.layers[-1], x)
        action = np.tanh(action) if controller.squash else action
        valid = np.all(np.abs(z) <= FARTHEST, axis=1) & np.all(np.isfinite(action), axis=1)
    limits = controller.interface.limits
    bounded = action if limits is None else np.array(limits, dtype) * np.clip(action, -1, 1)
    return np.where(valid[:, None], bounded, 0)


def units(controller: Controller, exact: np.ndarray) -> tuple[np.ndarray, str]:
    """What errors of each command are counted in, `[m]`, with its name.

    The limit; where there is none, 1 for a squashed action, which stays within it; else the largest of the commands.

    Args:
      controller: for its limits.
      exact: commands, `[N, m]`.
    """
    if controller.interface.limits is not None:
        return np.abs(np.array(controller.interface.limits, np.float64)), "the limit"
    if controller.squash:
        return np.ones(controller.action_size), "the action's bound, 1"
    return np.max(np.abs(exact), axis=0), "the largest command"


def largest_error(found: np.ndarray, exact: np.ndarray, unit: np.ndarray) -> float:
    """max |found - exact| / unit, over `[N, m]`; NaN if there is one. A unit of 0 allows no difference.

    >>> largest_error(np.array([[999.0]]), np.array([[1000.0]]), np.array([1000.0]))
    0.001
    """
    difference = np.abs(np.asarray(found, np.float64) - exact)
    apart = np.where(difference == 0, 0, np.inf)
    return float(np.max(np.divide(difference, unit, out=apart, where=np.broadcast_to(unit > 0, apart.shape))))


def rounding(controller: Controller, obs: np.ndarray, exact: np.ndarray) -> float:
    """How far float arithmetic moves the commands at most, in `units`: a measure of how steep the network is.

    The larger of two: the formula in float32, and the formula in float64 at z changed in the last digit of a float32.

    Args:
      controller, obs: as for `commands`.
      exact: commands in float64.
    """
    epsilon = float(np.finfo(np.float32).eps)
    moved = [commands(controller, obs, np.float32)]
    moved += [commands(controller, obs, stretch=1 + sign * epsilon) for sign in (-1, 1)]
    return max(largest_error(command, exact, units(controller, exact)[0]) for command in moved)


def _affine(layer, x: np.ndarray) -> np.ndarray:
    return x @ layer.weight.astype(x.dtype) + layer.bias.astype(x.dtype)


def _polynomial(z: np.ndarray, order: int) -> np.ndarray:
    return np.stack([math.prod(z[:, i] for i in c) for c in monomials(z.shape[1], order)], axis=1)


def _fourier(z: np.ndarray, order: int) -> np.ndarray:
    unit = (np.clip(z, -BOUND, BOUND) + z.dtype.type(BOUND)) / z.dtype.type(2 * BOUND)
    frequencies = np.array([*itertools.product(range(order + 1), repeat=z.shape[1])][1:], z.dtype)
    return np.cos(z.dtype.type(np.pi) * (unit @ frequencies.T))


def _radial(z: np.ndarray, order: int) -> np.ndarray:
    axis, width = np.linspace(-BOUND, BOUND, order, dtype=z.dtype), z.dtype.type(2 * BOUND / (order - 1))
    energy = -(((z[:, :, None] - axis) / width) ** 2) / 2
    bumps = np.exp(energy - energy.max(axis=2, keepdims=True))
    bumps /= bumps.sum(axis=2, keepdims=True)
    grid = np.array([*itertools.product(range(order), repeat=z.shape[1])])
    return math.prod(bumps[:, i, grid[:, i]] for i in range(z.shape[1]))


FEATURES = {
    "identity": lambda z, order: z,
    "polynomial": _polynomial,
    "fourier": _fourier,
    "radial": _radial,
}
ACTIVATIONS = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0),
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
    "swish": lambda x: x / (1 + np.exp(-x)),
}
