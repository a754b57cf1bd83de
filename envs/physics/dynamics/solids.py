"""Simple shapes around the geoms of a body, by which their distance is bounded."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from envs.physics.pairs import SHAPES
from envs.physics.reach import enclose_geoms

ROUNDS = 40  # of the search for the centre of a sphere
SHRINKING = 0.85  # of its steps
ROUNDING = 1e-6  # by which share a radius is larger than needed
CORNERS = 12  # of the polygon around a circle
BOXES = ("box", "mesh", "sdf")  # what reaches as far as its bounding box, or less


class Solid(NamedTuple):
    """A geom, or a sphere, a capsule or a box around some of a body, with a capsule around it; in the body's frame.

    Attributes:
      shape: its name.
      body: number of the body.
      middle: of the solid and of the capsule, `[3]`.
      axes: columns are the axes of the shape, `[3, 3]`.
      size: MuJoCo's size of the shape, or half of its bounding box, `[3]`.
      half: half of the capsule's segment, `[3]`.
      radius: of the capsule.
    """

    shape: str
    body: int
    middle: np.ndarray
    axes: np.ndarray
    size: np.ndarray
    half: np.ndarray
    radius: float


class Balls(NamedTuple):
    """Balls in whose convex hull some geoms lie: middles `[n, 3]` and radii `[n]`, in the body's frame."""

    middles: np.ndarray
    radii: np.ndarray


def make_solids(model: mujoco.MjModel) -> list[Solid]:
    """The geoms, each with its capsule of those of `enclose_geoms`."""
    solids = []
    for geom, (centre, axis, radius) in enumerate(zip(*enclose_geoms(model), strict=True)):
        axes = np.empty(9)
        mujoco.mju_quat2Mat(axes, model.geom_quat[geom])
        axes, shape = axes.reshape(3, 3), SHAPES[model.geom_type[geom]]
        size = model.geom_aabb[geom, 3:] if shape in ("mesh", "sdf") else model.geom_size[geom]
        middle, body = model.geom_pos[geom] + axes @ centre, int(model.geom_bodyid[geom])
        solids.append(Solid(shape, body, middle, axes, size, axes @ axis, float(radius)))
    return solids


def list_enclosures(solids: Sequence[Solid]) -> list[Solid]:
    """A sphere, a capsule and a box around all of these geoms of a body; of a single one itself instead of the box."""
    solid = solids[0]
    if len(solids) == 1 and solid.shape in ("plane", "sphere"):
        return [solid]
    balls = _list_balls(solids)
    found = [_enclose_in_sphere(solid.body, balls)]
    if len(solids) > 1:
        return [*found, _enclose_in_capsule(solids, balls), _enclose_in_box(solids, balls)]
    if solid.shape != "capsule":
        found.append(_enclose_in_capsule(solids, balls))
    return [*found, solid]


def _list_balls(solids: Sequence[Solid]) -> Balls:
    """Corners of boxes and of the prisms around cylinders, and of all others the ends of their capsules."""
    parts = [_list_corners(solid) for solid in solids]
    return Balls(np.concatenate([x.middles for x in parts]), np.concatenate([x.radii for x in parts]))


def _list_corners(solid: Solid) -> Balls:
    if solid.shape in BOXES:
        corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * solid.size
    elif solid.shape == "cylinder":
        angles = 2 * np.pi / CORNERS * np.arange(CORNERS)
        circle = solid.size[0] / np.cos(np.pi / CORNERS) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        corners = np.concatenate([np.insert(circle, 2, end, axis=1) for end in (-solid.size[1], solid.size[1])])
    else:
        ends = np.stack([solid.middle - solid.half, solid.middle + solid.half])
        return Balls(ends, np.full(2, solid.radius))
    return Balls(solid.middle + corners @ solid.axes.T, np.zeros(len(corners)))


def _find_centre(balls: Balls) -> np.ndarray:
    """The centre of a sphere around all balls that is nearly the smallest, by shorter and shorter steps.

    Each one leads towards the farthest ball (after Badoiu and Clarkson, "Smaller core-sets for balls", 2003).
    """
    centre = best = balls.middles.mean(0)  # which also lies in any plane in which all middles lie
    radius = np.inf
    for i in range(ROUNDS):
        distances = np.linalg.norm(balls.middles - centre, axis=1)
        farthest = int((distances + balls.radii).argmax())
        reach = distances[farthest] + balls.radii[farthest]
        best, radius = (centre, reach) if reach < radius else (best, radius)
        step = (balls.middles[farthest] - centre) / max(distances[farthest], mujoco.mjMINVAL)
        centre = centre + step * reach * SHRINKING**i / 2
    return best


def _find_radius(balls: Balls, centre: np.ndarray) -> float:
    """That of a sphere around all balls with this centre."""
    return float((np.linalg.norm(balls.middles - centre, axis=1) + balls.radii).max()) * (1 + ROUNDING)


def _enclose_in_sphere(body: int, balls: Balls) -> Solid:
    """A sphere around all balls."""
    centre = _find_centre(balls)
    radius = _find_radius(balls, centre)
    return Solid("sphere", body, centre, np.eye(3), np.array([radius, 0.0, 0.0]), np.zeros(3), radius)


def _enclose_in_capsule(solids: Sequence[Solid], balls: Balls) -> Solid:
    """The smallest capsule around all balls, along the line between the farthest or an axis of a geom.

    Of several geoms only the longest axes are tried.
    """
    distances = np.linalg.norm(balls.middles[:, None] - balls.middles, axis=2)
    first, last = np.unravel_index(distances.argmax(), distances.shape)
    longest = (balls.middles[last] - balls.middles[first]) / max(distances.max(), mujoco.mjMINVAL)
    axes = (
        [x.half / max(np.linalg.norm(x.half), mujoco.mjMINVAL) for x in solids] if len(solids) > 1 else solids[0].axes.T
    )
    lines = [line for line in (longest, *axes) if line.any()] or [np.eye(3)[2]]
    capsules = [_enclose_along(solids[0].body, balls, line) for line in lines]
    return min(capsules, key=lambda x: x.size[0] ** 2 * (x.size[1] + 2 / 3 * x.size[0]))


def _enclose_along(body: int, balls: Balls, line: np.ndarray) -> Solid:
    """A capsule around all balls along a unit vector."""
    along = balls.middles @ line
    across = balls.middles - along[:, None] * line
    centre = _find_centre(Balls(across, balls.radii))
    radius = _find_radius(Balls(across, balls.radii), centre)
    # Each ball may be beyond the ends of the segment by as much as it is within the round ends of the capsule.
    beyond = np.sqrt(((radius - balls.radii) ** 2 - ((across - centre) ** 2).sum(1)).clip(0.0))
    low, high = (along + beyond).min(), (along - beyond).max()
    low, high = min(low, (low + high) / 2), max(high, (low + high) / 2)
    length = (high - low) / 2
    axes = np.stack([np.zeros(3), np.zeros(3), line], axis=1)  # of a capsule only the third one matters
    middle = centre + (low + high) / 2 * line
    return Solid("capsule", body, middle, axes, np.array([radius, length, 0.0]), length * line, radius)


def _enclose_in_box(solids: Sequence[Solid], balls: Balls) -> Solid:
    """The smallest box around all balls in the axes of one of the geoms."""
    boxes = [_enclose_in_axes(solids[0].body, balls, axes) for axes in _list_frames(solids)]
    return min(boxes, key=lambda x: np.prod(x.size))


def _list_frames(solids: Sequence[Solid]) -> list[np.ndarray]:
    """The axes of the geoms and of the body."""
    return [np.eye(3), *(solid.axes for solid in solids)]


def _enclose_in_axes(body: int, balls: Balls, axes: np.ndarray) -> Solid:
    """A box around all balls with these axes."""
    along = balls.middles @ axes
    low, high = (along - balls.radii[:, None]).min(0), (along + balls.radii[:, None]).max(0)
    middle, size = (low + high) / 2, (high - low) / 2
    longest = int(size.argmax())
    radius = float(np.linalg.norm(np.delete(size, longest)))
    return Solid("box", body, axes @ middle, axes, size, axes[:, longest] * size[longest], radius)
