"""Running mean and variance of observations, as pure functions."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxpg import collectives


class RunningStatistics(NamedTuple):
    """Statistics of the samples seen so far.

    Attributes:
      count: number of samples, scalar.
      mean: `[size]`.
      variance: population variance, `[size]`; 1 before the first sample.
    """

    count: jax.Array
    mean: jax.Array
    variance: jax.Array


def init(size: int) -> RunningStatistics:
    """No samples yet: mean 0 and variance 1, so that `normalize` is the identity.

    >>> jnp.allclose(normalize(init(2), jnp.array([3.0, 4.0])), jnp.array([3.0, 4.0])).item()
    True
    """
    return RunningStatistics(jnp.zeros(()), jnp.zeros(size), jnp.ones(size))


def update(statistics: RunningStatistics, batch: jax.Array, axis_name: str | None = None) -> RunningStatistics:
    """The statistics with a batch added, by the pairwise rule, which does not drift.

        w = n_b / (n + n_b),   m' = m + w (m_b - m),   v' = (1 - w) v + w v_b + w (1 - w) (m_b - m)^2

    Args:
      statistics: so far.
      batch: samples, `[..., size]`.
      axis_name: a mapped axis, along which there are further parts of the batch.

    Source: Chan, Golub and LeVeque, The American Statistician 37 (1983).

    >>> update(init(1), jnp.array([[1.0], [3.0]])).variance.tolist()
    [1.0]
    """
    samples = batch.reshape(-1, batch.shape[-1])
    number = collectives.total(len(samples), axis_name)
    mean = collectives.mean(jnp.mean(samples, axis=0), axis_name)
    variance = collectives.mean(jnp.mean(jnp.square(samples - mean), axis=0), axis_name)
    count = statistics.count + number
    weight = number / count
    shift = mean - statistics.mean
    spread = (1 - weight) * statistics.variance + weight * variance
    return RunningStatistics(
        count=count,
        mean=statistics.mean + weight * shift,
        variance=spread + weight * (1 - weight) * shift**2,
    )


def inverse_deviation(statistics: RunningStatistics, epsilon: float = 1e-6) -> jax.Array:
    """1 / sqrt(variance + epsilon), `[size]`: the factor of `normalize`."""
    return jax.lax.rsqrt(statistics.variance + epsilon)


def normalize(statistics: RunningStatistics, x: jax.Array, epsilon: float = 1e-6) -> jax.Array:
    """(x - mean) / sqrt(variance + epsilon), `[..., size]`; a constant component becomes 0.

    >>> statistics = RunningStatistics(jnp.array(2.0), jnp.array([1.0]), jnp.array([4.0]))
    >>> normalize(statistics, jnp.array([5.0])).round(3).tolist()
    [2.0]
    """
    return (x - statistics.mean) * inverse_deviation(statistics, epsilon)
