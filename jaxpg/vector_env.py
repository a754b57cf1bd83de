"""Many environments side by side: time limit, resets, and the true next observation.

The environment is any object with brax's `reset(key) -> State` and `step(State, action) -> State`. Its `done` means
termination; the time limit is added here, as truncation. An environment that ended is reset at once with a fresh draw,
and the observation from *before* the reset is handed out as s_{t+1}, for the bootstrap.

A physics that diverges, as stiff models do at long time steps, ends the episode of its environment and no other's; what
that is, `jaxpg.divergence` says.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxpg import collectives
from jaxpg.divergence import diverged
from jaxpg.shapes import select
from jaxpg.types import Env, Metrics, Transition


class VectorState(NamedTuple):
    """N running episodes.

    Attributes:
      env: the environment's own State, every leaf with a leading axis `[N, ...]`.
      time: steps since the last reset, `[N]` int32.
      episode_return: undiscounted return since the last reset, `[N]`.
      whole: 1.0 where the episode is played from its first step, `[N]`; see `stagger`.
    """

    env: Any
    time: jax.Array
    episode_return: jax.Array
    whole: jax.Array

    @property
    def obs(self) -> jax.Array:
        """s_t, `[N, observation_size]`."""
        return self.env.obs


class Outcome(NamedTuple):
    """What one step of all environments brought; fields as in `jaxpg.types.Transition`, without the time axis."""

    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    next_obs: jax.Array
    episode_end: jax.Array
    episode_return: jax.Array
    diverged: jax.Array


class VectorEnv(NamedTuple):
    """N environments as two pure functions.

    Attributes:
      reset: `reset(key) -> VectorState`.
      step: `step(state, action[N, m], key) -> (state, Outcome)`; actions in [-1, 1].
      observation_size, action_size, num_envs, episode_length: sizes.
    """

    reset: Callable[[jax.Array], VectorState]
    step: Callable[[VectorState, jax.Array, jax.Array], tuple[VectorState, Outcome]]
    observation_size: int
    action_size: int
    num_envs: int
    episode_length: int


def vectorize(env: Env, num_envs: int, episode_length: int) -> VectorEnv:
    """`num_envs` copies of `env`, each ended after `episode_length` steps at the latest and then reset.

    Args:
      env: brax-shaped environment with an array as observation.
      num_envs: N, at least 1.
      episode_length: steps until the time limit, at least 1.
    """

    def reset(key):
        state = jax.vmap(env.reset)(jax.random.split(key, num_envs))
        zeros = jnp.zeros_like(state.reward)
        return VectorState(state, zeros.astype(jnp.int32), episode_return=zeros, whole=zeros + 1)

    def step(state, action, key):
        env_state = jax.vmap(env.step)(state.env, action)
        exploded = jax.vmap(diverged)(state.env, env_state)
        reward = jnp.where(exploded, 0.0, env_state.reward)
        next_obs = select(exploded, state.obs, env_state.obs)
        time = state.time + 1
        episode_return = state.episode_return + reward
        terminated = jnp.where(exploded, 1, env_state.done).astype(reward.dtype)
        truncated = (time >= episode_length) * (1 - terminated)
        done = (terminated + truncated) > 0
        episode_end = done * state.whole
        outcome = Outcome(
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            next_obs=next_obs,
            episode_end=episode_end,
            episode_return=episode_end * episode_return,
            diverged=exploded.astype(reward.dtype),
        )
        running = VectorState(env_state, time, episode_return, state.whole)
        # Drawing and observing new states costs as much as a step in some environments: only where one has ended.
        return jax.lax.cond(jnp.any(done), lambda: select(done, reset(key), running), lambda: running), outcome

    return VectorEnv(reset, step, env.observation_size, env.action_size, num_envs, episode_length)


def stagger(state: VectorState, key: jax.Array, episode_length: int) -> VectorState:
    """Fresh episodes moved to random points of their time limit: t_i ~ U{0, ..., episode_length - 1}.

    Without it all environments reach the time limit together for ever, and a short rollout sees one phase of the
    episode only. The shortened first episodes are not counted as episodes.
    """
    time = jax.random.randint(key, state.time.shape, 0, episode_length)
    return state._replace(time=time, whole=(time == 0).astype(state.whole.dtype))


def episode_metrics(transition: Transition, axis_name: str | None = None) -> Metrics:
    """What a rollout says of its episodes.

    `episodes` that ended and `return_sum`, the sum of their returns; `diverged`, how often the physics did, and
    `diverged_env`, the first environment with it, or -1. An episode that diverged is in neither of the first two.

    Args:
      transition: of a rollout.
      axis_name: a mapped axis, along which there are further environments.
    """
    exploded = transition.diverged > 0
    counted = {
        "return_sum": jnp.where(exploded, 0.0, transition.episode_return),
        "episodes": jnp.where(exploded, 0.0, transition.episode_end),
        "diverged": transition.diverged,
    }
    counts = {name: collectives.total(jnp.sum(x), axis_name) for name, x in counted.items()}
    where = jnp.any(exploded, axis=0)
    return counts | {"diverged_env": collectives.first_place(where, axis_name)}
