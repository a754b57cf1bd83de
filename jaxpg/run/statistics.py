"""Aggregates over episodes and over seeds: means, the interquartile mean, the probability of improvement, intervals."""

from __future__ import annotations

import numpy as np


def counted_returns(episode_return: np.ndarray, diverged: np.ndarray) -> np.ndarray:
    """Returns of an evaluation's episodes, with those whose physics diverged at what they count as.

        R_i = min(0, min of R_j over the sound episodes j)    where episode i diverged

    What such an episode earned is no measure: it ended early, which looks good where rewards are negative, and what it
    earned on its way to infinity can have any size and sign. It counts as the worst of the others, and as 0 at best.

    Args:
      episode_return: of the episodes, `[..., N]`.
      diverged: which of them did, `[..., N]` of bool.

    Returns:
      `[..., N]`, float64; NaN in all places that diverged where every episode of the row did.

    >>> counted_returns(np.array([-3.0, -0.5, -7.0]), np.array([False, True, False])).tolist()
    [-3.0, -7.0, -7.0]
    """
    returns, diverged = np.asarray(episode_return, float), np.asarray(diverged, bool)
    worst = np.min(np.where(diverged, np.inf, returns), axis=-1, keepdims=True)
    worst = np.where(diverged.all(axis=-1, keepdims=True), np.nan, np.minimum(worst, 0.0))
    return np.where(diverged, worst, returns)


def finite_mean(values: np.ndarray) -> np.ndarray:
    """The mean of each row's finite numbers, `[..., N]` to `[...]`; NaN where it has none.

    >>> finite_mean(np.array([[1.0, np.nan, 3.0], [np.inf, np.nan, np.nan]])).tolist()
    [2.0, nan]
    """
    values = np.asarray(values, float)
    finite = np.isfinite(values)
    number = finite.sum(axis=-1)
    total = np.where(finite, values, 0.0).sum(axis=-1)
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


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
    scores: np.ndarray, confidence: float = 0.95, resamples: int = 2000, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Percentile bootstrap interval of the interquartile mean, resampling the seeds.

    Args:
      scores: one row for each seed, `[S, ...]`.
      confidence: probability that the interval is meant to have.
      resamples: how many samples of S seeds are drawn, with replacement.
      seed: of the resampling.

    Returns:
      Lower and upper end, `[...]` each.

    Source: Efron, Annals of Statistics 7 (1979).
    """
    scores = np.asarray(scores, float)
    draws = np.random.default_rng(seed).integers(len(scores), size=(resamples, len(scores)))
    return _middle(np.stack([interquartile_mean(scores[draw]) for draw in draws]), confidence)


def probability_of_improvement(x: np.ndarray, y: np.ndarray) -> float:
    """How probable it is that a run of X is better than one of Y.

        P(X > Y) = mean over i, j of [x_i > y_j] + [x_i = y_j] / 2

    Args:
      x, y: a score for each seed, `[S]` and `[R]`; larger is better.

    Source: Agarwal et al., arXiv 2108.13264; the U of Mann and Whitney, divided by S R.

    >>> probability_of_improvement(np.array([1.0, 2.0]), np.array([1.0, 0.0]))
    0.875
    """
    difference = np.asarray(x, float)[:, None] - np.asarray(y, float)
    return float(np.mean((np.sign(difference) + 1) / 2))


def improvement_interval(
    x: np.ndarray, y: np.ndarray, confidence: float = 0.95, resamples: int = 2000, seed: int = 0
) -> tuple[float, float]:
    """Percentile bootstrap interval of `probability_of_improvement`, resampling the seeds of X and of Y.

    Args:
      x, y, confidence, resamples, seed: as above.

    Returns:
      Lower and upper end.
    """
    x, y, generator = np.asarray(x, float), np.asarray(y, float), np.random.default_rng(seed)
    picks = [generator.integers(len(z), size=(resamples, len(z))) for z in (x, y)]
    draws = [probability_of_improvement(x[i], y[j]) for i, j in zip(*picks, strict=True)]
    low, high = _middle(np.array(draws), confidence)
    return float(low), float(high)


def _middle(draws: np.ndarray, confidence: float) -> tuple[np.ndarray, np.ndarray]:
    """The ends of the interval that holds the middle part of the draws, `[resamples, ...]`."""
    tail = (1 - confidence) / 2
    return np.quantile(draws, tail, axis=0), np.quantile(draws, 1 - tail, axis=0)
