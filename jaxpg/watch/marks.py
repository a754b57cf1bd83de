"""The goal in scenes of MuJoCo's renderer: a sphere, and axes of frames where the goal has an orientation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from jaxpg.watch.solids import Bone
from jaxpg.watch.space import Framing, list_grid

GOAL = (0.1, 0.6, 0.25, 0.5)
DOT = 0.02  # radius of a goal that has none, as a fraction of the model's size
AXES = ((0.84, 0.24, 0.2, 1.0), (0.24, 0.63, 0.27, 1.0), (0.2, 0.43, 0.86, 1.0))  # colours of x, y and z
LENGTH, WIDTH = 0.12, 0.006  # of a frame's axes, times the picture's radius
LEAST = 3.0  # length of the axes, times the goal's radius, so that they come out of its sphere
GLOW = 0.6  # of the axes, whose colour is their meaning


class Frame(NamedTuple):
    """A frame that is drawn as its axes.

    Attributes:
      place: its origin, `[3]` [m].
      rotation: columns are its axes, `[3, 3]`.
      length, width: of the axes [m].
    """

    place: np.ndarray
    rotation: np.ndarray
    length: float
    width: float


def list_frames(
    data: Any, goal: np.ndarray, rotation: np.ndarray | None, site: int | None, size: float, radius: float
) -> list[Frame]:
    """The goal's frame, and, thicker and shorter, the site's that should become it; none without an orientation.

    Args:
      data: `mujoco.MjData` with the robot's pose.
      goal, rotation: the goal's place `[3]` [m] and orientation `[3, 3]`.
      site: index of the site, or None.
      size: radius of the picture [m].
      radius: radius of the goal's sphere [m].
    """
    if rotation is None or not np.isfinite(rotation).all():
        return []
    length, width = max(LENGTH * size, LEAST * radius), WIDTH * size
    frames = [Frame(goal, rotation, length, width)]
    if site is not None:
        frames.append(Frame(data.site_xpos[site], data.site_xmat[site].reshape(3, 3), 0.6 * length, 2 * width))
    return frames


def draw_goal(scene: Any, place: np.ndarray, radius: float, frames: Sequence[Frame]) -> None:
    """Adds a goal's sphere and the axes of frames to a `mujoco.MjvScene`."""
    add_geom(scene, mujoco.mjtGeom.mjGEOM_SPHERE, place, radius, GOAL)
    for frame in frames:
        for axis, color in zip(frame.rotation.T, AXES, strict=True):
            end = frame.place + frame.length * axis
            geom = connect(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, frame.place, end, frame.width / 2, color)
            if geom is not None:
                geom.emission = GLOW


def draw_bones(scene: Any, data: Any, bones: Sequence[Bone]) -> None:
    """Adds rods in the place of bodies without shapes to a `mujoco.MjvScene`, in the pose of `data`."""
    for bone in bones:
        turn = data.xmat[bone.body].reshape(3, 3)
        start, end = (data.xpos[bone.body] + turn @ point for point in (bone.start, bone.end))
        connect(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, start, end, bone.radius, tuple(bone.color.tolist()))


def draw_grid(scene: Any, framing: Framing, center: np.ndarray, color: tuple[float, ...]) -> None:
    """Adds a grid on the ground about a centre to a `mujoco.MjvScene`."""
    for start, end in list_grid(framing, center):
        connect(scene, mujoco.mjtGeom.mjGEOM_LINE, start, end, 1.0, color)


def connect(scene: Any, kind: Any, start: np.ndarray, end: np.ndarray, width: float, color: tuple[float, ...]) -> Any:
    """Adds a capsule of a radius [m], or a line of a width [pixels], to the scene; returns None if that is full."""
    geom = add_geom(scene, kind, start, 0.0, color)
    if geom is not None:
        mujoco.mjv_connector(geom, kind, width, start, end)
    return geom


def add_geom(scene: Any, kind: Any, place: np.ndarray, radius: float, color: tuple[float, ...]) -> Any:
    """Adds a shape to the scene; returns None if the scene is full."""
    if scene.ngeom >= scene.maxgeom:
        return None
    geom = scene.geoms[scene.ngeom]
    scene.ngeom += 1
    mujoco.mjv_initGeom(geom, kind, np.array([radius, 0, 0]), place, np.eye(3).ravel(), np.array(color, np.float32))
    return geom
