"""How smooth a controller's commands are: what a good return hides, and what wears motors out."""

from __future__ import annotations

import numpy as np

NEAR = 0.99  # of its limit: a squashed command never gets quite there


def chatter(command: np.ndarray, limits: np.ndarray, length: np.ndarray) -> np.ndarray:
    """How far commands jump from one step to the next.

        C = 1 / ((T - 1) m) sum_{t >= 1, i} |u_{t,i} - u_{t-1,i}| / (2 limit_i)

    0 where they stand still, 1 where all jump from limit to limit at every step. What is beyond a limit counts as it.

    Args:
      command: u, `[T, N, m]`.
      limits: `[m]`, in its units.
      length: steps of each episode, `[N]`.

    Returns:
      C of each episode, `[N]`; NaN of one with a single step.
    """
    effort = np.clip(np.asarray(command, float) / limits, -1.0, 1.0)
    return _mean(np.abs(np.diff(effort, axis=0)) / 2, length - 1)


def share_at_limit(command: np.ndarray, limits: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Share of steps and commands that are at a limit, `|u| >= 0.99 limit`: `[N]`.

    Args:
      command, limits, length: as above.
    """
    return _mean((np.abs(np.asarray(command, float)) >= NEAR * np.asarray(limits)) * 1.0, length)


def _mean(values: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Over the first steps of each episode and over all commands, `[T, N, m]` to `[N]`; NaN where there are none."""
    counts = np.arange(len(values))[:, None] < length
    sums = np.sum(np.where(counts[..., None], values, 0.0), axis=(0, 2))
    return np.where(length > 0, sums / np.maximum(length * values.shape[2], 1), np.nan)
