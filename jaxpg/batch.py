"""Prepares a rollout for the losses: normalized observations, advantages, targets and weights."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxpg import divergence, estimators, normalization
from jaxpg.methods import Method
from jaxpg.networks import Networks
from jaxpg.policy import value_function
from jaxpg.shapes import select
from jaxpg.types import PyTree, Transition


class Batch(NamedTuple):
    """A rollout, `[T, N, ...]`, as constants that do not depend on the parameters being updated.

    Attributes:
      obs: normalized observations.
      u: samples of the policy's Gaussian.
      mean, log_std, log_prob: mean, log sigma and log pi(a_t | s_t) of the policy that acted.
      value: V(s_t) of the critic before the update.
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


def make_batch_fn(
    networks: Networks,
    method: Method,
    episode_length: int,
    reward_scale: float,
    normalize_advantages: bool,
    axis_name: str | None = None,
) -> Callable[[PyTree, PyTree, Transition, jax.Array | bool], Batch]:
    """`prepare(params, normalizer, transition, counts) -> Batch`: the batch of a rollout.

    Steps that do not count (`counts`, `[T, N]` of bool) have weight 0; their numbers are replaced before anything is
    computed from them, so that nothing overflows.

    Args:
      networks, method, reward_scale, normalize_advantages, axis_name: as in `on_policy`.
      episode_length: the time limit.
    """

    def prepare(params, normalizer, transition, counts: jax.Array | bool = True):
        counts = jnp.broadcast_to(counts, transition.reward.shape)
        transition = neutralize(transition, counts, normalizer)
        obs = normalization.normalize(normalizer, transition.obs)
        value = networks.value(params["critic"], obs)
        value_fn = value_function(networks, params, normalizer)
        next_value = compute_next_values(value_fn, value, transition, episode_length)
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


def find_usable_steps(transition: Transition, statistics: normalization.RunningStatistics) -> jax.Array:
    """The steps to learn from, `[T, N]` of bool: those from which the episode stays sound to its end or the rollout's.

    An episode is not sound if its physics diverges or is about to: if an observation is more than
    `jaxpg.divergence.MAX_DEVIATION` standard deviations from the mean, or a sample of the policy is not finite. Its
    earlier steps are ignored too, since an exploding joint passes through every size on its way.

    Args:
      transition: the rollout.
      statistics: statistics of the observations, including the sound ones of this rollout.
    """
    bound = divergence.MAX_DEVIATION
    is_near, is_next_near = (normalization.near(statistics, x, bound) for x in (transition.obs, transition.next_obs))
    is_finite = jnp.all(jnp.isfinite(transition.u), axis=-1)
    bad = (transition.diverged > 0) | ~is_near | ~is_next_near | ~is_finite
    return divergence.find_sound_steps(bad, transition.ended)


def neutralize(transition: Transition, counts: jax.Array, statistics: normalization.RunningStatistics) -> Transition:
    """Replaces the steps that do not count: observations by their mean, samples and rewards by 0."""
    mean = jnp.broadcast_to(statistics.mean, transition.obs.shape)
    replacements = {
        "obs": mean,
        "next_obs": mean,
        "u": jnp.zeros_like(transition.u),
        "reward": jnp.zeros_like(transition.reward),
    }
    return transition._replace(
        **{name: select(counts, getattr(transition, name), x) for name, x in replacements.items()}
    )


def compute_next_values(
    value_fn: Callable[[jax.Array], jax.Array], value: jax.Array, transition: Transition, episode_length: int
) -> jax.Array:
    """V(s_{t+1}) of the true next observations, `[T, N]`; any number where the episode terminated.

    Within an episode this is the value in the next row. A time limit is reached at most once in T <= episode_length
    steps, so only two more values per environment are needed: at its time limit and after the last step.

    Args:
      value_fn: `value_fn(obs) -> V`.
      value: V(s_t), `[T, N]`.
      transition: the rollout.
      episode_length: the time limit; for a longer rollout, the values of all next observations are computed.
    """
    if len(value) > episode_length:
        return value_fn(transition.next_obs)
    when = jnp.argmax(transition.truncated, axis=0)
    at_limit = jnp.take_along_axis(transition.next_obs, when[None, :, None], axis=0)[0]
    limit_value, last_value = value_fn(jnp.stack([at_limit, transition.next_obs[-1]]))
    return jnp.where(transition.truncated > 0, limit_value, jnp.concatenate([value[1:], last_value[None]]))
