"""Shared data types with their shapes: T steps, N environments, time first."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax

PyTree = Any
Metrics = dict[str, jax.Array]


class Env(Protocol):
    """What the library needs of an environment: brax's functions and sizes, its states as `vector_env` reads them."""

    @property
    def observation_size(self) -> int: ...
    @property
    def action_size(self) -> int: ...
    def reset(self, rng: jax.Array, /) -> Any: ...
    def step(self, state: Any, action: jax.Array, /) -> Any: ...


class Transition(NamedTuple):
    """T steps of N environments.

    Attributes:
      obs: s_t, `[T, N, observation_size]`.
      u: u_t, the sample of the policy's Gaussian, `[T, N, action_size]`, from which the action was made.
      reward: r_t, `[T, N]`.
      terminated: 1.0 if the step ended in a terminal state, whose value is 0, `[T, N]`.
      truncated: 1.0 if a time limit cut the episode after the step, `[T, N]`; never together with `terminated`.
      next_obs: the true s_{t+1}, before any reset, `[T, N, observation_size]`.
      episode_end: 1.0 if the step ended an episode that was played from its first step, `[T, N]`.
      episode_return: the undiscounted return of that episode, 0 if there is none, `[T, N]`.
      diverged: 1.0 if the physics diverged (`jaxpg.divergence`), `[T, N]`; the step then terminates with reward 0, and
        its next observation is the one before it.
    """

    obs: jax.Array
    u: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    next_obs: jax.Array
    episode_end: jax.Array
    episode_return: jax.Array
    diverged: jax.Array

    @property
    def ended(self) -> jax.Array:
        """Whether the step ended an episode, `[T, N]` of bool."""
        return (self.terminated + self.truncated) > 0


class TrainState(NamedTuple):
    """Everything that the next update needs; a checkpoint contains all of it.

    Attributes:
      params: the networks' parameters, `{"actor": ..., "critic": ...}`.
      opt_state: the optimizer's state.
      normalizer: running statistics of the observations.
      env_state: the N environments.
      update: number of updates made, int32 scalar.
    """

    params: PyTree
    opt_state: PyTree
    normalizer: PyTree
    env_state: PyTree
    update: jax.Array


class Algorithm(NamedTuple):
    """A learning algorithm as a pair of pure functions.

    Attributes:
      init: `init(key) -> TrainState`.
      step: `step(state, key) -> (state, metrics)`, one update; metrics are scalars by name.
    """

    init: Callable[[jax.Array], TrainState]
    step: Callable[[TrainState, jax.Array], tuple[TrainState, Metrics]]
