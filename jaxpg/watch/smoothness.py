"""Measures how smooth a controller's commands are: a good return may hide what wears out motors."""

from __future__ import annotations

import numpy as np

NEAR = 0.99  # times its limit, which a squashed command never quite reaches


def chatter(command: np.ndarray, limits: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Mean jump of the commands from one step to the next.

        C = 1 / ((T - 1) m) sum_{t >= 1, i} |u_{t,i} - u_{t-1,i}| / (2 limit_i)

    0 if they are constant, 1 if all jump from limit to limit at every step. Commands are clipped to the limits.

    Args:
      command: u, `[T, N, m]`.
      limits: `[m]`, in units of the command.
      length: steps of each episode, `[N]`.

    Returns:
      C of each episode, `[N]`; NaN for an episode of a single step.
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
    """Mean over the first `length` steps of each episode and over all commands, `[T, N, m]` to `[N]`; NaN if none."""
    counts = np.arange(len(values))[:, None] < length
    sums = np.sum(np.where(counts[..., None], values, 0.0), axis=(0, 2))
    return np.where(length > 0, sums / np.maximum(length * values.shape[2], 1), np.nan)
