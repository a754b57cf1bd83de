"""Cuts single episodes out of a recording, with as many frames as needed."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import numpy as np

from envs.scenes import find_time_step
from jaxpg.store.names import STEP_SERIES
from jaxpg.store.policies import StoredPolicy
from jaxpg.watch.recording import Look, Recording

STEPS = STEP_SERIES  # series of every episode


class Clip(NamedTuple):
    """F frames of an episode.

    Attributes:
      look: look of each frame, `[F, ...]`.
      series: the commands, `reward` and `value` at each frame but the last, `[F - 1]` by name.
      so_far: sum of all rewards before each frame, `[F]`, including those of steps between frames.
      dt: time between two frames [s]; the last may come sooner.
      episode_return: undiscounted return of the whole episode.
      success: whether it ended in success; None if the environment does not say.
    """

    look: Look
    series: dict[str, np.ndarray]
    so_far: np.ndarray
    dt: float
    episode_return: float
    success: bool | None


def make_clip(stored: StoredPolicy, recording: Recording, episode: int, most: int | None = None) -> Clip:
    """One episode of a recording, up to its end.

    Args:
      stored: the policy that plays.
      recording: a recording of it.
      episode: index of the episode, from 0.
      most: number of frames, which may be exceeded by one; longer episodes keep every second, third, ... step and the
        last one. None keeps every step.
    """
    length = int(recording.length[episode])
    interval = math.ceil(len(recording.reward) / most) if most else 1
    steps = frame_steps(length, interval)
    step_series = dict(zip(STEPS, (recording.reward, recording.value), strict=True))
    commands = {name: recording.command[..., i] for i, name in enumerate(find_command_names(stored))}
    success = recording.metrics.get("success")
    success_at_end = np.nan if success is None else float(success[length - 1, episode])
    return Clip(
        look=jax.tree.map(lambda x: x[steps, episode], recording.look),
        series={name: x[steps[:-1], episode] for name, x in (commands | step_series).items()},
        so_far=np.append(0.0, np.cumsum(recording.reward[:length, episode], dtype=np.float64))[steps],
        dt=interval * find_time_step(stored.env),
        episode_return=float(recording.episode_return[episode]),
        success=success_at_end > 0 if np.isfinite(success_at_end) else None,
    )


def find_command_names(stored: StoredPolicy) -> list[str]:
    """The name of each command, unique among the series; numbered if the number of names does not match."""
    size, names = stored.env.action_size, list(stored.interface.commands)
    return names if len(names) == size else [f"action {i + 1}" for i in range(size)]


def find_limits(stored: StoredPolicy) -> np.ndarray:
    """The limit of each command, `[m]`; 1 if there is none, as actions lie within -1 and 1."""
    limits = stored.interface.limits
    return np.ones(stored.env.action_size) if limits is None else np.asarray(limits, float)


def list_limits(stored: StoredPolicy) -> dict[str, float]:
    """The limit of each command, by name; empty if there are none."""
    if stored.interface.limits is None:
        return {}
    return dict(zip(find_command_names(stored), find_limits(stored).tolist(), strict=True))


def frame_steps(last: int, interval: int) -> list[int]:
    """The steps that are shown: every `interval`-th from 0 on, and always the last one.

    >>> frame_steps(7, 3), frame_steps(6, 3)
    ([0, 3, 6, 7], [0, 3, 6])
    """
    return [*range(0, last, interval), last]
