"""Running mean and variance of observations, as pure functions.

They have no unit: observations of size 1e-5 or 1e5, or of 1e4 with a deviation of 0.1, are normalized alike. A sample
far outside, of a simulation that is about to explode, does not spoil them.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxpg import collectives
from jaxpg.shapes import select

ERRORS = 6.0  # standard errors by which the scale of few samples may be larger than it looks
REACH = 10.0  # deviations within which a sample is taken as it is
TYPICAL = 1.887  # deviation over geometric mean distance, of a Gaussian: exp((log 2 + Euler's gamma) / 2)
SPREAD = 1.111  # deviation of log |x| of a Gaussian: pi / sqrt(8)
ROUNDING = 8.0  # units in the last place of the mean that are no variation


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


def update(
    statistics: RunningStatistics, batch: jax.Array, axis_name: str | None = None, counts: jax.Array | bool = True
) -> RunningStatistics:
    """The statistics with a batch added, by the pairwise rule, which does not drift.

        d = clip(x - m, -l, l),    w = n_b / (n + n_b)
        m' = m + w mean(d),        v' = (1 - w) v + w var(d) + w (1 - w) mean(d)^2

    Differences from the mean are exact where the samples themselves would lose them to rounding. Before the first
    sample m is the batch's median. A sample further off than l (`_reach`) enters as if it were that far off: one of 1e9
    among a hundred thousand of size 1 changes the variance by less than 1 part in 1000, and a change of scale that
    lasts is followed.

    Args:
      statistics: so far.
      batch: samples, `[..., size]`.
      axis_name: a mapped axis, along which there are further parts of the batch.
      counts: which samples are to be added, `[...]` of bool; whatever the others are.

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

    known = statistics.count > 0
    # Sorting is for the first batch only.
    first = jax.lax.cond(known, lambda: jnp.zeros_like(statistics.mean), lambda: _middle(samples, counts))
    centre = jnp.where(known, statistics.mean, collectives.mean(first, axis_name))
    away = select(counts, samples - centre, jnp.zeros_like(samples))
    reach = _reach(statistics, weight, away, axis_name)
    away = jnp.clip(away, -reach, reach)
    shift = mean(away)
    variance = mean(select(counts, jnp.square(away - shift), jnp.zeros_like(samples)))
    return RunningStatistics(
        count=count,
        mean=centre + weight * shift,
        variance=(1 - weight) * statistics.variance + weight * variance + weight * (1 - weight) * shift**2,
    )


def _middle(samples: jax.Array, counts: jax.Array, number: int = 256) -> jax.Array:
    """About the median, `[size]`: that of evenly spaced samples; 0 where none of them counts."""
    step = max(len(samples) // number, 1)
    some = select(counts[::step], samples[::step], jnp.full_like(samples[::step], jnp.nan))
    median = jnp.nanmedian(some, axis=0)
    return jnp.where(jnp.isnan(median), 0.0, median)


def _reach(statistics: RunningStatistics, weight: jax.Array, away: jax.Array, axis_name: str | None) -> jax.Array:
    """How far from the mean a sample is taken as it is, `[size]`.

        l = 10 max(s, s^(1 - a) s_b^a),    s = sqrt(v),    a = min(1, 10 w)
        s_b = 1.887 exp(mean log |x - m| + 6 (1.111 / sqrt(k)))

    s_b is the batch's own scale, by the geometric mean: that of a few enormous samples among many is that of the many.
    Of k samples it is as large as six standard errors of the mean of logarithms allow: in a batch of five, three may
    lie close together by chance. Alone it decides as long as there is no variation, and as long as the batch is a tenth
    of all samples.
    """
    moved = away != 0
    logarithms = jnp.where(moved, jnp.log(jnp.abs(jnp.where(moved, away, 1.0))), 0.0)
    sums = jnp.stack([jnp.sum(logarithms, axis=0), jnp.sum(moved, axis=0, dtype=away.dtype)])
    total, number = collectives.total(sums, axis_name)
    number = jnp.maximum(number, 1)
    own = jnp.log(TYPICAL) + total / number + ERRORS * SPREAD * jax.lax.rsqrt(number)
    known = (statistics.count > 0) & (statistics.variance > 0)
    so_far = jnp.where(known, 0.5 * jnp.log(jnp.where(known, statistics.variance, 1.0)), own)
    trust = jnp.minimum(1.0, 10 * weight)
    return REACH * jnp.exp(jnp.maximum(so_far, (1 - trust) * so_far + trust * own))


def inverse_deviation(statistics: RunningStatistics) -> jax.Array:
    """1 / sqrt(variance + (8 eps mean)^2), `[size]`: the factor of `normalize`; 0 where nothing varies.

    eps is the distance of floating-point numbers near 1: variation in the last places of the mean is rounding.
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
    """Whether all components are within so many deviations of their means, `[...]` of `[..., size]`; NaN is not."""
    return jnp.all(jnp.abs(normalize(statistics, x)) <= deviations, axis=-1)
