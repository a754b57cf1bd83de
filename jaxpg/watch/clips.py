"""Single episodes cut out of a recording, with as many frames as a picture needs."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import numpy as np

from jaxpg.run.policies import StoredPolicy
from jaxpg.watch.recording import Look, Recording


class Clip(NamedTuple):
    """F frames of an episode.

    Attributes:
      look: of each frame, `[F, ...]`.
      series: what happens from each frame but the last on, `[F - 1]` by name: the commands, `reward` and `value`.
      so_far: rewards before each frame, summed, `[F]`; those too of the steps between two frames.
      dt: between two frames [s]; the last may come sooner.
      episode_return: of the whole episode, undiscounted.
      success: whether it has ended in success; None where the environment does not say.
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
    of_steps = {"reward": recording.reward, "value": recording.value}
    commands = {name: recording.command[..., i] for i, name in enumerate(stored.interface.commands)}
    success = recording.metrics.get("success")
    return Clip(
        look=jax.tree.map(lambda x: x[steps, episode], recording.look),
        series={name: x[steps[:-1], episode] for name, x in (commands | of_steps).items()},
        so_far=np.append(0.0, np.cumsum(recording.reward[:length, episode], dtype=np.float64))[steps],
        dt=every * float(stored.env.dt),
        episode_return=float(recording.episode_return[episode]),
        success=None if success is None else bool(success[length - 1, episode] > 0),
    )


def frames(last: int, every: int) -> list[int]:
    """The steps that are shown: every so many from 0 on, and the last one in any case.

    >>> frames(7, 3), frames(6, 3)
    ([0, 3, 6, 7], [0, 3, 6])
    """
    return [*range(0, last, every), last]
