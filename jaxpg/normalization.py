"""Running mean and variance of observations, as pure functions.

They work at any scale: observations of size 1e-5 or 1e5, or of 1e4 with a standard deviation of 0.1, are normalized
alike. An extreme sample, from a simulation that is about to explode, does not spoil them.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxpg import collectives
from jaxpg.shapes import select

ERRORS = 6.0  # standard errors by which the true scale may exceed its estimate from few samples
REACH = 10.0  # samples beyond this many standard deviations are clipped
TYPICAL = 1.887  # standard deviation / geometric mean of |x|, of a Gaussian: exp((log 2 + Euler's gamma) / 2)
SPREAD = 1.111  # standard deviation of log |x|, of a Gaussian: pi / sqrt(8)
ROUNDING = 8.0  # variation of this many units in the last place of the mean is rounding


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
    """Statistics of no samples: mean 0 and variance 1, so that `normalize` is the identity.

    >>> jnp.allclose(normalize(init(2), jnp.array([3.0, 4.0])), jnp.array([3.0, 4.0])).item()
    True
    """
    return RunningStatistics(jnp.zeros(()), jnp.zeros(size), jnp.ones(size))


def update(
    statistics: RunningStatistics, batch: jax.Array, axis_name: str | None = None, counts: jax.Array | bool = True
) -> RunningStatistics:
    """Adds a batch to the statistics, by the pairwise rule, which does not drift.

        d = clip(x - m, -l, l),    w = n_b / (n + n_b)
        m' = m + w mean(d),        v' = (1 - w) v + w var(d) + w (1 - w) mean(d)^2

    Differences from the mean keep the digits that sums of the samples would lose to rounding. Before the first sample m
    is the batch's median. Differences are clipped at l (`_clip_distance`): one sample of 1e9 among a hundred thousand
    of size 1 changes the variance by less than 1 part in 1000, yet a lasting change of scale is followed.

    Args:
      statistics: the statistics so far.
      batch: samples, `[..., size]`.
      axis_name: mapped axis over which the batch is divided.
      counts: which samples to add, `[...]` of bool; the others may hold any numbers.

    Source: Chan, Golub and LeVeque, The American Statistician 37 (1983); Huber, Robust Statistics (1981).

    >>> update(init(1), jnp.array([[1.0], [3.0]])).variance.tolist()
    [1.0]
    """
    samples = batch.reshape(-1, batch.shape[-1])
    counts = jnp.broadcast_to(counts, batch.shape[:-1]).reshape(-1)
    number = collectives.total(jnp.sum(counts, dtype=samples.dtype), axis_name)
    count = statistics.count + number
    weight = number / jnp.maximum(count, 1)

    def mean(x):
        return collectives.total(jnp.sum(x, axis=0), axis_name) / jnp.maximum(number, 1)

    has_samples = statistics.count > 0
    # The median needs a sort, so it is computed for the first batch only.
    first = jax.lax.cond(
        has_samples, lambda: jnp.zeros_like(statistics.mean), lambda: _approximate_median(samples, counts)
    )
    centre = jnp.where(has_samples, statistics.mean, collectives.mean(first, axis_name))
    difference = select(counts, samples - centre, jnp.zeros_like(samples))
    distance = _clip_distance(statistics, weight, difference, axis_name)
    difference = jnp.clip(difference, -distance, distance)
    shift = mean(difference)
    variance = mean(select(counts, jnp.square(difference - shift), jnp.zeros_like(samples)))
    return RunningStatistics(
        count=count,
        mean=centre + weight * shift,
        variance=(1 - weight) * statistics.variance + weight * variance + weight * (1 - weight) * shift**2,
    )


def _approximate_median(samples: jax.Array, counts: jax.Array, number: int = 256) -> jax.Array:
    """Median of about `number` evenly spaced samples, `[size]`; 0 if none of them counts."""
    step = max(len(samples) // number, 1)
    subset = select(counts[::step], samples[::step], jnp.full_like(samples[::step], jnp.nan))
    median = jnp.nanmedian(subset, axis=0)
    return jnp.where(jnp.isnan(median), 0.0, median)


def _clip_distance(
    statistics: RunningStatistics, weight: jax.Array, difference: jax.Array, axis_name: str | None
) -> jax.Array:
    """The distance from the mean at which samples are clipped, `[size]`.

        l = 10 max(s, s^(1 - a) s_b^a),    s = sqrt(v),    a = min(1, 10 w)
        s_b = 1.887 exp(mean log |x - m| + 6 (1.111 / sqrt(k)))

    s_b estimates the batch's scale by the geometric mean, which a few enormous samples hardly change. It is raised by
    six standard errors of the mean of the logarithms of k samples: in a batch of five, three may lie close together by
    chance. It is used alone while nothing has varied yet, and while the batch is at least a tenth of all samples.
    """
    nonzero = difference != 0
    logarithms = jnp.where(nonzero, jnp.log(jnp.abs(jnp.where(nonzero, difference, 1.0))), 0.0)
    sums = jnp.stack([jnp.sum(logarithms, axis=0), jnp.sum(nonzero, axis=0, dtype=difference.dtype)])
    total, number = collectives.total(sums, axis_name)
    number = jnp.maximum(number, 1)
    log_batch_scale = jnp.log(TYPICAL) + total / number + ERRORS * SPREAD * jax.lax.rsqrt(number)
    has_varied = (statistics.count > 0) & (statistics.variance > 0)
    log_variance = jnp.log(jnp.where(has_varied, statistics.variance, 1.0))
    log_scale = jnp.where(has_varied, 0.5 * log_variance, log_batch_scale)
    trust = jnp.minimum(1.0, 10 * weight)
    return REACH * jnp.exp(jnp.maximum(log_scale, (1 - trust) * log_scale + trust * log_batch_scale))


def inverse_deviation(statistics: RunningStatistics) -> jax.Array:
    """1 / sqrt(variance + (8 eps mean)^2), `[size]`: the factor of `normalize`; 0 for a constant component.

    eps is the spacing of floating-point numbers at 1: variation in the last places of the mean is rounding.
    """
    rounding = ROUNDING * jnp.finfo(statistics.mean.dtype).eps * statistics.mean
    variance = statistics.variance + rounding**2
    varies = statistics.variance > 0
    return jnp.where(varies, jax.lax.rsqrt(jnp.where(varies, variance, 1.0)), 0.0)


def normalize(statistics: RunningStatistics, x: jax.Array) -> jax.Array:
    """(x - mean) / sqrt(variance + (8 eps mean)^2), `[..., size]`; a constant component becomes 0.

    >>> statistics = RunningStatistics(jnp.array(2.0), jnp.array([1.0]), jnp.array([4.0]))
    >>> normalize(statistics, jnp.array([5.0])).round(3).tolist()
    [2.0]
    """
    return (x - statistics.mean) * inverse_deviation(statistics)


def near(statistics: RunningStatistics, x: jax.Array, deviations: float) -> jax.Array:
    """Whether all components are within `deviations` standard deviations of the mean, `[...]`; false for NaN."""
    return jnp.all(jnp.abs(normalize(statistics, x)) <= deviations, axis=-1)
