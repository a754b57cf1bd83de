"""How good a deterministic policy is: complete episodes from fixed starts, in one scan for all who play them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxpg.divergence import diverged
from jaxpg.shapes import select
from jaxpg.types import Env, Metrics


class Episodes(NamedTuple):
    """N complete episodes.

    Attributes:
      episode_return: undiscounted, `[N]`.
      length: steps until termination, divergence or the time limit, `[N]`.
      metrics: the environment's metrics, the last of each episode that were finite, `[N]` by name.
      diverged: whether the physics did (`jaxpg.divergence`), `[N]` of bool; what was earned before it is the return.
    """

    episode_return: jax.Array
    length: jax.Array
    metrics: Metrics
    diverged: jax.Array


class Step(NamedTuple):
    """One step of N episodes; after an episode's end its state stays as it is.

    Attributes:
      before, after: brax's States; `after` is `before` where the physics diverged.
      action: `[N, m]`.
      reward: `[N]`; 0 where the physics diverged, and after the end.
      metrics: those of `Episodes`, so far.
      alive: whether the step is one of the episode, `[N]` of bool.
    """

    before: Any
    after: Any
    action: jax.Array
    reward: jax.Array
    metrics: Metrics
    alive: jax.Array


def evaluate(env: Env, policy: Callable[[jax.Array], jax.Array], keys: jax.Array, episode_length: int) -> Episodes:
    """Plays an episode from each of N starts, once, to its end.

        R_i = sum_{t < T_i} r_{i,t},    a_t = policy(s_t)

    Args:
      env: brax-shaped environment.
      policy: `policy(obs[N, ...]) -> action[N, m]` in [-1, 1].
      keys: fix the starts, `[N]`: the same key gives the same one.
      episode_length: the time limit.

    Returns:
      `Episodes`; steps after a termination count for nothing, whatever their numbers are.
    """
    return play(env, policy, keys, episode_length, lambda step: None)[0]


def play(
    env: Env,
    policy: Callable[[jax.Array], jax.Array],
    keys: jax.Array,
    episode_length: int,
    look: Callable[[Step], Any],
) -> tuple[Episodes, Any]:
    """`evaluate`, and what is seen of each step.

    Args:
      env, policy, keys, episode_length: as there.
      look: what is kept of a `Step`, a tree of arrays `[N, ...]`.

    Returns:
      The episodes, and what was seen, leaves `[T, N, ...]`.
    """

    def step(carry, _):
        state, alive, episodes = carry
        action = policy(state.obs)
        after = jax.vmap(env.step)(state, action)
        exploded = alive & jax.vmap(diverged)(state, after)
        counted = alive & ~exploded
        after = select(counted, after, state)
        reward = jnp.where(counted, after.reward, 0.0)
        episodes = Episodes(
            episode_return=episodes.episode_return + reward,
            length=episodes.length + alive,
            metrics={name: _newest(after.metrics[name], last) for name, last in episodes.metrics.items()},
            diverged=episodes.diverged | exploded,
        )
        seen = look(Step(state, after, action, reward, episodes.metrics, alive))
        return (after, counted & (after.done == 0), episodes), seen

    state = jax.vmap(env.reset)(keys)
    nothing = jnp.zeros_like(state.reward)
    alive = nothing == 0
    episodes = Episodes(nothing, nothing.astype(jnp.int32), state.metrics, ~alive)
    (_, _, episodes), seen = jax.lax.scan(step, (state, alive, episodes), length=episode_length)
    return episodes, seen


def _newest(value: jax.Array, last: jax.Array) -> jax.Array:
    """The value where it is finite, and else the last that was."""
    return jnp.where(jnp.isfinite(value), value, last)
