"""How good a deterministic policy is: complete episodes from fixed starts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxpg.types import Metrics


class Episodes(NamedTuple):
    """N complete episodes.

    Attributes:
      episode_return: undiscounted, `[N]`.
      length: steps until termination or the time limit, `[N]`.
      metrics: the environment's metrics at the last step of each episode, `[N]` by name.
    """

    episode_return: jax.Array
    length: jax.Array
    metrics: Metrics


def evaluate(env: Any, policy: Callable[[jax.Array], jax.Array], keys: jax.Array, episode_length: int) -> Episodes:
    """Plays an episode from each of N starts, once, to its end.

        R_i = sum_{t < T_i} r_{i,t},    a_t = policy(s_t)

    Args:
      env: brax-shaped environment.
      policy: `policy(obs[N, ...]) -> action[N, m]` in [-1, 1].
      keys: fix the starts, `[N]`: the same key gives the same one.
      episode_length: the time limit.

    Returns:
      `Episodes`; steps after a termination count for nothing.
    """

    def step(carry, _):
        state, alive, episodes = carry
        state = jax.vmap(env.step)(state, policy(state.obs))
        episodes = Episodes(
            episode_return=episodes.episode_return + alive * state.reward,
            length=episodes.length + alive.astype(jnp.int32),
            metrics={name: jnp.where(alive > 0, state.metrics[name], last) for name, last in episodes.metrics.items()},
        )
        return (state, alive * (1 - state.done), episodes), None

    state = jax.vmap(env.reset)(keys)
    zeros = jnp.zeros_like(state.reward)
    episodes = Episodes(zeros, zeros.astype(jnp.int32), state.metrics)
    (_, _, episodes), _ = jax.lax.scan(step, (state, zeros + 1, episodes), length=episode_length)
    return episodes
