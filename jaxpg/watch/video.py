"""Renders episodes of a run's policy, side by side, as a video."""

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
from jaxpg.program.agents import describe_run
from jaxpg.store import folder, policies
from jaxpg.store.cache import compilation_cache, physics_cache
from jaxpg.store.policies import StoredPolicy
from jaxpg.watch import gl, movie
from jaxpg.watch.clips import Clip, find_command_names, find_limits, frame_steps, make_clip
from jaxpg.watch.recording import record
from jaxpg.watch.untrained import make_untrained
from jaxpg.watch.view import find_view

MAX_PIXELS = 8192  # of an image's width and height
MAX_DENOMINATOR = 10_000  # of the frame rate as a fraction
ROUNDING = 1e-6  # 0.05 s are 20 steps a second, although the float is not exactly 1/20


def render(options: RenderOptions, changes: Mapping[str, Any], say: Callable[[str], None]) -> None:
    """Writes the video of a stored policy.

    Args:
      options: options of the command.
      changes: changed options of the environment.
      say: takes lines for the user.

    Raises:
      UserError: there is no such run or policy, the environment cannot be drawn, OpenGL or a package is missing, or the
        video cannot be written. Nothing is written then.
    """
    assert options.run is not None  # the command has asked for it
    out = Path(options.out or Path(options.run) / "video.mp4")
    format_ = movie.find_format(out)
    folder.find(options.run)
    _check_size(options)
    backend = gl.find_backend(os.environ, gl.is_working)
    if backend is None:
        remedy = " or ".join(gl.INSTALL.values())
        say(f"note: there is no OpenGL, so the video is drawn in a simpler way; for MuJoCo's renderer: {remedy}")
    with physics_cache(options.cache):
        stored = load_drawable(options.run, options.checkpoint, options.agent, changes)
    with compilation_cache(options.cache, say):
        clips = play_clips(stored, options.episodes, options.seed)
    interval, seconds = choose_pace(clips[0].dt, options.speed, min(options.fps, format_.fastest))
    movie.write(out, draw_images(stored, clips, interval, (options.width, options.height), backend), seconds)
    number = len(shown_steps(clips, interval))
    returns = " ".join(f"{one.episode_return:.1f}" for one in clips)
    say(f"{describe_run(stored.config)}, {stored.describe(options.checkpoint)}")
    say(f"returns  {returns}")
    say(f"{out}  {number} pictures, {float(number * seconds):.2f} s at {float(1 / seconds):.4g} a second")


def _check_size(options: RenderOptions) -> None:
    for name in ("width", "height"):
        if getattr(options, name) % 2:
            raise UserError(f"{name}={getattr(options, name)}: must be even, as H.264 has pixels in pairs")
    rows, columns = choose_grid(options.episodes)
    width, height = columns * options.width, rows * options.height
    if max(width, height) > MAX_PIXELS:
        raise UserError(
            f"{options.episodes} episodes of {options.width} x {options.height} are {width} x {height} pixels, "
            f"more than {MAX_PIXELS}: make width and height smaller, or episodes fewer"
        )


def choose_grid(number: int) -> tuple[int, int]:
    """Rows and columns of the squarest grid for `number` pictures, with no more rows than columns.

    >>> [choose_grid(n) for n in (1, 2, 3, 4, 5, 12)]
    [(1, 1), (1, 2), (2, 2), (2, 2), (2, 3), (3, 4)]
    """
    columns = math.ceil(math.sqrt(number))
    return math.ceil(number / columns), columns


def load_drawable(run: str, checkpoint: str, agent: int | None, changes: Mapping[str, Any]) -> StoredPolicy:
    """A policy of a run whose environment can be drawn.

    Args:
      run: the run folder.
      checkpoint: "best", "last" or "untrained".
      agent: index of the agent, from 0; None takes the best.
      changes: changed options of the environment.

    Raises:
      UserError: there is no such run or policy, or its environment cannot be drawn.
    """
    stored = policies.load(run, "best" if checkpoint == "untrained" else checkpoint, agent, changes)
    notes: list[str] = []
    if find_view(stored.env, notes.append).scene is None:
        reason = f": {'; '.join(notes)}" if notes else " has no robot that could be drawn"
        raise UserError(f"env={stored.config.choices['env']}{reason}")
    return make_untrained(stored) if checkpoint == "untrained" else stored


def play_clips(stored: StoredPolicy, number: int, seed: int) -> list[Clip]:
    """Every step of episodes from the starts of an evaluation with this number of episodes and this seed."""
    (recording,) = record(stored, [stored.policy], jax.random.split(jax.random.key(seed), number))
    return [make_clip(stored, recording, episode) for episode in range(number)]


def choose_pace(dt: float, speed: float, most: int) -> tuple[int, Fraction]:
    """Number of steps from one picture to the next, and how long a picture is shown [s].

    Args:
      dt: time of a step [s].
      speed: speed of the video; 1 is real time.
      most: highest number of pictures per second.

    >>> choose_pace(0.05, 1.0, 60), choose_pace(0.005, 1.0, 60)
    ((1, Fraction(1, 20)), (4, Fraction(1, 50)))
    """
    interval = max(1, math.ceil(speed / (dt * most) - ROUNDING))
    return interval, 1 / Fraction(speed / (dt * interval)).limit_denominator(MAX_DENOMINATOR)


def shown_steps(clips: Sequence[Clip], interval: int) -> list[int]:
    """The steps that are shown, up to and including the last one of the longest episode."""
    return frame_steps(max(len(one.look.qpos) for one in clips) - 1, interval)


def draw_images(
    stored: StoredPolicy, clips: Sequence[Clip], interval: int, size: tuple[int, int], backend: str | None
) -> Iterator[np.ndarray]:
    """The images of the video, `[H, W, 3]`.

    Args:
      stored: the policy that plays.
      clips: episodes with every step.
      interval: number of steps from one picture to the next.
      size: width and height of one episode's picture.
      backend: from `gl.find_backend`; None draws without OpenGL.
    """
    from jaxpg.watch import solids, space
    from jaxpg.watch.canvas import Canvas
    from jaxpg.watch.sketch import Sketch

    scene = find_view(stored.env).scene
    assert scene is not None  # or its policy would not have been loaded
    parts = solids.make_parts(scene.model)
    framing = space.make_framing(scene.model, parts, [one.look for one in clips])
    shifts = [space.find_shifts(scene.model, parts, one.look.qpos, framing) for one in clips]
    grid, marks = choose_grid(len(clips)), (scene.goal_radius, scene.site, framing)
    tool = (
        Sketch(scene.model, grid, size, *marks) if backend is None else Canvas(scene.model, backend, grid, size, *marks)
    )
    with tool as canvas:
        for step in shown_steps(clips, interval):
            cells = zip(clips, shifts, strict=True)
            yield canvas.draw([make_cell(stored, scene, one, step, shift) for one, shift in cells])


def make_cell(stored: StoredPolicy, scene: Scene, one: Clip, step: int, shifts: np.ndarray | None = None) -> Any:
    """The picture of an episode at a step; after its end, the last one.

    Args:
      stored, scene: the policy that plays and its robot.
      one: the episode.
      step: number of the step, from 0.
      shifts: what is added to the centre of the picture at each step, `[F, 3]` [m], or None.
    """
    from jaxpg.watch.canvas import Cell

    last, names = len(one.look.qpos) - 1, find_command_names(stored)
    current = min(step, last)
    commands = np.array([one.series[name][current] if current < last else 0.0 for name in names])
    efforts = commands / find_limits(stored) if len(names) == scene.model.nu else np.zeros(scene.model.nu)
    goal, rotation, shift = (None if x is None else x[current] for x in (one.look.goal, one.look.rotation, shifts))
    return Cell(one.look.qpos[current], goal, efforts, _make_caption(one, current, last), rotation, shift)


def _make_caption(one: Clip, current: int, last: int) -> str:
    text = f"{current * one.dt:.2f} s  return {one.so_far[current]:.1f}"
    if current == last and one.success is not None:
        text += "  success" if one.success else "  missed"
    return text
