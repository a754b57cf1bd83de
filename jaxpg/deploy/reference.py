"""The formula of a controller in numpy: the reference for every exported format and for JAX itself."""

from __future__ import annotations

import functools
import itertools
import math

import numpy as np

from jaxpg.deploy.controller import MAX_DEVIATION, Controller
from jaxpg.features import BOUND, monomials

ROWS = 500  # per batch: an observation may have ten thousand features


def compute_commands(
    controller: Controller, obs: np.ndarray, dtype: type = np.float64, stretch: float = 1.0
) -> np.ndarray:
    """The commands `[N, m]` for observations `[N, n]`, with every operation in `dtype`.

        command = limit * clip(squash(f(phi(z))), -1, 1),    z = (s - m) * scale

    and 0 where some |z_i| exceeds `MAX_DEVIATION` or an output of the last layer is not finite.

    Args:
      controller: the controller, in float32.
      obs: observations s.
      dtype: precision of the arithmetic.
      stretch: factor on z, to measure the sensitivity to its last digits.
    """
    parts = np.array_split(obs, max(len(obs) // ROWS, 1))
    return np.concatenate([_compute_rows(controller, part, dtype, stretch) for part in parts])


def _compute_rows(controller: Controller, obs: np.ndarray, dtype: type, stretch: float) -> np.ndarray:
    with np.errstate(all="ignore"):  # non-finite values are handled at the end
        z = (obs.astype(dtype) - controller.mean.astype(dtype)) * controller.scale.astype(dtype) * dtype(stretch)
        x = FEATURES[controller.features](z, controller.order)
        for layer in controller.layers[:-1]:
            x = ACTIVATIONS[controller.activation](_apply_layer(layer, x))
        action = _apply_layer(controller.layers[-1], x)
        action = np.tanh(action) if controller.squash else action
        valid = np.all(np.abs(z) <= MAX_DEVIATION, axis=1) & np.all(np.isfinite(action), axis=1)
    limits = controller.interface.limits
    bounded = action if limits is None else np.array(limits, dtype) * np.clip(action, -1, 1)
    return np.where(valid[:, None], bounded, 0)


def error_units(controller: Controller, exact: np.ndarray) -> tuple[np.ndarray, str]:
    """The unit of each command's error, `[m]`, and its name.

    The limit if there is one; otherwise 1 for a squashed action, else the largest command.

    Args:
      controller: has the limits.
      exact: commands, `[N, m]`.
    """
    if controller.interface.limits is not None:
        return np.abs(np.array(controller.interface.limits, np.float64)), "the limit"
    if controller.squash:
        return np.ones(controller.action_size), "the action's bound, 1"
    return np.max(np.abs(exact), axis=0), "the largest command"


def largest_error(commands: np.ndarray, exact: np.ndarray, unit: np.ndarray) -> float:
    """max |commands - exact| / unit over `[N, m]`; NaN if any is. With unit 0 any difference is infinite.

    >>> largest_error(np.array([[999.0]]), np.array([[1000.0]]), np.array([1000.0]))
    0.001
    """
    difference = np.abs(np.asarray(commands, np.float64) - exact)
    error = np.where(difference == 0, 0, np.inf)
    return float(np.max(np.divide(difference, unit, out=error, where=np.broadcast_to(unit > 0, error.shape))))


def rounding_error(controller: Controller, obs: np.ndarray, exact: np.ndarray) -> float:
    """The largest rounding error of the commands, in `error_units`: it measures how steep the network is.

    The larger of two errors: of the formula in float32, and of the formula in float64 with z changed by one float32
    epsilon.

    Args:
      controller, obs: as in `compute_commands`.
      exact: commands in float64.
    """
    epsilon = float(np.finfo(np.float32).eps)
    perturbed = [compute_commands(controller, obs, np.float32)]
    perturbed += [compute_commands(controller, obs, stretch=1 + sign * epsilon) for sign in (-1, 1)]
    return max(largest_error(command, exact, error_units(controller, exact)[0]) for command in perturbed)


def _apply_layer(layer, x: np.ndarray) -> np.ndarray:
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
    return functools.reduce(np.multiply, (bumps[:, i, grid[:, i]] for i in range(z.shape[1])))


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
