"""Diagonal Gaussian policies, plain and squashed by tanh into an actuator's limits.

The action before squashing, u ~ N(mean, sigma^2), is sampled, stored and scored; the actuator gets
a = limit * tanh(u). Working with u avoids atanh, which is infinite for |u| > 9 in float32. Arrays are
`[..., action_size]`; log-probabilities and entropies are summed over the last axis, `[...]`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp


def gaussian_sample(key: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """u = mean + sigma epsilon with epsilon ~ N(0, 1).

    Args:
      key: random key.
      mean: `[..., action_size]`.
      log_std: log sigma, of a shape that broadcasts to the mean's.

    Source: the lesson, section 3.2.
    """
    return mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape, mean.dtype)


def gaussian_log_prob(u: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """Log-density of a diagonal Gaussian.

        log N(u) = -sum_i [ (u_i - mean_i)^2 / (2 sigma_i^2) + log sigma_i + 1/2 log(2 pi) ]

    Args:
      u, mean: `[..., action_size]`.
      log_std: log sigma, of a shape that broadcasts to the mean's.

    Returns:
      `[...]`.

    Source: the lesson, section 3.2.

    >>> round(float(gaussian_log_prob(jnp.zeros(1), jnp.zeros(1), jnp.zeros(1))), 5)
    -0.91894
    """
    standardized = (u - mean) * jnp.exp(-log_std)
    return jnp.sum(-0.5 * standardized**2 - log_std - 0.5 * math.log(2 * math.pi), axis=-1)


def gaussian_entropy(log_std: jax.Array) -> jax.Array:
    """Differential entropy of a diagonal Gaussian, before squashing.

        H = sum_i [ log sigma_i + 1/2 log(2 pi e) ]

    Args:
      log_std: log sigma, `[..., action_size]`.

    Returns:
      `[...]` in nats. The squashed policy's entropy is this plus E[log |da/du|], which has no closed form.

    >>> round(float(gaussian_entropy(jnp.zeros(1))), 5)
    1.41894
    """
    return jnp.sum(log_std + 0.5 * math.log(2 * math.pi * math.e), axis=-1)


def gaussian_kl(old_mean: jax.Array, old_log_std: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """Kullback-Leibler divergence between diagonal Gaussians.

        KL(old || new) = sum_i [ log(sigma_i / sigma'_i) + (sigma'_i^2 + (mu'_i - mu_i)^2) / (2 sigma_i^2) - 1/2 ]

    with mu', sigma' of the old policy. The squashed policies have the same divergence, since an invertible map changes
    both densities by the same factor.

    Args:
      old_mean, mean: `[..., action_size]`.
      old_log_std, log_std: log sigma, of shapes that broadcast to the means'.

    Returns:
      `[...]` in nats, at least 0.

    Source: Kullback and Leibler (1951); the closed form is standard.

    >>> gaussian_kl(jnp.zeros(1), jnp.zeros(1), jnp.ones(1), jnp.zeros(1)).item()
    0.5
    """
    squared = jnp.exp(2 * (old_log_std - log_std)) + ((old_mean - mean) * jnp.exp(-log_std)) ** 2
    return jnp.sum(log_std - old_log_std + 0.5 * squared - 0.5, axis=-1)


def squash(u: jax.Array, limit: jax.Array | float = 1.0) -> jax.Array:
    """a = limit * tanh(u): maps any u into an actuator's limits.

    Source: the lesson, section 5.1.

    >>> squash(jnp.array([0.0]), 2.0).tolist()
    [0.0]
    """
    return limit * jnp.tanh(u)


def squash_log_det(u: jax.Array, limit: jax.Array | float = 1.0) -> jax.Array:
    """Log-determinant of the Jacobian of `squash`.

        sum_i log(limit_i (1 - tanh(u_i)^2)) = sum_i [ log limit_i + 2 (log 2 - u_i - softplus(-2 u_i)) ]

    The right-hand form stays exact where 1 - tanh^2 underflows, and is finite for every finite u.

    Args:
      u: `[..., action_size]`.
      limit: positive, scalar or of a shape that broadcasts to u's.

    Returns:
      `[...]`.

    >>> squash_log_det(jnp.zeros(1)).item()
    0.0
    """
    return jnp.sum(jnp.log(limit) + 2.0 * (math.log(2.0) - u - jax.nn.softplus(-2.0 * u)), axis=-1)


def squashed_gaussian_log_prob(
    u: jax.Array, mean: jax.Array, log_std: jax.Array, limit: jax.Array | float = 1.0
) -> jax.Array:
    """Log-density of a = limit tanh(u) for u ~ N(mean, sigma^2), by the change of variables.

        log pi(a) = log N(u; mean, sigma) - sum_i log |da_i / du_i|

    The Jacobian does not depend on the policy's parameters, so for a stored u the *score* is the Gaussian's. The
    Jacobian does matter for densities, entropies, and wherever u itself is differentiated.

    Args:
      u: the action before squashing, `[..., action_size]`.
      mean: `[..., action_size]`.
      log_std: log sigma, of a shape that broadcasts to the mean's.
      limit: positive, scalar or of a shape that broadcasts to u's.

    Returns:
      `[...]`, with respect to the Lebesgue measure on a.

    Source: the lesson, section 5.1; Haarnoja et al., arXiv 1801.01290, appendix C.

    >>> round(float(squashed_gaussian_log_prob(jnp.zeros(1), jnp.zeros(1), jnp.zeros(1))), 5)
    -0.91894
    """
    return gaussian_log_prob(u, mean, log_std) - squash_log_det(u, limit)


def squashed_gaussian_entropy(
    u: jax.Array, mean: jax.Array, log_std: jax.Array, limit: jax.Array | float = 1.0
) -> jax.Array:
    """Differential entropy of a = limit tanh(u) for u ~ N(mean, sigma^2), estimated from one sample u.

        H(a) = H(u) + E[sum_i log |da_i / du_i|],    estimated by    H(u) + sum_i log |da_i / du_i|

    There is no closed form. The estimate is unbiased, and so is its gradient: u = mean + sigma epsilon is
    differentiated at fixed epsilon. Unlike the Gaussian's entropy, this one falls as sigma grows beyond about 1, where
    tanh drives the actions into both limits.

    Args:
      u: a sample, `[..., action_size]`.
      mean: `[..., action_size]`.
      log_std: log sigma, of a shape that broadcasts to the mean's.
      limit: positive, scalar or of a shape that broadcasts to u's.

    Returns:
      `[...]` in nats.

    >>> round(float(squashed_gaussian_entropy(jnp.zeros(1), jnp.zeros(1), jnp.zeros(1))), 5)
    1.41894
    """
    epsilon = jax.lax.stop_gradient((u - mean) * jnp.exp(-log_std))
    sample = mean + jnp.exp(log_std) * epsilon
    return gaussian_entropy(jnp.broadcast_to(log_std, mean.shape)) + squash_log_det(sample, limit)


class Distribution(NamedTuple):
    """The distribution of the actions made from u ~ N(mean, sigma^2).

    Attributes:
      action: `action(u)`, the action for the environment.
      log_prob: `log_prob(u, mean, log_std) -> log pi(a | s)`, `[...]`, of the action made from u.
      entropy: `entropy(u, mean, log_std)`, `[...]`, of the action; exact, or estimated from the sample u.
    """

    action: Callable[[jax.Array], jax.Array]
    log_prob: Callable[[jax.Array, jax.Array, jax.Array], jax.Array]
    entropy: Callable[[jax.Array, jax.Array, jax.Array], jax.Array]


# Actions within [-1, 1], and unlimited actions, for environments without limits.
SQUASHED_GAUSSIAN = Distribution(squash, squashed_gaussian_log_prob, squashed_gaussian_entropy)
GAUSSIAN = Distribution(
    lambda u: u,
    gaussian_log_prob,
    lambda u, mean, log_std: gaussian_entropy(jnp.broadcast_to(log_std, mean.shape)),
)
