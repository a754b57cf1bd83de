"""Plays episodes of a stored policy in MuJoCo's interactive viewer, in real time.

The episodes are played by the environment beforehand, as for a video; the viewer shows them one after the other, again
and again, until its window is closed. So what is seen is what was trained on, whatever steps its physics.
"""

from __future__ import annotations

import dataclasses
import importlib
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from envs.scenes import Scene
from jaxpg.config.command_options import ViewOptions
from jaxpg.errors import UserError
from jaxpg.program.agents import describe_run
from jaxpg.store import folder
from jaxpg.store.cache import compilation_cache, physics_cache
from jaxpg.watch.clips import Clip, frame_steps
from jaxpg.watch.video import choose_pace, load_drawable, play_clips
from jaxpg.watch.view import find_view

FASTEST = 60  # pictures a second
REST = 1.0  # how long the end of an episode is seen [s]
NAP = 0.02  # between two looks at the keyboard while paused [s]
SPACE, BEFORE, AFTER = 32, 91, 93  # GLFW's numbers of the keys: space bar, [ and ]
GRID = (0.15, 0.16, 0.18, 1.0)  # on the viewer's black
VIDEO = "python -m jaxpg.render run=DIR makes a video without one"


def show(options: ViewOptions, changes: Mapping[str, Any], say: Callable[[str], None]) -> None:
    """Opens the viewer with a stored policy, and returns when its window is closed.

    Args:
      options: options of the command.
      changes: changed options of the environment.
      say: takes lines for the user.

    Raises:
      UserError: there is no screen, no such run or policy, or the environment cannot be drawn. The screen and the run
        folder are looked for before anything slow.
    """
    assert options.run is not None  # the command has asked for it
    folder.find(options.run)
    check_screen(os.environ)
    launch = find_launcher()
    with physics_cache(options.cache):
        stored = load_drawable(options.run, options.checkpoint, options.agent, changes)
    scene = find_view(stored.env).scene
    assert scene is not None  # or its policy would not have been loaded
    with compilation_cache(options.cache, say):
        clips = play_clips(stored, options.episodes, options.seed)
    say(f"{describe_run(stored.config)}, {stored.describe(options.checkpoint)}")
    say("space bar: pause; [ and ]: episode; close the window to end")
    play(launch, scene, clips, options.speed)


def check_screen(environment: Mapping[str, str], system: str = sys.platform) -> None:
    """Raises UserError if the environment variables say that there is no screen, as over ssh."""
    if system == "linux" and not (environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY")):
        raise UserError(f"there is no screen, neither DISPLAY nor WAYLAND_DISPLAY is set; {VIDEO}")


def find_launcher() -> Callable[..., Any]:
    """`mujoco.viewer.launch_passive`, after a window was opened, unseen, to see whether that works.

    Raises:
      UserError: no window can be opened.
    """
    try:
        viewer = importlib.import_module("mujoco.viewer")
        glfw = importlib.import_module("glfw")
    except (ImportError, RuntimeError) as error:  # GLFW's package or its library is missing
        raise UserError(f"no window can be opened: {' '.join(str(error).split())}; {VIDEO}") from error
    if sys.platform != "darwin" and not _opens_window(glfw):  # on a Mac only the main thread of mjpython may
        raise UserError(f"no window can be opened on this screen; {VIDEO}")
    return viewer.launch_passive


def _opens_window(glfw: Any) -> bool:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # GLFW says there what is wrong
        if not glfw.init():
            return False
        glfw.window_hint(glfw.VISIBLE, glfw.FALSE)
        works = bool(glfw.create_window(16, 16, "", None, None))
        glfw.terminate()
    return works


@dataclasses.dataclass
class Remote:
    """What the keys have asked for.

    Attributes:
      paused: whether time stands still.
      jump: how many episodes to go on, or back; 0 for none.
    """

    paused: bool = False
    jump: int = 0

    def press(self, key: int) -> None:
        """Takes GLFW's number of a key; called by the viewer's thread."""
        if key == SPACE:
            self.paused = not self.paused
        elif key in (BEFORE, AFTER):
            self.jump = 1 if key == AFTER else -1


def play(launch: Callable[..., Any], scene: Scene, clips: Sequence[Clip], speed: float) -> None:
    """Shows episodes with every step, one after the other, until the window is closed.

    Args:
      launch: as `mujoco.viewer.launch_passive`.
      scene: the robot.
      clips: the episodes.
      speed: 1 is real time.

    Raises:
      UserError: the viewer does not start.
    """
    import mujoco

    remote, data = Remote(), mujoco.MjData(scene.model)
    interval, seconds = choose_pace(clips[0].dt, speed, FASTEST)
    try:
        handle = launch(scene.model, data, key_callback=remote.press, show_left_ui=False, show_right_ui=False)
    except RuntimeError as error:  # on a Mac it must be run by mjpython
        raise UserError(f"no window can be opened: {' '.join(str(error).split())}") from error
    with handle:
        draw = _make_painter(handle, scene, data, clips)
        number = 0
        while handle.is_running():
            for step in _keep_time(
                handle, remote, frame_steps(len(clips[number].so_far) - 1, interval), float(seconds)
            ):
                draw(number, step)
            number = (number + (remote.jump or 1)) % len(clips)
            remote.jump = 0


def _keep_time(handle: Any, remote: Remote, steps: Sequence[int], seconds: float) -> Iterator[int]:
    """The steps, each when its time has come, until the window is closed or another episode is asked for."""
    due = time.monotonic()
    for step in steps:
        yield step
        due += REST if step == steps[-1] else seconds
        while handle.is_running() and not remote.jump and (remote.paused or time.monotonic() < due):
            if remote.paused:
                due = time.monotonic() + seconds
            time.sleep(max(0.0, min(NAP, due - time.monotonic())))
        if remote.jump or not handle.is_running():
            return


def _make_painter(handle: Any, scene: Scene, data: Any, clips: Sequence[Clip]) -> Callable[[int, int], None]:
    """`draw(number, step)` shows a step of an episode."""
    import mujoco

    from jaxpg.watch import marks, solids, space

    model = scene.model
    parts, bones = solids.make_parts(model), solids.find_bones(model)
    framing = space.make_framing(model, parts, [clip.look for clip in clips])
    shifts = [space.find_shifts(model, parts, clip.look.qpos, framing) for clip in clips]
    _aim(handle, model, framing)

    def draw(number: int, step: int) -> None:
        clip, shift = clips[number], shifts[number]
        with handle.lock():
            center = framing.center + (0.0 if shift is None else shift[step])
            _pose(handle, scene, data, clip, step, framing.radius)
            marks.draw_bones(handle.user_scn, data, bones)
            if not np.any(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
                marks.draw_grid(handle.user_scn, framing, center, GRID)
            if shift is not None:
                handle.cam.lookat[:] = center
        handle.set_texts(_make_caption(clip, number, len(clips), step))
        handle.sync()

    return draw


def _aim(handle: Any, model: Any, framing: Any) -> None:
    """Points the viewer's camera at the episodes; it can be turned with the mouse from there."""
    distance = framing.radius / np.sin(np.deg2rad(float(model.vis.global_.fovy)) / 2)
    with handle.lock():
        handle.cam.lookat[:] = framing.center
        handle.cam.distance, handle.cam.azimuth, handle.cam.elevation = distance, framing.azimuth, framing.elevation


def _pose(handle: Any, scene: Scene, data: Any, clip: Clip, step: int, size: float) -> None:
    """Moves the robot and the goal to a step."""
    import mujoco

    from jaxpg.watch import marks

    look, model = clip.look, scene.model
    if np.isfinite(look.qpos[step]).all():
        data.qpos[:] = look.qpos[step]
    data.time = step * clip.dt
    mujoco.mj_fwdPosition(model, data)
    handle.user_scn.ngeom = 0
    if look.goal is not None and np.isfinite(look.goal[step]).all():
        radius = float(scene.goal_radius or marks.DOT * model.stat.extent)
        rotation = None if look.rotation is None else look.rotation[step]
        frames = marks.list_frames(data, look.goal[step], rotation, scene.site, size, radius)
        marks.draw_goal(handle.user_scn, look.goal[step], radius, frames)


def _make_caption(clip: Clip, number: int, of: int, step: int) -> tuple[int, int, str, str]:
    """A text for the viewer: its font, its corner, and two columns."""
    import mujoco

    names, values = ["episode", "time", "return"], [f"{number + 1} of {of}", f"{step * clip.dt:.2f} s"]
    values.append(f"{clip.so_far[step]:.1f}")
    if step == len(clip.so_far) - 1 and clip.success is not None:
        names.append("end")
        values.append("success" if clip.success else "missed")
    corner = (int(mujoco.mjtFontScale.mjFONTSCALE_150), int(mujoco.mjtGridPos.mjGRID_TOPLEFT))
    return (*corner, "\n".join(names), "\n".join(values))
