"""A rollout as the losses see it: advantages, targets, and what they are computed from."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxpg import divergence, estimators, normalization
from jaxpg.methods import Method
from jaxpg.networks import Networks
from jaxpg.shapes import select
from jaxpg.types import PyTree, Transition


class Batch(NamedTuple):
    """A rollout, `[T, N, ...]`, as constants: nothing in it depends on the parameters that are updated.

    Attributes:
      obs: normalized.
      u: what the policy's Gaussian drew.
      mean, log_std, log_prob: of the policy that acted.
      value: V(s_t) of the critic at that time.
      advantage, target, weight: as in `Estimate` and `Method`.
    """

    obs: jax.Array
    u: jax.Array
    mean: jax.Array
    log_std: jax.Array
    log_prob: jax.Array
    value: jax.Array
    advantage: jax.Array
    target: jax.Array
    weight: jax.Array


def batch_fn(
    networks: Networks,
    method: Method,
    episode_length: int,
    reward_scale: float,
    normalize_advantages: bool,
    axis_name: str | None = None,
) -> Callable[[PyTree, PyTree, Transition, jax.Array | bool], Batch]:
    """`prepare(params, normalizer, transition, counts) -> Batch`: a rollout's advantages, and what they are made of.

    Steps that do not count, `[T, N]` of bool, have the weight 0; their numbers are replaced before anything is computed
    with them, so that none of it can overflow.

    Args:
      networks, method, reward_scale, normalize_advantages, axis_name: as in `on_policy`.
      episode_length: the time limit.
    """

    def prepare(params, normalizer, transition, counts: jax.Array | bool = True):
        counts = jnp.broadcast_to(counts, transition.reward.shape)
        transition = neutralize(transition, counts, normalizer)
        obs = normalization.normalize(normalizer, transition.obs)
        value = networks.value(params["critic"], obs)

        def value_fn(x):
            return networks.value(params["critic"], normalization.normalize(normalizer, x))

        next_value = next_values(value_fn, value, transition, episode_length)
        weight = jnp.where(counts, method.weight(transition), 0.0)
        scaled = transition._replace(reward=reward_scale * transition.reward)
        mean, log_std = networks.policy(params["actor"], obs)
        squared_score = jnp.sum(jnp.square((transition.u - mean) * jnp.exp(-2 * log_std)), axis=-1)
        advantage, target = method.estimate(scaled, weight, value, next_value, squared_score)
        if normalize_advantages:
            advantage = estimators.normalize_advantages(advantage, weight, axis_name=axis_name)
        advantage = jnp.where(weight > 0, advantage, 0.0)
        log_prob = networks.distribution.log_prob(transition.u, mean, log_std)
        log_std = jnp.broadcast_to(log_std, mean.shape)
        return Batch(obs, transition.u, mean, log_std, log_prob, value, advantage, target, weight)

    return prepare


def usable_steps(transition: Transition, statistics: normalization.RunningStatistics) -> jax.Array:
    """Which steps can be learned from, `[T, N]` of bool: those whose episode stays sound to its end or the rollout's.

    An episode does not where its physics diverges, or where it is about to: an observation is further than
    `jaxpg.divergence.FAR` deviations from the mean, or the policy drew a number that is not finite. All of its steps
    before that are left out too: a joint that explodes passes through any size on its way.

    Args:
      transition: of a rollout.
      statistics: of the observations, this rollout's sound ones included.
    """
    at_home = [normalization.near(statistics, x, divergence.FAR) for x in (transition.obs, transition.next_obs)]
    drawn = jnp.all(jnp.isfinite(transition.u), axis=-1)
    bad = (transition.diverged > 0) | ~at_home[0] | ~at_home[1] | ~drawn
    return divergence.lasting(bad, transition.ended)


def neutralize(transition: Transition, counts: jax.Array, statistics: normalization.RunningStatistics) -> Transition:
    """The rollout with steps that do not count replaced: mean observations, drawn and earned 0."""
    mean = jnp.broadcast_to(statistics.mean, transition.obs.shape)
    replaced = {
        "obs": mean,
        "next_obs": mean,
        "u": jnp.zeros_like(transition.u),
        "reward": jnp.zeros_like(transition.reward),
    }
    return transition._replace(**{name: select(counts, getattr(transition, name), x) for name, x in replaced.items()})


def next_values(
    value_fn: Callable[[jax.Array], jax.Array], value: jax.Array, transition: Transition, episode_length: int
) -> jax.Array:
    """V(s_{t+1}) of the true next observations, `[T, N]`; any number where the episode terminated.

    Where an episode goes on it is the value of the next row. A time limit is reached at most once in T <=
    episode_length steps: of each environment two more values are needed, at its time limit and after the last step.

    Args:
      value_fn: `value_fn(obs) -> V`.
      value: V(s_t), `[T, N]`.
      transition: of the rollout.
      episode_length: the time limit; the values of all next observations are computed where the rollout is longer.
    """
    if len(value) > episode_length:
        return value_fn(transition.next_obs)
    when = jnp.argmax(transition.truncated, axis=0)
    at_limit = jnp.take_along_axis(transition.next_obs, when[None, :, None], axis=0)[0]
    of_limit, of_last = value_fn(jnp.stack([at_limit, transition.next_obs[-1]]))
    return jnp.where(transition.truncated > 0, of_limit, jnp.concatenate([value[1:], of_last[None]]))
