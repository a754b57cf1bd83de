"""Robots in space: from where they are seen, and how far their picture reaches.

Angles are MuJoCo's: the camera looks along (cos e cos a, cos e sin a, sin e) with the azimuth a and the elevation e, so
that e < 0 looks down on the robot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from jaxpg.watch import drawing
from jaxpg.watch.recording import Look
from jaxpg.watch.solids import Part

AZIMUTH, ELEVATION = 120.0, -20.0  # for models that do not say otherwise: obliquely from the front [deg]
MUJOCO_ANGLES = (90.0, -45.0)  # of models that do not say
FARTHEST = 100.0  # times the model's size: what flies off stays there
QUATERNIONS = {mujoco.mjtJoint.mjJNT_FREE: 3, mujoco.mjtJoint.mjJNT_BALL: 0}  # where one begins in a joint's numbers
LENGTHS = {mujoco.mjtJoint.mjJNT_FREE: 3, mujoco.mjtJoint.mjJNT_SLIDE: 1}  # how many of a joint's numbers are metres
ITERATIONS = 40  # for the smallest sphere
MESHES = 8  # of the grid, across the picture
MIN_RADIUS = 1e-3  # of a picture [m]


class Framing(NamedTuple):
    """A camera that sees all of some episodes.

    Attributes:
      center: what it looks at, before it follows the robot, `[3]` [m].
      radius: of a sphere about the centre in which everything is [m].
      azimuth, elevation: direction in which it looks [deg].
      ground: height of the ground [m].
      follows: whether it follows the robot.
    """

    center: np.ndarray
    radius: float
    azimuth: float
    elevation: float
    ground: float
    follows: bool


def make_framing(model: Any, parts: Sequence[Part], looks: Sequence[Look]) -> Framing:
    """The camera for episodes, whose frames are first in the arrays of `looks`."""
    paths = [_follow_parts(model, parts, tame(model, look.qpos)) for look in looks]
    moving, rims = _find_moving(model, parts), _find_rims(parts)
    goals = [look.goal[np.isfinite(look.goal).all(axis=1)] for look in looks if look.goal is not None]
    # A robot with a goal stays in view as long as it can, so that the goal does not move.
    follows = any(_is_travelling(path[:, moving], rims[moving], 2.0 if goals else 1.0) for path in paths)
    balls = [_list_balls(path[:, moving] if follows else path, follows) for path in paths]
    all_rims = np.tile(rims[moving] if follows else rims, sum(len(path) for path in paths))
    seen = goals if not follows else []
    center, radius = _enclose(np.concatenate([*balls, *seen]), np.append(all_rims, np.zeros(sum(map(len, seen)))))
    limit = drawing.MAX_REACH * max(float(model.stat.extent), 1.0)
    azimuth, elevation = find_angles(model)
    return Framing(center, min(radius, limit), azimuth, elevation, _find_ground(model, center, radius), follows)


def _list_balls(path: np.ndarray, follows: bool) -> np.ndarray:
    """The middles of parts `[F, P, 3]` as the camera sees them, `[F P, 3]`."""
    return (path - (_find_middles(path)[:, None] if follows else 0.0)).reshape(-1, 3)


def _find_moving(model: Any, parts: Sequence[Part]) -> list[int]:
    """Indices of the parts that are not fixed to the world; of all if none moves."""
    return [i for i, part in enumerate(parts) if model.body_weldid[part.body]] or list(range(len(parts)))


def tame(model: Any, qpos: np.ndarray) -> np.ndarray:
    """Joint positions `[F, nq]` that can be drawn, each near the one before.

    Positions that are not finite are replaced by the previous ones, lengths are kept within `FARTHEST`, and of the two
    quaternions with the same meaning the one nearer to the last is taken.
    """
    tamed = np.array(list(drawing.fill_gaps(qpos, model.qpos0)), float)
    limit = FARTHEST * max(float(model.stat.extent), 1.0)
    for joint, first in enumerate(model.jnt_qposadr):
        kind = mujoco.mjtJoint(int(model.jnt_type[joint]))
        lengths = slice(first, first + LENGTHS.get(kind, 0))
        tamed[:, lengths] = np.clip(tamed[:, lengths], -limit, limit)
        if kind in QUATERNIONS:
            turns = tamed[:, first + QUATERNIONS[kind] :][:, :4]
            flips = np.sum(turns[1:] * turns[:-1], axis=1) < 0
            turns[1:] *= np.where(np.cumsum(flips) % 2, -1.0, 1.0)[:, None]
    return tamed


def _follow_parts(model: Any, parts: Sequence[Part], qpos: np.ndarray) -> np.ndarray:
    """The middle of each part at the joint positions `[F, nq]`, `[F, P, 3]`."""
    data, middles = mujoco.MjData(model), np.array([_find_middle(part) for part in parts])
    bodies = [part.body for part in parts]
    places = np.zeros((len(qpos), len(parts), 3))
    for i, q in enumerate(qpos):
        data.qpos = q
        mujoco.mj_kinematics(model, data)
        places[i] = data.xpos[bodies] + np.einsum("pij,pj->pi", data.xmat[bodies].reshape(-1, 3, 3), middles)
    return places


def _find_middle(part: Part) -> np.ndarray:
    vertices = part.solid.vertices
    return (vertices.min(axis=0) + vertices.max(axis=0)) / 2


def _find_rims(parts: Sequence[Part]) -> np.ndarray:
    """The distance of each part's farthest vertex from its middle, `[P]` [m]."""
    return np.array([np.linalg.norm(part.solid.vertices - _find_middle(part), axis=1).max() for part in parts])


def _is_travelling(path: np.ndarray, rims: np.ndarray, patience: float) -> bool:
    """Whether the parts `[F, P, 3]` move together much farther than they are large and apart."""
    size = np.max(np.ptp(path[..., :2], axis=1).max(axis=-1) + 2 * rims.max())
    return bool(np.ptp(path.mean(axis=1)[:, :2], axis=0).max() > patience * drawing.TRAVEL * size)


def _find_middles(path: np.ndarray) -> np.ndarray:
    """Where the parts `[F, P, 3]` are over the ground on average, `[F, 3]` with height 0."""
    return path.mean(axis=1) * [1.0, 1.0, 0.0]


def find_shifts(model: Any, parts: Sequence[Part], qpos: np.ndarray, framing: Framing) -> np.ndarray | None:
    """What is added to the framing's centre at the joint positions `[F, nq]`, `[F, 3]` [m]; None if it stays."""
    if not framing.follows:
        return None
    return _find_middles(_follow_parts(model, parts, tame(model, qpos))[:, _find_moving(model, parts)])


def _enclose(points: np.ndarray, rims: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre and radius of a sphere about balls that is little larger than the smallest one.

    Each iteration moves the centre 1/(i + 1) of the way to the point that is farthest from it (Badoiu and Clarkson,
    "Smaller core-sets for balls", SODA 2003).
    """
    center = ((points - rims[:, None]).min(axis=0) + (points + rims[:, None]).max(axis=0)) / 2
    far = np.linalg.norm(points - center, axis=1) + rims
    best = center, float(far.max())
    for i in range(1, ITERATIONS):
        farthest = int(far.argmax())
        way = points[farthest] - center
        center = center + way * (1 + rims[farthest] / max(float(np.linalg.norm(way)), 1e-9)) / (i + 1)
        far = np.linalg.norm(points - center, axis=1) + rims
        best = min(best, (center, float(far.max())), key=lambda ball: ball[1])
    return best[0], max(best[1], MIN_RADIUS)


def find_angles(model: Any) -> tuple[float, float]:
    """Azimuth and elevation [deg] of the model's camera, or of its settings for viewers, or our own."""
    if drawing.find_camera(model) is not None:
        right, _, back = drawing.camera_axes(model)
        return math.degrees(math.atan2(right[0], -right[1])), math.degrees(math.asin(np.clip(-back[2], -1.0, 1.0)))
    angles = float(model.vis.global_.azimuth), float(model.vis.global_.elevation)
    return (AZIMUTH, ELEVATION) if angles == MUJOCO_ANGLES else angles


def make_axes(azimuth: float, elevation: float) -> np.ndarray:
    """Right, up and towards the viewer, `[3, 3]`, of a camera with these angles [deg]."""
    a, e = math.radians(azimuth), math.radians(elevation)
    back = -np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    right = np.array([math.sin(a), -math.cos(a), 0.0])
    return np.stack([right, np.cross(back, right), back])


def _find_ground(model: Any, center: np.ndarray, radius: float) -> float:
    """The height of the world's horizontal plane; else 0, or the lower end of a picture that is far from that."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    planes = np.flatnonzero((model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & (model.geom_bodyid == 0))
    level = [float(data.geom_xpos[i, 2]) for i in planes if data.geom_xmat[i, 8] > 1 - 1e-6]
    return max(level, default=0.0 if abs(center[2]) <= 2 * radius else float(center[2] - radius))


def list_grid(framing: Framing, center: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Both ends of the lines of a grid on the ground about a centre, at multiples of 1, 2 or 5 times a power of ten."""
    mesh = find_mesh(2 * framing.radius)
    count = math.ceil(1.4 * framing.radius / mesh)
    x, y = np.round(np.asarray(center)[:2] / mesh) * mesh
    lines = []
    for offset in mesh * np.arange(-count, count + 1):
        for ends in (
            ((offset, -count * mesh), (offset, count * mesh)),
            ((-count * mesh, offset), (count * mesh, offset)),
        ):
            start, end = (np.array([x + dx, y + dy, framing.ground]) for dx, dy in ends)
            lines.append((start, end))
    return lines


def find_mesh(span: float) -> float:
    """1, 2 or 5 times a power of ten: the least such length of which at most 8 fit into a span.

    >>> [find_mesh(span) for span in (1.6, 1.7, 8.0)]
    [0.2, 0.5, 1.0]
    """
    power = 10.0 ** math.floor(math.log10(span / MESHES))
    return float(f"{power * next(f for f in (1, 2, 5, 10) if f * power * MESHES >= span * (1 - 1e-9)):.3g}")
