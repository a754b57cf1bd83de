"""A grid of pictures by MuJoCo's renderer: the robot, its goal, and the efforts of its motors."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from jaxpg.watch import gl
from jaxpg.watch.drawing import find_camera, find_geoms
from jaxpg.watch.marks import DOT, add_geom, connect, draw_bones, draw_goal, draw_grid, list_frames
from jaxpg.watch.solids import find_bones, find_color
from jaxpg.watch.space import Framing, make_axes

POSITIVE = (0.95, 0.55, 0.05, 1.0)  # efforts: right-handed about the axis, or along it
NEGATIVE = (0.55, 0.25, 0.75, 1.0)
FULL_SWEEP = 1.5 * math.pi  # of an arc at effort 1 [rad]
MIN_EFFORT = 0.02  # smaller efforts are not drawn
ARC_STEP = math.pi / 12  # between two points of an arc [rad]
ARC, THICK, FRONT = 0.5, 0.07, 0.2  # an arc's radius, width and distance from its joint, times the model's mean size
BACKDROP, GRID = (
    (0.95, 0.96, 0.98),
    (0.8, 0.83, 0.87, 1.0),
)  # behind models without a sky, and below those without a floor
HEADLIGHT = (0.3, 0.6)  # ambient and diffuse, for models without lights
GLOW = 100.0  # a material that shines this many times its colour looks the same in all lights
BORDER, EMPTY = 255, (0.5, 0.5, 0.5, 1.0)  # colours between the pictures and of empty places of the grid


class Cell(NamedTuple):
    """One picture.

    Attributes:
      qpos: joint positions, `[nq]`.
      goal: position of the goal, `[3]` [m], or None.
      efforts: the command of each actuator as a fraction of its limit, `[nu]`.
      caption: a line of text.
      rotation: orientation of the goal, `[3, 3]`, or None.
      shift: what is added to the framing's centre, `[3]` [m], or None.
    """

    qpos: np.ndarray
    goal: np.ndarray | None
    efforts: np.ndarray
    caption: str
    rotation: np.ndarray | None = None
    shift: np.ndarray | None = None


class Canvas:
    """Draws pictures side by side into one image; a context manager, which frees its OpenGL context.

    Args:
      model: `mujoco.MjModel`, seen by the camera of `drawing.find_camera` if it has one.
      backend: from `gl.find_backend`.
      grid: number of rows and columns.
      size: width and height of one picture [pixels].
      goal_radius: radius of the sphere that marks the goal [m].
      site: index of the site whose frame should become the goal's.
      framing: how a model without a camera is seen; None: like in MuJoCo's viewer at its start.
    """

    def __init__(
        self,
        model: Any,
        backend: str,
        grid: tuple[int, int],
        size: tuple[int, int],
        goal_radius: float | None = None,
        site: int | None = None,
        framing: Framing | None = None,
    ):
        self._fixed, self._framing, self._site = find_camera(model), framing, site
        self._fovy = float(model.vis.global_.fovy)
        (self.rows, self.columns), (width, height) = grid, size
        self._width, self._height, self._goal_radius = width, height, goal_radius
        self._model = _prepare(model, self.columns * width, self.rows * height, height / width)
        self._data = mujoco.MjData(self._model)
        self._motors, self._bones = find_motors(self._model), find_bones(self._model)
        self._gl = gl.make_context(backend, self.columns * width, self.rows * height)
        self._scene, self._options = mujoco.MjvScene(self._model, maxgeom=10_000), _make_options(self._model)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False  # on a CPU they would take most of the time
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)

    def __enter__(self) -> Canvas:
        return self

    def __exit__(self, *exception: object) -> None:
        self._gl.make_current()
        self._context.free()
        self._gl.free()
        del self._gl  # OSMesa's frees itself again, which fails at the interpreter's exit

    def draw(self, cells: Sequence[Cell]) -> np.ndarray:
        """Image `[rows * height, columns * width, 3]`: the first picture is at the top left, the next to its right."""
        self._gl.make_current()  # another canvas may be current
        whole = mujoco.MjrRect(0, 0, self.columns * self._width, self.rows * self._height)
        mujoco.mjr_rectangle(whole, *EMPTY)
        for i, cell in enumerate(cells):
            self._draw(cell, self._place(i))
        image = np.empty((whole.height, whole.width, 3), np.uint8)
        mujoco.mjr_readPixels(image, None, whole, self._context)
        image = image[::-1]  # OpenGL's first row is the bottom
        image[self._height :: self._height] = BORDER
        image[:, self._width :: self._width] = BORDER
        return image

    def _place(self, i: int) -> Any:
        row, column = divmod(i, self.columns)
        return mujoco.MjrRect(column * self._width, (self.rows - 1 - row) * self._height, self._width, self._height)

    def _draw(self, cell: Cell, place: Any) -> None:
        model, data, scene = self._model, self._data, self._scene
        data.qpos = cell.qpos
        mujoco.mj_fwdPosition(model, data)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, self._options, None, self._make_camera(cell.shift), everything, scene)
        draw_bones(scene, data, self._bones)
        if self._fixed is None and self._framing is not None:
            self._draw_surroundings(self._framing, cell.shift)
        if cell.goal is not None:
            radius = self._goal_radius or DOT * float(model.stat.extent)
            size = self._framing.radius if self._framing is not None else float(model.stat.extent)
            draw_goal(scene, cell.goal, radius, list_frames(data, cell.goal, cell.rotation, self._site, size, radius))
        for motor in self._motors:
            _draw_effort(scene, model, data, motor, float(np.clip(cell.efforts[motor], -1, 1)))
        mujoco.mjr_render(place, scene, self._context)
        if not cell.caption:
            return
        font, corner = mujoco.mjtFont.mjFONT_NORMAL, mujoco.mjtGridPos.mjGRID_TOPLEFT
        mujoco.mjr_overlay(font, corner, place, cell.caption, "", self._context)

    def _make_camera(self, shift: np.ndarray | None) -> Any:
        camera = mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(self._model, camera)
        if self._fixed is not None:
            camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, self._fixed
        elif self._framing is not None:
            framing = self._framing
            camera.lookat[:] = framing.center + (0.0 if shift is None else shift)
            camera.distance = framing.radius / math.sin(math.radians(self._fovy) / 2)
            camera.azimuth, camera.elevation = framing.azimuth, framing.elevation
        return camera

    def _draw_surroundings(self, framing: Framing, shift: np.ndarray | None) -> None:
        """Something light behind a model without a sky, and a grid below one without a floor."""
        model, scene, center = self._model, self._scene, framing.center + (0.0 if shift is None else shift)
        if not np.any(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX):
            axes, distance = make_axes(framing.azimuth, framing.elevation), 4 * framing.radius
            geom = add_geom(
                scene, mujoco.mjtGeom.mjGEOM_BOX, center - distance * axes[2], 0.0, (*np.array(BACKDROP) / GLOW, 1.0)
            )
            if geom is not None:
                geom.size[:] = 20 * distance, 20 * distance, 0.01 * distance
                geom.mat[:] = axes.T
                geom.emission, geom.specular = GLOW, 0.0
        if not np.any(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
            draw_grid(scene, framing, center, GRID)


def _prepare(model: Any, width: int, height: int, ratio: float) -> Any:
    """A copy for images of this size; the field of view is widened if the pictures are upright (ratio above 1)."""
    model = copy.copy(model)
    model.vis.quality.numslices = 16  # of round shapes: enough for small pictures, and faster
    if model.nlight == 0:  # the viewer's own is weak
        model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = HEADLIGHT
    for geom in find_geoms(model):
        model.geom_rgba[geom] = find_color(model, geom)
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    if ratio > 1:
        model.vis.global_.fovy = _widen(model.vis.global_.fovy, ratio)
        model.cam_fovy[:] = _widen(model.cam_fovy, ratio)
    return model


def _make_options(model: Any) -> Any:
    """Draws all geoms if none is visible, and the bodies' inertias if there are no geoms."""
    options, geoms = mujoco.MjvOption(), find_geoms(model)
    options.geomgroup[np.minimum(model.geom_group[geoms], len(options.geomgroup) - 1)] = 1
    options.flags[mujoco.mjtVisFlag.mjVIS_INERTIA] = not geoms
    return options


def _widen(fovy: Any, ratio: float) -> Any:
    return 2 * np.rad2deg(np.arctan(ratio * np.tan(np.deg2rad(fovy) / 2)))


def find_motors(model: Any) -> list[int]:
    """The actuators of a hinge or a slide joint."""
    kinds = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    of_joints = [i for i, kind in enumerate(model.actuator_trntype) if kind == mujoco.mjtTrn.mjTRN_JOINT]
    return [i for i in of_joints if model.jnt_type[model.actuator_trnid[i, 0]] in kinds]


def _draw_effort(scene: Any, model: Any, data: Any, motor: int, effort: float) -> None:
    """Draws an arc about a hinge or an arrow along a slide, with its length proportional to the effort."""
    eye, top = (np.mean([getattr(scene.camera[i], name) for i in range(2)], axis=0) for name in ("pos", "up"))
    points = effort_points(model, data, motor, effort, eye, top)
    if points is not None:
        _draw_line(scene, points, THICK * model.stat.meansize, effort_color(effort), eye)


def effort_color(effort: float) -> tuple[float, ...]:
    """Red, green, blue and opacity of an effort: amber where it is positive, violet where it is negative."""
    return POSITIVE if effort > 0 else NEGATIVE


def effort_points(
    model: Any, data: Any, motor: int, effort: float, eye: np.ndarray, top: np.ndarray
) -> np.ndarray | None:
    """Points of the arc or arrow of an effort in [-1, 1], `[K, 3]`; None if it is too small, or NaN.

    Args:
      model, data: the robot, in its pose.
      motor: index of the actuator, of a hinge or a slide.
      effort: its command as a fraction of the limit.
      eye, top: place and upwards direction of the camera.
    """
    if not abs(effort) > MIN_EFFORT:
        return None
    joint, size = model.actuator_trnid[motor, 0], model.stat.meansize
    origin, axis = data.xanchor[joint], data.xaxis[joint]
    if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
        return np.stack([origin, origin + effort * size * axis])
    # Starts at the top, as on a clock, in front of the turning part.
    front = origin + FRONT * size * math.copysign(1.0, (eye - origin) @ axis) * axis
    return arc_points(front, axis, top, ARC * size, effort * FULL_SWEEP)


def arc_points(center: np.ndarray, axis: np.ndarray, top: np.ndarray, radius: float, turn: float) -> np.ndarray:
    """Points along a circle about an axis, `[K, 3]`: right-handed, beginning at the point nearest to `top`.

    Args:
      center, axis: centre and unit axis of the circle.
      top: a direction; if it is parallel to the axis, any point may be the first.
      radius: radius of the circle [m].
      turn: angle from the first to the last point [rad].
    """
    start = top - (top @ axis) * axis
    if np.linalg.norm(start) < 1e-3:
        start = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    start /= np.linalg.norm(start)
    angles = np.linspace(0.0, turn, 2 + int(abs(turn) / ARC_STEP))[:, None]
    return center + radius * (np.cos(angles) * start + np.sin(angles) * np.cross(axis, start))


def _draw_line(scene: Any, points: np.ndarray, width: float, color: tuple[float, ...], eye: np.ndarray) -> None:
    """Draws a line through the points with an arrowhead facing the eye, smaller on a short line."""
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    head, forward = min(2.5 * width, lengths.sum()), steps[-1] / lengths[-1]
    sideways = np.cross(forward, eye - points[-1])
    sideways /= max(np.linalg.norm(sideways), 1e-9)
    barbs = [points[-1] + head * (sign * sideways - forward) for sign in (-1, 1)]
    for start, end in [*itertools.pairwise(points), *((points[-1], barb) for barb in barbs)]:
        connect(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, start, end, width / 2, color)
