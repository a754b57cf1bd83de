"""Episodes of a run's policy, side by side in one video."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import jax
import numpy as np

from envs.scenes import Scene
from jaxpg.config.command_options import RenderOptions
from jaxpg.errors import UserError
from jaxpg.program.agents import described
from jaxpg.store import folder, policies
from jaxpg.store.cache import compilation_cache, physics_cache
from jaxpg.store.policies import StoredPolicy
from jaxpg.watch import gl, movie
from jaxpg.watch.clips import Clip, clip, command_names, frames, limits_of
from jaxpg.watch.recording import record
from jaxpg.watch.seen import seen
from jaxpg.watch.untrained import untrained

LARGEST = 8192  # pixels of an image, either way
FINEST = 10_000  # of the denominator of pictures a second
ROUNDING = 1e-6  # 0.05 s are 20 steps a second, although the float is not quite 1/20


def render(options: RenderOptions, changes: Mapping[str, Any], say: Callable[[str], None]) -> None:
    """Writes the video of a stored policy.

    Args:
      options: of the command.
      changes: to options of the environment.
      say: takes lines of what was written.

    Raises:
      UserError: no such run or policy; its environment has nothing to be seen; no OpenGL to draw with; a package is
        missing; or the video cannot be written. Nothing is written then.
    """
    out = Path(options.out or Path(options.run) / "video.mp4")
    form = movie.chosen(out)
    folder.find(options.run)
    _check_size(options)
    backend = gl.backend(os.environ, gl.works)
    with physics_cache(options.cache):
        stored = _stored(options, changes)
    with compilation_cache(options.cache, say):
        clips = played(stored, options.episodes, options.seed)
    every, seconds = pace(clips[0].dt, options.speed, min(options.fps, form.fastest))
    movie.write(out, images(stored, clips, every, (options.width, options.height), backend), seconds)
    number = len(shown(clips, every))
    returns = " ".join(f"{one.episode_return:.1f}" for one in clips)
    say(f"{described(stored.config)}, {stored.described(options.checkpoint)}")
    say(f"returns  {returns}")
    say(f"{out}  {number} pictures, {float(number * seconds):.2f} s at {float(1 / seconds):.4g} a second")


def _check_size(options: RenderOptions) -> None:
    for name in ("width", "height"):
        if getattr(options, name) % 2:
            raise UserError(f"{name}={getattr(options, name)}: must be even, as H.264 has pixels in pairs")
    rows, columns = grid(options.episodes)
    width, height = columns * options.width, rows * options.height
    if max(width, height) > LARGEST:
        raise UserError(
            f"{options.episodes} episodes of {options.width} x {options.height} are {width} x {height} pixels, "
            f"more than {LARGEST}: make width and height smaller, or episodes fewer"
        )


def grid(number: int) -> tuple[int, int]:
    """Rows and columns of the squarest grid with so many places, no more rows than columns.

    >>> [grid(n) for n in (1, 2, 3, 4, 5, 12)]
    [(1, 1), (1, 2), (2, 2), (2, 2), (2, 3), (3, 4)]
    """
    columns = math.ceil(math.sqrt(number))
    return math.ceil(number / columns), columns


def _stored(options: RenderOptions, changes: Mapping[str, Any]) -> StoredPolicy:
    saved = "best" if options.checkpoint == "untrained" else options.checkpoint
    stored = policies.load(options.run, saved, options.agent, changes)
    notes: list[str] = []
    if seen(stored.env, notes.append).scene is None:
        why = f": {'; '.join(notes)}" if notes else " is no robot: there is nothing to be seen of it"
        raise UserError(f"env={stored.config.choices['env']}{why}")
    return untrained(stored) if options.checkpoint == "untrained" else stored


def played(stored: StoredPolicy, number: int, seed: int) -> list[Clip]:
    """Episodes from the starts of an evaluation with as many episodes and this seed, every step of each."""
    (recording,) = record(stored, [stored.policy], jax.random.split(jax.random.key(seed), number))
    return [clip(stored, recording, episode) for episode in range(number)]


def pace(dt: float, speed: float, most: int) -> tuple[int, Fraction]:
    """Every how many steps one is shown, and for how long [s].

    Args:
      dt: time of a step [s].
      speed: of the video; 1 is real time.
      most: pictures a second.

    >>> pace(0.05, 1.0, 60), pace(0.005, 1.0, 60)
    ((1, Fraction(1, 20)), (4, Fraction(1, 50)))
    """
    every = max(1, math.ceil(speed / (dt * most) - ROUNDING))
    return every, 1 / Fraction(speed / (dt * every)).limit_denominator(FINEST)


def shown(clips: Sequence[Clip], every: int) -> list[int]:
    """The steps that are shown: up to the last one of the longest episode, that one included."""
    return frames(max(len(one.look.qpos) for one in clips) - 1, every)


def images(
    stored: StoredPolicy, clips: Sequence[Clip], every: int, size: tuple[int, int], backend: str
) -> Iterator[np.ndarray]:
    """The images of the video, `[H, W, 3]`.

    Args:
      stored: the policy that plays.
      clips: of episodes with every step.
      every: how many steps one is shown.
      size: width and height of one episode's picture.
      backend: as `gl.backend` finds it.
    """
    from jaxpg.watch.canvas import Canvas

    view = seen(stored.env).scene
    with Canvas(view.model, backend, grid(len(clips)), size, view.goal_radius) as canvas:
        for step in shown(clips, every):
            yield canvas.draw([cell(stored, view, one, step) for one in clips])


def cell(stored: StoredPolicy, view: Scene, one: Clip, step: int) -> Any:
    """What is drawn of an episode at a step; after its end, what it ended with."""
    from jaxpg.watch.canvas import Cell

    last, names = len(one.look.qpos) - 1, command_names(stored)
    now = min(step, last)
    commands = np.array([one.series[name][now] if now < last else 0.0 for name in names])
    efforts = commands / limits_of(stored) if len(names) == view.model.nu else np.zeros(view.model.nu)
    goal = None if one.look.goal is None else one.look.goal[now]
    return Cell(one.look.qpos[now], goal, efforts, _caption(one, now, last))


def _caption(one: Clip, now: int, last: int) -> str:
    text = f"{now * one.dt:.2f} s  return {one.so_far[now]:.1f}"
    if now == last and one.success is not None:
        text += "  success" if one.success else "  missed"
    return text
