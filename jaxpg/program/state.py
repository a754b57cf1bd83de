"""What a run keeps: the training state and the best policy of each agent."""

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
    """What acting needs.

    Attributes:
      params: `{"actor": ..., "critic": ...}`.
      normalizer: statistics of the observations.
    """

    params: PyTree
    normalizer: RunningStatistics


class Best(NamedTuple):
    """The best policy of each agent, by its mean evaluation return.

    Attributes:
      policy: leaves `[S, ...]`.
      episode_return: `[S]`; -inf before the first evaluation.
    """

    policy: Policy
    episode_return: jax.Array


class RunState(NamedTuple):
    """What a checkpoint holds; all leaves have the agents as leading axis, `[S, ...]`."""

    train: TrainState
    best: Best


def start(train: TrainState) -> RunState:
    """The state before anything has been evaluated; also of shapes alone, under `jax.eval_shape`."""
    return RunState(train, Best(current_policy(train), jnp.full(train.update.shape, -jnp.inf)))


def current_policy(train: TrainState) -> Policy:
    """The policy as it is after the updates made so far."""
    return Policy(train.params, train.normalizer)


def is_key(leaf: Any) -> bool:
    """Whether an array holds random keys, which numpy does not know."""
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def better(old: Best, new: Best) -> Best:
    """Agent by agent the policy with the higher return; of equals the old one, and a NaN is not higher.

    Computed by numpy: jax would compile a program for every shape, at the first evaluation of each run.
    """
    improved = np.asarray(new.episode_return) > np.asarray(old.episode_return)

    def choose(old_leaf: jax.Array, new_leaf: jax.Array) -> np.ndarray:
        a, b = np.asarray(old_leaf), np.asarray(new_leaf)
        return np.where(improved.reshape(improved.shape + (1,) * (a.ndim - 1)), a, b)

    return jax.tree.map(choose, new, old)


def initial_run(algorithm: Algorithm, seed: jax.Array) -> RunState:
    """One agent's run before its first update."""
    return start(initial_state(algorithm, jax.random.key(seed)))


def state_shape(algorithm: Algorithm, num_agents: int) -> RunState:
    """Shapes and types of a run's state, `[S, ...]`."""
    one = jax.eval_shape(functools.partial(initial_run, algorithm), np.uint32(0))
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((num_agents, *x.shape), x.dtype), one)
