"""The state of a run: the training state and the best policy of each agent."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxpg.normalization import RunningStatistics
from jaxpg.training import initial_state
from jaxpg.types import Algorithm, PyTree, TrainState


class Policy(NamedTuple):
    """The part of the state that acting needs.

    Attributes:
      params: `{"actor": ..., "critic": ...}`.
      normalizer: statistics of the observations.
    """

    params: PyTree
    normalizer: RunningStatistics


class Best(NamedTuple):
    """The best policy of each agent, by its mean evaluation return.

    Attributes:
      policy: the policies, leaves `[S, ...]`.
      episode_return: their returns, `[S]`; -inf before the first evaluation.
    """

    policy: Policy
    episode_return: jax.Array


class RunState(NamedTuple):
    """The content of a checkpoint; all leaves have a leading axis of agents, `[S, ...]`."""

    train: TrainState
    best: Best


def start(train: TrainState) -> RunState:
    """The state before the first evaluation."""
    return RunState(train, Best(get_policy(train), jnp.full(train.update.shape, -jnp.inf)))


def get_policy(train: TrainState) -> Policy:
    """The policy as it is after the updates made so far."""
    return Policy(train.params, train.normalizer)


def is_key(leaf: Any) -> bool:
    """Whether an array holds random keys, which numpy does not support."""
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def choose_better(old: Best, new: Best) -> Best:
    """For each agent the policy with the higher return; the old one if they are equal or the new one is NaN.

    Computed with numpy, as jax would compile a program for every shape at the first evaluation of each run.
    """
    improved = np.asarray(new.episode_return) > np.asarray(old.episode_return)

    def choose(old_leaf: jax.Array, new_leaf: jax.Array) -> np.ndarray:
        a, b = np.asarray(old_leaf), np.asarray(new_leaf)
        return np.where(improved.reshape(improved.shape + (1,) * (a.ndim - 1)), a, b)

    return jax.tree.map(choose, new, old)


def make_initial_run(algorithm: Algorithm, seed: jax.Array) -> RunState:
    """The state of one agent's run before its first update."""
    return start(initial_state(algorithm, jax.random.key(seed)))


def make_state_shape(algorithm: Algorithm, num_agents: int) -> RunState:
    """The shapes and types of a run's state, `[S, ...]`."""
    one = jax.eval_shape(functools.partial(make_initial_run, algorithm), np.uint32(0))
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((num_agents, *x.shape), x.dtype), one)
