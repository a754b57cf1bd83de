"""A sigma that follows the run's progress (`network.sigma_is=scheduled`), and not its gradients."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxpg.config.configuration import Config
from jaxpg.program.schedule import plan
from jaxpg.types import Algorithm, Metrics, TrainState


def left_alone() -> optax.GradientTransformation:
    """No step, for parameters that something else sets; the state is their number, which checkpoints have."""

    def init(params):
        return jnp.zeros((), jnp.int32)

    def update(updates, state, params=None):
        return jax.tree.map(jnp.zeros_like, updates), state + 1

    return optax.GradientTransformation(init, update)


def log_sigma(config: Config) -> optax.Schedule:
    """log sigma after some updates of the run: from the first value to the last in equal steps, and no further."""
    first, last = np.log(config.network.sigma), np.log(config.network.final_sigma)
    return optax.linear_schedule(first, last, plan(config).num_updates)


def with_sigma(algorithm: Algorithm, log_sigma: optax.Schedule) -> Algorithm:
    """The algorithm whose policy has log sigma = `log_sigma(n)` after n updates, whatever its gradients and its past.

    The optimizer does not do it: steps that it does not take, and updates that are left out, would hold it up.
    """

    def settled(state: TrainState) -> TrainState:
        value = log_sigma(state.update)
        set_sigma = lambda path, x: jnp.full_like(x, value) if _is_sigma(path) else x  # noqa: E731
        return state._replace(params=jax.tree_util.tree_map_with_path(set_sigma, state.params))

    def step(state: TrainState, key: jax.Array) -> tuple[TrainState, Metrics]:
        state, metrics = algorithm.step(settled(state), key)
        return settled(state), metrics

    return Algorithm(algorithm.init, step)


def _is_sigma(path: Any) -> bool:
    """Whether this is the place of a sigma that does not depend on the state, among the parameters."""
    return jax.tree_util.keystr(path).endswith("['log_std']")


def labels(params: Any) -> Any:
    """Which optimizer each parameter has, where sigma has one of its own."""

    def label(path, _):
        return "sigma" if _is_sigma(path) else path[0].key

    return jax.tree_util.tree_map_with_path(label, params)
