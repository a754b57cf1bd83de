"""REINFORCE and TD as methods: how they collect steps and estimate advantages, all in which they differ."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxpg import baselines, estimators
from jaxpg.baselines import Baseline
from jaxpg.estimators import Estimate, Estimator
from jaxpg.policy import PolicyFn
from jaxpg.returns import discount_factors
from jaxpg.rollout import rollout
from jaxpg.types import Transition
from jaxpg.vector_env import VectorEnv, VectorState, stagger


class Method(NamedTuple):
    """How an algorithm collects its steps and estimates advantages.

    Attributes:
      start: `start(env, key) -> env_state`, the state of the environments before the first update.
      collect: `collect(env, policy_fn, env_state, key) -> (env_state, Transition)`.
      weight: `weight(transition) -> [T, N]`, 1 if the step counts.
      estimate: `estimate(transition, weight, value, next_value, squared_score) -> Estimate`, all `[T, N]`; the score is
        the gradient of log pi(a_t | s_t) with respect to the Gaussian's mean.
    """

    start: Callable[[VectorEnv, jax.Array], VectorState]
    collect: Callable[[VectorEnv, PolicyFn, VectorState, jax.Array], tuple[VectorState, Transition]]
    weight: Callable[[Transition], jax.Array]
    estimate: Callable[[Transition, jax.Array, jax.Array, jax.Array, jax.Array], Estimate]


def td(gamma: float, num_steps: int, estimate: Estimator = estimators.gae(0.95)) -> Method:
    """Temporal differences: short rollouts, each continuing where the last one stopped, with bootstrapping.

    Termination sets the discount to 0. A time limit or the end of the rollout stops the lambda-sum and bootstraps
    from the value of the true next observation.

    Args:
      gamma: discount, in [0, 1].
      num_steps: T, the length of a rollout.
      estimate: `estimators.gae(lambda_)`, `estimators.n_rewards(n)`, or another `Estimator`.
    """

    def start(env, key):
        key_reset, key_stagger = jax.random.split(key)
        return stagger(env.reset(key_reset), key_stagger, env.episode_length)

    def collect(env, policy_fn, env_state, key):
        return rollout(policy_fn, env.step, env_state, key, num_steps)

    def estimate_rollout(transition, weight, value, next_value, squared_score):
        discount = gamma * (1 - transition.terminated)
        return estimate(transition.reward, discount, value, next_value, 1 - transition.truncated)

    return Method(start, collect, lambda transition: jnp.ones_like(transition.reward), estimate_rollout)


def reinforce(
    gamma: float,
    baseline: Baseline = baselines.critic,
    returns: Callable[[jax.Array, jax.Array], Estimate] = estimators.reinforce,
    discounted: bool = False,
) -> Method:
    """REINFORCE: whole episodes from a fresh reset to the time limit, masked after termination; no bootstrap.

    Args:
      gamma: discount, in [0, 1].
      baseline: one of `jaxpg.baselines`, such as `baselines.of_returns(baselines.leave_one_out)`.
      returns: `estimators.reinforce` sums rewards from each step on, `estimators.reinforce_whole` over the episode.
      discounted: multiply the advantages by gamma^t, to estimate the gradient of J; whole returns estimate it without.
    """

    def collect(env, policy_fn, env_state, key):
        key_reset, key_rollout = jax.random.split(key)
        return rollout(policy_fn, env.step, env.reset(key_reset), key_rollout, env.episode_length)

    def weight(transition):
        """1 up to and including the step that ends the episode, 0 after it."""
        ended = jnp.cumsum(transition.terminated, axis=0) - transition.terminated
        return (ended == 0).astype(transition.reward.dtype)

    def estimate(transition, weight, value, next_value, squared_score):
        reward = weight * transition.reward
        discount = gamma * (1 - transition.terminated)
        gain, target = returns(reward, discount)
        advantage = gain - baseline(gain, weight, value, squared_score)
        if discounted:
            advantage = discount_factors(discount) * advantage
        return Estimate(advantage, target)

    return Method(lambda env, key: env.reset(key), collect, weight, estimate)
