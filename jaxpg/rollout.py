"""Rollouts: a policy acts in the environments, as one scan."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax

from jaxpg.policy import PolicyFn
from jaxpg.types import Transition


def rollout(
    policy_fn: PolicyFn, env_step: Callable, env_state: Any, key: jax.Array, length: int
) -> tuple[Any, Transition]:
    """`length` steps of all environments under one policy.

        u_t, a_t ~ policy_fn(s_t),    s_{t+1}, r_t ~ env_step(s_t, a_t)

    Args:
      policy_fn: `policy_fn(obs, key) -> (u, action)`: the Gaussian's sample, and the action for the environment.
      env_step: `VectorEnv.step`.
      env_state: initial state of the environments.
      key: random key for the whole rollout.
      length: T, at least 1.

    Returns:
      The state of the environments after the last step, and the `Transition`, with fields `[T, N, ...]`.
    """

    def step(env_state, key):
        key_policy, key_env = jax.random.split(key)
        obs = env_state.obs
        u, action = policy_fn(obs, key_policy)
        env_state, outcome = env_step(env_state, action, key_env)
        return env_state, Transition(obs=obs, u=u, **outcome._asdict())

    return jax.lax.scan(step, env_state, jax.random.split(key, length))
