"""The policy and the value function of a trained actor-critic, independent of its training."""

from __future__ import annotations

from collections.abc import Callable

import jax

from jaxpg import normalization
from jaxpg.distributions import gaussian_sample
from jaxpg.networks import Networks
from jaxpg.normalization import RunningStatistics
from jaxpg.types import PyTree

# policy_fn(obs [N, observation_size], key) -> (u, action), both [N, action_size]
PolicyFn = Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]


def deterministic_policy(
    networks: Networks, params: PyTree, normalizer: RunningStatistics
) -> Callable[[jax.Array], jax.Array]:
    """`policy(obs) -> action`: the action at the Gaussian's mean."""

    def policy(obs):
        mean, _ = networks.policy(params["actor"], normalization.normalize(normalizer, obs))
        return networks.distribution.action(mean)

    return policy


def sampling_policy(networks: Networks, params: PyTree, normalizer: PyTree) -> PolicyFn:
    """`policy_fn(obs, key) -> (u, action)`, sampled from the Gaussian."""

    def policy_fn(obs, key):
        mean, log_std = networks.policy(params["actor"], normalization.normalize(normalizer, obs))
        u = gaussian_sample(key, mean, log_std)
        return u, networks.distribution.action(u)

    return policy_fn


def value_function(
    networks: Networks, params: PyTree, normalizer: RunningStatistics, reward_scale: float = 1.0
) -> Callable[[jax.Array], jax.Array]:
    """`value(obs) -> V`: the critic's estimate of the discounted future rewards, in units of the unscaled rewards.

    Args:
      networks, params, normalizer: as in `deterministic_policy`.
      reward_scale: factor on the rewards in training.
    """

    def value(obs):
        return networks.value(params["critic"], normalization.normalize(normalizer, obs)) / reward_scale

    return value
