"""Single episodes cut out of a recording, with as many frames as a picture needs."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import numpy as np

from jaxpg.store.names import STEP_SERIES
from jaxpg.store.policies import StoredPolicy
from jaxpg.watch.recording import Look, Recording

STEPS = STEP_SERIES  # series of every episode


class Clip(NamedTuple):
    """F frames of an episode.

    Attributes:
      look: of each frame, `[F, ...]`.
      series: what happens from each frame but the last on, `[F - 1]` by name: the commands, `reward` and `value`.
      so_far: rewards before each frame, summed, `[F]`; those too of the steps between two frames.
      dt: between two frames [s]; the last may come sooner.
      episode_return: of the whole episode, undiscounted.
      success: whether it has ended in success; None where the environment does not say, or says no number.
    """

    look: Look
    series: dict[str, np.ndarray]
    so_far: np.ndarray
    dt: float
    episode_return: float
    success: bool | None


def clip(stored: StoredPolicy, recording: Recording, episode: int, most: int | None = None) -> Clip:
    """One episode of a recording, up to its end.

    Args:
      stored: the policy that plays.
      recording: of it.
      episode: which, from 0.
      most: frames, or one more; where there would be more, only every second, third, ... step is one, and the last.
        None: every step.
    """
    length = int(recording.length[episode])
    every = math.ceil(len(recording.reward) / most) if most else 1
    steps = frames(length, every)
    of_steps = dict(zip(STEPS, (recording.reward, recording.value), strict=True))
    commands = {name: recording.command[..., i] for i, name in enumerate(command_names(stored))}
    success = recording.metrics.get("success")
    ended = np.nan if success is None else float(success[length - 1, episode])
    return Clip(
        look=jax.tree.map(lambda x: x[steps, episode], recording.look),
        series={name: x[steps[:-1], episode] for name, x in (commands | of_steps).items()},
        so_far=np.append(0.0, np.cumsum(recording.reward[:length, episode], dtype=np.float64))[steps],
        dt=every * float(stored.env.dt),
        episode_return=float(recording.episode_return[episode]),
        success=ended > 0 if np.isfinite(ended) else None,
    )


def command_names(stored: StoredPolicy) -> list[str]:
    """The name of each command, which no other series of an episode has; numbers where there are not as many names."""
    size, names = stored.env.action_size, list(stored.interface.commands)
    return names if len(names) == size else [f"action {i + 1}" for i in range(size)]


def limits_of(stored: StoredPolicy) -> np.ndarray:
    """The limit of each command, `[m]`; 1 where they have none, as actions lie within -1 and 1."""
    limits = stored.interface.limits
    return np.ones(stored.env.action_size) if limits is None else np.asarray(limits, float)


def frames(last: int, every: int) -> list[int]:
    """The steps that are shown: every so many from 0 on, and the last one in any case.

    >>> frames(7, 3), frames(6, 3)
    ([0, 3, 6, 7], [0, 3, 6])
    """
    return [*range(0, last, every), last]
