"""A grid of pictures by MuJoCo's own renderer: the robot, where it should get, and what its motors do."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from jaxpg.watch import gl
from jaxpg.watch.drawing import drawn_geoms

GOAL = (0.1, 0.6, 0.25, 0.5)
POSITIVE = (0.95, 0.55, 0.05, 1.0)  # efforts, which turn right-handed about the axis or push along it
NEGATIVE = (0.55, 0.25, 0.75, 1.0)
FULL = 1.5 * math.pi  # an arc's sweep [rad] at effort 1
LEAST = 0.02  # smaller efforts are not drawn
FINE = math.pi / 12  # between two points of an arc [rad]
ARC, THICK, FRONT = 0.5, 0.07, 0.2  # an arc's radius, width and distance from its joint, of the model's mean size
BORDER, BEYOND = 255, (0.5, 0.5, 0.5, 1.0)  # between the pictures, and where the grid has more places than pictures


class Cell(NamedTuple):
    """One picture.

    Attributes:
      qpos: joint positions, `[nq]`.
      goal: where to get, `[3]` [m], or None.
      efforts: the command of each actuator as a fraction of its limit, `[nu]`.
      caption: a line of text.
    """

    qpos: np.ndarray
    goal: np.ndarray | None
    efforts: np.ndarray
    caption: str


class Canvas:
    """Draws pictures side by side into one image; as a context manager, it ends with its OpenGL context.

    Args:
      model: `mujoco.MjModel`; its first camera looks, or the one that MuJoCo's viewer begins with.
      backend: as `gl.backend` finds it.
      grid: its rows and columns.
      size: width and height of one picture [pixels].
      goal_radius: of the sphere that marks the goal [m].
    """

    def __init__(
        self, model: Any, backend: str, grid: tuple[int, int], size: tuple[int, int], goal_radius: float | None = None
    ):
        (self.rows, self.columns), (width, height) = grid, size
        self._width, self._height, self._goal_radius = width, height, goal_radius
        self._model = _prepared(model, self.columns * width, self.rows * height, height / width)
        self._data = mujoco.MjData(self._model)
        self._motors = _motors(self._model)
        self._gl = gl.context(backend, self.columns * width, self.rows * height)
        self._scene, self._options = mujoco.MjvScene(self._model, maxgeom=10_000), _options(self._model)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False  # on a CPU they take most of the time
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)

    def __enter__(self) -> Canvas:
        return self

    def __exit__(self, *exception: object) -> None:
        self._gl.make_current()
        self._context.free()
        self._gl.free()
        del self._gl  # OSMesa's frees itself again, which at the interpreter's end it cannot

    def draw(self, cells: Sequence[Cell]) -> np.ndarray:
        """Image `[rows * height, columns * width, 3]`: the first picture is at the top left, the next beside it."""
        self._gl.make_current()  # there may be another canvas
        whole = mujoco.MjrRect(0, 0, self.columns * self._width, self.rows * self._height)
        mujoco.mjr_rectangle(whole, *BEYOND)
        for i, cell in enumerate(cells):
            self._draw(cell, self._place(i))
        image = np.empty((whole.height, whole.width, 3), np.uint8)
        mujoco.mjr_readPixels(image, None, whole, self._context)
        image = image[::-1]  # OpenGL's first row is the lowest
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
        mujoco.mjv_updateScene(model, data, self._options, None, _camera(model), everything, scene)
        if cell.goal is not None:
            _add(scene, mujoco.mjtGeom.mjGEOM_SPHERE, cell.goal, self._goal_radius, GOAL)
        for motor in self._motors:
            _mark(scene, model, data, motor, float(np.clip(cell.efforts[motor], -1, 1)))
        mujoco.mjr_render(place, scene, self._context)
        font, corner = mujoco.mjtFont.mjFONT_NORMAL, mujoco.mjtGridPos.mjGRID_TOPLEFT
        mujoco.mjr_overlay(font, corner, place, cell.caption, "", self._context)


def _prepared(model: Any, width: int, height: int, ratio: float) -> Any:
    """A copy whose pictures may be so large, and that sees in an upright picture (height / width) as far sideways."""
    model = copy.copy(model)
    model.vis.quality.numslices = 16  # of a round thing: enough for small pictures, and faster
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    if ratio > 1:
        model.vis.global_.fovy = _widened(model.vis.global_.fovy, ratio)
        model.cam_fovy[:] = _widened(model.cam_fovy, ratio)
    return model


def _options(model: Any) -> Any:
    """Of a model without visible geoms all are drawn, and of one without any the inertias of its bodies."""
    options, geoms = mujoco.MjvOption(), drawn_geoms(model)
    options.geomgroup[np.minimum(model.geom_group[geoms], len(options.geomgroup) - 1)] = 1
    options.flags[mujoco.mjtVisFlag.mjVIS_INERTIA] = not geoms
    return options


def _widened(fovy: Any, ratio: float) -> Any:
    return 2 * np.rad2deg(np.arctan(ratio * np.tan(np.deg2rad(fovy) / 2)))


def _camera(model: Any) -> Any:
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    if model.ncam:
        camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
    return camera


def _motors(model: Any) -> list[int]:
    """The actuators that drive a hinge or a slide."""
    kinds = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    of_joints = [i for i, kind in enumerate(model.actuator_trntype) if kind == mujoco.mjtTrn.mjTRN_JOINT]
    return [i for i in of_joints if model.jnt_type[model.actuator_trnid[i, 0]] in kinds]


def _mark(scene: Any, model: Any, data: Any, motor: int, effort: float) -> None:
    """An arc about the hinge, or an arrow along the slide, that is as long as the effort is large."""
    if not abs(effort) > LEAST:  # nor one that is not a number
        return
    joint, size = model.actuator_trnid[motor, 0], model.stat.meansize
    origin, axis, color = data.xanchor[joint], data.xaxis[joint], POSITIVE if effort > 0 else NEGATIVE
    eye = np.mean([scene.camera[i].pos for i in range(2)], axis=0)
    if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
        points = np.stack([origin, origin + effort * size * axis])
    else:
        # From the top, as a clock, and in front of what turns.
        top = np.mean([scene.camera[i].up for i in range(2)], axis=0)
        front = origin + FRONT * size * math.copysign(1.0, (eye - origin) @ axis) * axis
        points = arc(front, axis, top, ARC * size, effort * FULL)
    _stroke(scene, points, THICK * size, color, eye)


def arc(center: np.ndarray, axis: np.ndarray, top: np.ndarray, radius: float, turn: float) -> np.ndarray:
    """Points along a circle about an axis, `[K, 3]`: from the one nearest to `top` on, turned right-handed.

    Args:
      center, axis: of the circle; the axis has length 1.
      top: a direction; if it is the axis, any point is the first.
      radius: of the circle [m].
      turn: from the first point to the last one [rad].
    """
    start = top - (top @ axis) * axis
    if np.linalg.norm(start) < 1e-3:
        start = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    start /= np.linalg.norm(start)
    angles = np.linspace(0.0, turn, 2 + int(abs(turn) / FINE))[:, None]
    return center + radius * (np.cos(angles) * start + np.sin(angles) * np.cross(axis, start))


def _stroke(scene: Any, points: np.ndarray, width: float, color: tuple[float, ...], eye: np.ndarray) -> None:
    """A line through the points, with a head at its end that is broad for the eye, and smaller on a short line."""
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    head, ahead = min(2.5 * width, lengths.sum()), steps[-1] / lengths[-1]
    aside = np.cross(ahead, eye - points[-1])
    aside /= max(np.linalg.norm(aside), 1e-9)
    barbs = [points[-1] + head * (sign * aside - ahead) for sign in (-1, 1)]
    for start, end in [*itertools.pairwise(points), *((points[-1], barb) for barb in barbs)]:
        geom = _add(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, start, 0.0, color)
        if geom is not None:
            mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, width / 2, start, end)


def _add(scene: Any, kind: Any, place: np.ndarray, radius: float, color: tuple[float, ...]) -> Any:
    """A shape that is no part of the model; None where the scene is full."""
    if scene.ngeom >= scene.maxgeom:
        return None
    geom = scene.geoms[scene.ngeom]
    scene.ngeom += 1
    mujoco.mjv_initGeom(geom, kind, np.array([radius, 0, 0]), place, np.eye(3).ravel(), np.array(color, np.float32))
    return geom
