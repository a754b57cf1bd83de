"""Evaluates a deterministic policy: complete episodes from fixed starts, as one scan."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxpg.divergence import has_diverged
from jaxpg.shapes import select
from jaxpg.types import Env, Metrics


class Episodes(NamedTuple):
    """N complete episodes.

    Attributes:
      episode_return: undiscounted return, `[N]`; up to the divergence if the physics diverged.
      length: steps until termination, divergence or the time limit, `[N]`.
      metrics: the environment's metrics, the last finite ones of each episode, `[N]` by name.
      diverged: whether the physics diverged (`jaxpg.divergence`), `[N]` of bool.
    """

    episode_return: jax.Array
    length: jax.Array
    metrics: Metrics
    diverged: jax.Array


class Step(NamedTuple):
    """One step of N episodes; after an episode's end its state stays as it is.

    Attributes:
      before, after: brax's States; `after` is `before` if the physics diverged.
      action: `[N, m]`.
      reward: `[N]`; 0 if the physics diverged, and after the end.
      metrics: as in `Episodes`, up to this step.
      alive: whether the step belongs to the episode, `[N]` of bool.
    """

    before: Any
    after: Any
    action: jax.Array
    reward: jax.Array
    metrics: Metrics
    alive: jax.Array


def evaluate(env: Env, policy: Callable[[jax.Array], jax.Array], keys: jax.Array, episode_length: int) -> Episodes:
    """Plays one complete episode from each of N starts.

        R_i = sum_{t < T_i} r_{i,t},    a_t = policy(s_t)

    Args:
      env: environment with brax's interface.
      policy: `policy(obs[N, ...]) -> action[N, m]` in [-1, 1].
      keys: random keys, `[N]`; the same key gives the same start.
      episode_length: the time limit.

    Returns:
      `Episodes`; numbers after a termination are ignored, whatever they are.
    """
    return play(env, policy, keys, episode_length, lambda step: None)[0]


def play(
    env: Env,
    policy: Callable[[jax.Array], jax.Array],
    keys: jax.Array,
    episode_length: int,
    look: Callable[[Step], Any],
) -> tuple[Episodes, Any]:
    """`evaluate` that also records each step.

    Args:
      env, policy, keys, episode_length: as in `evaluate`.
      look: `look(step)`, what to record of a `Step`: a tree of arrays `[N, ...]`.

    Returns:
      The episodes, and the records, with leaves `[T, N, ...]`.
    """

    def step(carry, _):
        state, alive, episodes = carry
        action = policy(state.obs)
        after = jax.vmap(env.step)(state, action)
        diverged = alive & jax.vmap(has_diverged)(state, after)
        counts = alive & ~diverged
        after = select(counts, after, state)
        reward = jnp.where(counts, after.reward, 0.0)
        episodes = Episodes(
            episode_return=episodes.episode_return + reward,
            length=episodes.length + alive,
            metrics={name: _choose_finite(after.metrics[name], last) for name, last in episodes.metrics.items()},
            diverged=episodes.diverged | diverged,
        )
        record = look(Step(state, after, action, reward, episodes.metrics, alive))
        return (after, counts & (after.done == 0), episodes), record

    state = jax.vmap(env.reset)(keys)
    zeros = jnp.zeros_like(state.reward)
    alive = zeros == 0
    episodes = Episodes(zeros, zeros.astype(jnp.int32), state.metrics, ~alive)
    (_, _, episodes), records = jax.lax.scan(step, (state, alive, episodes), length=episode_length)
    return episodes, records


def _choose_finite(value: jax.Array, last: jax.Array) -> jax.Array:
    """The value if it is finite, else the last one."""
    return jnp.where(jnp.isfinite(value), value, last)
