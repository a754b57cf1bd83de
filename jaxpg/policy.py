"""What a trained actor-critic does and expects, without what it was trained with."""

from __future__ import annotations

from collections.abc import Callable

import jax

from jaxpg import normalization
from jaxpg.networks import Networks
from jaxpg.normalization import RunningStatistics
from jaxpg.types import PyTree


def deterministic_policy(
    networks: Networks, params: PyTree, normalizer: RunningStatistics
) -> Callable[[jax.Array], jax.Array]:
    """`policy(obs) -> action`: that of the Gaussian's mean."""

    def policy(obs):
        mean, _ = networks.policy(params["actor"], normalization.normalize(normalizer, obs))
        return networks.distribution.action(mean)

    return policy


def value_function(
    networks: Networks, params: PyTree, normalizer: RunningStatistics, reward_scale: float = 1.0
) -> Callable[[jax.Array], jax.Array]:
    """`value(obs) -> V`: what the critic expects of the discounted rewards to come, in the rewards' own units.

    Args:
      networks, params, normalizer: of the policy.
      reward_scale: the factor on the rewards that the critic has learned from.
    """

    def value(obs):
        return networks.value(params["critic"], normalization.normalize(normalizer, obs)) / reward_scale

    return value
