"""Many environments side by side: time limit, resets, and the true next observation.

The environment is any object with brax's `reset(key) -> State` and `step(State, action) -> State`. Its `done` means
termination; the time limit is added here, as truncation. An environment whose episode ended is reset at once with a
fresh draw, and the observation from *before* the reset is returned as s_{t+1}, for the bootstrap.

If the physics of an environment diverges (`jaxpg.divergence`), as with stiff models at long time steps, only its own
episode ends.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxpg import collectives
from jaxpg.divergence import has_diverged
from jaxpg.shapes import select
from jaxpg.types import Env, Metrics, Transition


class VectorState(NamedTuple):
    """N running episodes.

    Attributes:
      env: the environment's State, with a leading axis on every leaf, `[N, ...]`.
      time: steps since the last reset, `[N]` int32.
      episode_return: undiscounted return since the last reset, `[N]`.
      whole: 1.0 if the episode was played from its first step, `[N]`; see `stagger`.
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
    """The result of one step of all environments; fields as in `jaxpg.types.Transition`, without the time axis."""

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
    """`num_envs` copies of `env`, whose episodes end after at most `episode_length` steps and are then reset.

    Args:
      env: environment with brax's interface, whose observation is an array.
      num_envs: N, at least 1.
      episode_length: steps until the time limit, at least 1.
    """

    def reset(key):
        state = jax.vmap(env.reset)(jax.random.split(key, num_envs))
        zeros = jnp.zeros_like(state.reward)
        return VectorState(state, zeros.astype(jnp.int32), episode_return=zeros, whole=zeros + 1)

    def step(state, action, key):
        env_state = jax.vmap(env.step)(state.env, action)
        diverged = jax.vmap(has_diverged)(state.env, env_state)
        reward = jnp.where(diverged, 0.0, env_state.reward)
        next_obs = select(diverged, state.obs, env_state.obs)
        time = state.time + 1
        episode_return = state.episode_return + reward
        terminated = jnp.where(diverged, 1, env_state.done).astype(reward.dtype)
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
            diverged=diverged.astype(reward.dtype),
        )
        running = VectorState(env_state, time, episode_return, state.whole)
        # In some environments a reset costs as much as a step, so it is computed only if an episode has ended.
        return jax.lax.cond(jnp.any(done), lambda: select(done, reset(key), running), lambda: running), outcome

    return VectorEnv(reset, step, env.observation_size, env.action_size, num_envs, episode_length)


def stagger(state: VectorState, key: jax.Array, episode_length: int) -> VectorState:
    """Moves fresh episodes to random points before the time limit: t_i ~ U{0, ..., episode_length - 1}.

    Without it all environments would always reach the time limit together, and a short rollout would see only one phase
    of the episode. The shortened first episodes do not count as episodes.
    """
    time = jax.random.randint(key, state.time.shape, 0, episode_length)
    return state._replace(time=time, whole=(time == 0).astype(state.whole.dtype))


def episode_metrics(transition: Transition, axis_name: str | None = None) -> Metrics:
    """Metrics of the episodes that ended in a rollout.

    `episodes` is their number and `return_sum` the sum of their returns, both without episodes that diverged.
    `diverged` is how often the physics diverged, and `diverged_env` the first environment in which it did, or -1.

    Args:
      transition: the rollout.
      axis_name: mapped axis over which the environments are divided.
    """
    diverged = transition.diverged > 0
    terms = {
        "return_sum": jnp.where(diverged, 0.0, transition.episode_return),
        "episodes": jnp.where(diverged, 0.0, transition.episode_end),
        "diverged": transition.diverged,
    }
    sums = {name: collectives.total(jnp.sum(x), axis_name) for name, x in terms.items()}
    where = jnp.any(diverged, axis=0)
    return sums | {"diverged_env": collectives.find_first(where, axis_name)}
