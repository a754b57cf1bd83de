"""A sigma that follows a schedule and no gradients (`network.sigma_is=scheduled`)."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxpg.config.configuration import Config
from jaxpg.program.schedule import plan
from jaxpg.types import Algorithm, Metrics, TrainState


def keep_params() -> optax.GradientTransformation:
    """Makes no updates, for parameters that are set elsewhere; the state counts steps, and is in checkpoints."""

    def init(params):
        return jnp.zeros((), jnp.int32)

    def update(updates, state, params=None):
        return jax.tree.map(jnp.zeros_like, updates), state + 1

    return optax.GradientTransformation(init, update)


def make_sigma_schedule(config: Config) -> optax.Schedule:
    """log sigma as a function of the updates made: linear from the initial to the final value, then constant."""
    first, last = np.log(config.network.sigma), np.log(config.network.final_sigma)
    return optax.linear_schedule(first, last, plan(config).num_updates)


def schedule_sigma(algorithm: Algorithm, log_sigma: optax.Schedule) -> Algorithm:
    """Sets log sigma of the policy to `log_sigma(n)` after n updates, whatever its gradients and history.

    The optimizer does not do this, as steps and updates that are skipped would delay the schedule.
    """

    def set_sigma(state: TrainState) -> TrainState:
        value = log_sigma(state.update)
        replace = lambda path, x: jnp.full_like(x, value) if _is_sigma(path) else x  # noqa: E731
        return state._replace(params=jax.tree_util.tree_map_with_path(replace, state.params))

    def step(state: TrainState, key: jax.Array) -> tuple[TrainState, Metrics]:
        state, metrics = algorithm.step(set_sigma(state), key)
        return set_sigma(state), metrics

    return Algorithm(algorithm.init, step)


def _is_sigma(path: Any) -> bool:
    """Whether the parameter at this path is a sigma that does not depend on the state."""
    return jax.tree_util.keystr(path).endswith("['log_std']")


def label_params(params: Any) -> Any:
    """The name of each parameter's optimizer; sigma has its own."""

    def label(path, _):
        return "sigma" if _is_sigma(path) else path[0].key

    return jax.tree_util.tree_map_with_path(label, params)
