"""Aggregates over episodes and over seeds: means, the interquartile mean, the probability of improvement, intervals.

An interval is given only if there are enough seeds for one.
"""

from __future__ import annotations

import math
import statistics

import numpy as np

CONFIDENCE = 0.95


def min_seeds(confidence: float = CONFIDENCE) -> int:
    """The smallest number of seeds for a bootstrap interval.

        P(min < centre < max) = 1 - 2^(1 - S),    of S independent values about their median

    A bootstrap interval lies within the range of its values. With fewer seeds it cannot reach its confidence, whatever
    the values are: a single value gives a point, which always looks certain.

    >>> min_seeds(0.95), min_seeds(0.5)
    (6, 2)
    """
    return math.ceil(1 - math.log2(1 - confidence) - 1e-9)


def penalize_diverged(episode_return: np.ndarray, is_diverged: np.ndarray) -> np.ndarray:
    """Returns of an evaluation's episodes, with a penalty for those whose physics diverged.

        R_i = min(0, min of R_j over the sound episodes j)    where episode i diverged

    The return of such an episode says nothing: it ended early, which looks good if rewards are negative, and on its way
    to infinity it can have any size and sign. It counts as the worst of the others, at most 0.

    Args:
      episode_return: returns of the episodes, `[..., N]`.
      diverged: whether their physics diverged, `[..., N]` of bool.

    Returns:
      `[..., N]`, float64; NaN in rows in which every episode diverged.

    >>> penalize_diverged(np.array([-3.0, -0.5, -7.0]), np.array([False, True, False])).tolist()
    [-3.0, -7.0, -7.0]
    """
    returns, is_diverged = np.asarray(episode_return, float), np.asarray(is_diverged, bool)
    worst = np.min(np.where(is_diverged, np.inf, returns), axis=-1, keepdims=True)
    worst = np.where(is_diverged.all(axis=-1, keepdims=True), np.nan, np.minimum(worst, 0.0))
    return np.where(is_diverged, worst, returns)


def finite_mean(values: np.ndarray) -> np.ndarray:
    """The mean of each row's finite numbers, `[..., N]` to `[...]`; NaN if there are none.

    >>> finite_mean(np.array([[1.0, np.nan, 3.0], [np.inf, np.nan, np.nan]])).tolist()
    [2.0, nan]
    """
    values = np.asarray(values, float)
    finite = np.isfinite(values)
    count = finite.sum(axis=-1)
    total = np.where(finite, values, 0.0).sum(axis=-1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def interquartile_mean(scores: np.ndarray) -> np.ndarray:
    """Mean of the middle half of the seeds.

        IQM = mean of x_(i) without the lowest and the highest quarter; the seeds on the quarter marks count in part

    Args:
      scores: one row for each seed, `[S, ...]`.

    Returns:
      `[...]`.

    Source: Agarwal et al., arXiv 2108.13264.

    >>> float(interquartile_mean(np.array([0.0, 1.0, 3.0, 100.0])))
    2.0
    """
    ordered = np.sort(np.asarray(scores, float), axis=0)
    edges = np.arange(len(ordered) + 1) / len(ordered)
    weights = np.diff(np.clip(edges, 0.25, 0.75)) / 0.5
    return np.tensordot(weights, ordered, axes=1)


def bootstrap_interval(
    scores: np.ndarray, confidence: float = CONFIDENCE, resamples: int = 2000, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Percentile bootstrap interval of the interquartile mean, resampling the seeds.

    Args:
      scores: one row for each seed, `[S, ...]`.
      confidence: nominal probability of the interval.
      resamples: number of samples of S seeds, drawn with replacement.
      seed: seed of the resampling.

    Returns:
      Lower and upper end, `[...]` each; NaN for fewer than `min_seeds(confidence)` seeds.

    Source: Efron, Annals of Statistics 7 (1979).
    """
    scores = np.asarray(scores, float)
    if len(scores) < min_seeds(confidence):
        return np.full(scores.shape[1:], np.nan), np.full(scores.shape[1:], np.nan)
    from scipy import stats  # slow to import

    interval = stats.bootstrap(
        (scores,),
        lambda samples, axis: interquartile_mean(np.moveaxis(samples, axis, 0)),
        axis=0,
        confidence_level=confidence,
        n_resamples=resamples,
        method="percentile",
        rng=seed,
    ).confidence_interval
    return interval.low, interval.high


def seed_interval(scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The interval to show around an interquartile mean; `seed_interval_name` names it.

    Args:
      scores: one row for each seed, `[S, ...]`.

    Returns:
      Lower and upper end, `[...]` each: the bootstrap interval, or with too few seeds the lowest and highest score.
    """
    scores = np.asarray(scores, float)
    return bootstrap_interval(scores) if has_interval(len(scores)) else (scores.min(axis=0), scores.max(axis=0))


def has_interval(number: int) -> bool:
    """Whether this many seeds are enough for an interval of the usual confidence."""
    return number >= min_seeds()


def seed_interval_name(number: int) -> str:
    """The name of `seed_interval` for this many seeds.

    >>> seed_interval_name(3), seed_interval_name(10)
    ('lowest to highest', '95 % interval')
    """
    return f"{100 * CONFIDENCE:.0f} % interval" if has_interval(number) else "lowest to highest"


def probability_of_improvement(x: np.ndarray, y: np.ndarray) -> float:
    """The probability that a run of X is better than a run of Y.

        P(X > Y) = mean over i, j of [x_i > y_j] + [x_i = y_j] / 2

    Args:
      x, y: a score for each seed, `[S]` and `[R]`; larger is better.

    Source: Agarwal et al., arXiv 2108.13264; the U of Mann and Whitney, divided by S R.

    >>> probability_of_improvement(np.array([1.0, 2.0]), np.array([1.0, 0.0]))
    0.875
    """
    from scipy import stats  # slow to import

    return float(stats.mannwhitneyu(x, y).statistic) / (len(x) * len(y))


def improvement_interval(x: np.ndarray, y: np.ndarray, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Interval of `probability_of_improvement`: the values of P within z standard errors of the estimate.

        |P - P_hat| = z sqrt(V(P)),      V(P) = P (1 - P) (1 + M (1 - P) / (2 - P) + M P / (1 + P)) / (S R)
        M = (S + R) / 2 - 1,    z: the normal distribution's quantile at (1 + confidence) / 2

    Unlike a bootstrap interval it does not shrink to a point if all of X are better than all of Y.

    Args:
      x, y: a score for each seed, `[S]` and `[R]`.
      confidence: nominal probability of the interval.

    Returns:
      Lower and upper end; NaN if there are too few seeds for any outcome to exclude one half: if the smallest two-sided
      probability of the rank test, 2 / C(S + R, S), exceeds 1 - confidence, or if S or R is 1.

    Source: Newcombe, Statistics in Medicine 25 (2006), method 5.

    >>> [round(end, 2) for end in improvement_interval(np.arange(10.0) + 20, np.arange(10.0))]
    [0.8, 1.0]
    """
    if min(len(x), len(y)) < 2 or 2 / math.comb(len(x) + len(y), len(x)) > 1 - confidence:
        return math.nan, math.nan
    estimate = probability_of_improvement(x, y)
    return 1 - _upper_end(1 - estimate, len(x), len(y), confidence), _upper_end(estimate, len(x), len(y), confidence)


def _upper_end(estimate: float, S: int, R: int, confidence: float) -> float:
    """The P that is z standard errors above the estimate: by bisection, as z V^(1/2) falls short at 1."""
    z, low, high = statistics.NormalDist().inv_cdf((1 + confidence) / 2), estimate, 1.0
    for _ in range(60):
        P = (low + high) / 2
        M = (S + R) / 2 - 1
        variance = P * (1 - P) * (1 + M * (1 - P) / (2 - P) + M * P / (1 + P)) / (S * R)
        low, high = (P, high) if P - estimate < z * math.sqrt(variance) else (low, P)
    return high
