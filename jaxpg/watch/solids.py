"""Triangles of a robot's shapes, for pictures in three dimensions.

Every shape is drawn as the convex hull of some points with a rim of a radius around them, as in `drawing`: of a capsule
two points and its radius, of a box eight corners, of a mesh its outermost vertices. The hull with its rim is that of
the points p + radius d over the directions d of a globe.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, QhullError

from jaxpg.watch import drawing

MERIDIANS, PARALLELS = 16, 7  # of a globe, poles not counted
UNCOLORED = np.array([0.5, 0.5, 0.5, 1.0], np.float32)  # MuJoCo's colour of geoms that are given none
COLORS = np.array([(0.56, 0.63, 0.72, 1.0), (0.81, 0.84, 0.87, 1.0)])  # so that one link is told from the next
BONE = 0.15  # radius of a rod that stands for a body, as a fraction of its length
THICKNESS = 1e-3  # of what is flat, as a fraction of its size


class Solid(NamedTuple):
    """A closed surface of triangles.

    Attributes:
      vertices: `[V, 3]` [m].
      triangles: indices of corners, counter-clockwise as seen from outside, `[T, 3]`.
    """

    vertices: np.ndarray
    triangles: np.ndarray


class Part(NamedTuple):
    """A shape that is fixed to a body.

    Attributes:
      body: index of the body in the model.
      solid: its surface in the body's frame.
      color: such as `#cc4c4c`.
    """

    body: int
    solid: Solid
    color: str


class Bone(NamedTuple):
    """A rod in the place of a body that has no shape, as where its mesh file is missing.

    Attributes:
      body: index of the body.
      start, end: its ends in the body's frame, `[3]` [m].
      radius: [m].
      color: `[4]`.
    """

    body: int
    start: np.ndarray
    end: np.ndarray
    radius: float
    color: np.ndarray


def make_globe() -> np.ndarray:
    """Unit vectors on parallels, of which one is the equator, and at the poles, `[D, 3]`."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, PARALLELS + 2)[1:-1]
    longitude = np.linspace(0, 2 * np.pi, MERIDIANS, endpoint=False)
    ring = np.stack([np.cos(longitude), np.sin(longitude), 0 * longitude], axis=1)
    rings = np.cos(latitude)[:, None, None] * ring + np.sin(latitude)[:, None, None] * [0.0, 0.0, 1.0]
    return np.concatenate([rings.reshape(-1, 3), [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]])


def make_solid(points: np.ndarray, radius: float = 0.0) -> Solid:
    """The convex hull of points `[K, 3]` with a rim of a radius [m]; what is flat gets a small thickness."""
    spread = (points[:, None] + radius * make_globe()).reshape(-1, 3) if radius else np.asarray(points, float)
    try:
        hull = ConvexHull(spread)
    except (QhullError, ValueError):  # all in a plane, or too few points
        size = max(float(np.ptp(spread, axis=0).max(initial=0.0)), 1e-3)
        spread = (spread[:, None] + THICKNESS * size * drawing.CORNERS).reshape(-1, 3)
        hull = ConvexHull(spread)
    return _orient(hull)


def _orient(hull: Any) -> Solid:
    """The hull's corners alone, and its triangles such that their normals point outwards."""
    triangles = hull.simplices.copy()
    a, b, c = (hull.points[triangles[:, i]] for i in range(3))
    inwards = np.einsum("ti,ti->t", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    triangles[inwards] = triangles[inwards][:, ::-1]
    used, numbers = np.unique(triangles, return_inverse=True)
    return Solid(hull.points[used], numbers.reshape(-1, 3))


def make_parts(model: Any) -> list[Part]:
    """What is drawn of a model, as in `drawing.make_picture`: visible geoms, else all geoms, else bodies as boxes.

    Where some bodies have geoms, the others are drawn as bones.
    """
    geoms = drawing.find_geoms(model)
    parts = [
        Part(
            int(model.geom_bodyid[geom]),
            place(_make_geom(model, geom), model.geom_pos[geom], model.geom_quat[geom]),
            drawing.format_color(find_color(model, geom)),
        )
        for geom in geoms
    ]
    parts += [
        Part(bone.body, make_solid(np.stack([bone.start, bone.end]), bone.radius), drawing.format_color(bone.color))
        for bone in find_bones(model)
    ]
    parts = parts or [
        Part(
            box.number,
            place(make_solid(box.points), model.body_ipos[box.number], model.body_iquat[box.number]),
            box.color,
        )
        for box in drawing.make_bodies(model)
    ]
    if not parts:
        raise drawing.DrawingError("the model has no geoms and no bodies")
    return parts


def find_bones(model: Any) -> list[Bone]:
    """Rods from each body without a visible geom to its children, or to its centre of mass; none without any geoms."""
    geoms = drawing.find_geoms(model)
    if not geoms:
        return []
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    span = float(np.ptp(data.xpos[1:], axis=0).max())
    bones = []
    for body in sorted(set(range(1, model.nbody)) - set(model.geom_bodyid[geoms].tolist())):
        children = np.flatnonzero(model.body_parentid == body)
        for end in model.body_pos[children] if len(children) else model.body_ipos[[body]]:
            length = float(np.linalg.norm(end))
            radius = float(np.clip(BONE * length, 0.01 * span, 0.04 * span))
            if length > radius:
                bones.append(Bone(body, np.zeros(3), end.copy(), radius, _choose_color(model, body)))
    return bones


def find_color(model: Any, geom: int) -> np.ndarray:
    """The geom's colour `[4]`; where the model says none, one of two by the depth of its body in the tree."""
    rgba = drawing.find_rgba(model, geom)
    return _choose_color(model, int(model.geom_bodyid[geom])) if np.array_equal(rgba, UNCOLORED) else rgba


def _choose_color(model: Any, body: int) -> np.ndarray:
    depth = 0
    while body:
        depth, body = depth + 1, int(model.body_parentid[body])
    return COLORS[depth % len(COLORS)]


def _make_geom(model: Any, geom: int) -> Solid:
    """The surface of a geom, in the geom's frame."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return make_solid(model.geom_size[geom] * make_globe())
    return make_solid(*drawing.make_outline(model, geom))


def place(solid: Solid, position: np.ndarray, quaternion: np.ndarray) -> Solid:
    """The solid of one frame in the frame in which that one has this position and unit quaternion."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, quaternion)
    return solid._replace(vertices=solid.vertices @ rotation.reshape(3, 3).T + position)
