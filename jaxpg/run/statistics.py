"""Aggregates over seeds: the interquartile mean and its bootstrap interval."""

from __future__ import annotations

import numpy as np


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
    means = np.stack([interquartile_mean(scores[draw]) for draw in draws])
    tail = (1 - confidence) / 2
    return np.quantile(means, tail, axis=0), np.quantile(means, 1 - tail, axis=0)
