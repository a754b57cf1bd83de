"""Whether geoms come so near that they may touch, by bounds on their distance.

Most of the pairs of geoms that could touch never do: the links of an arm, the trunk of a robot that walks. Their
contacts would be most of a step's equations. Such pairs are only watched: a step in which one of them may touch is left
to C MuJoCo.

Two solids are apart if there is a gap between the capsules around them, or between their extents along an axis of one
of them. Of a solid above a plane the extent decides alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.physics.dynamics.solids import Solid
from envs.physics.reach import find_gap

if TYPE_CHECKING:
    from mujoco import mjx

# Axes along which a shape reaches less far than the capsule around it.
FLAT_AXES = {"cylinder": (2,), "box": (0, 1, 2), "mesh": (0, 1, 2), "sdf": (0, 1, 2)}
PARALLEL = 1e-6  # squared sine of an angle, below which segments count as parallel in single precision


class Bound(NamedTuple):
    """Geoms in two solids, of which only the first may be a plane, do not touch while there is this gap (m)."""

    one: Solid
    other: Solid
    margin: float


def may_touch(d: mjx.Data, bounds: Sequence[Bound]) -> jax.Array:
    """Whether the solids of any of these bounds may be within its margin, scalar of bool; d has the poses of bodies."""
    groups: dict[tuple[str, str], list[Bound]] = {}
    for bound in bounds:
        groups.setdefault((bound.one.shape, bound.other.shape), []).append(bound)
    return jnp.any(jnp.concatenate([_are_near(d, group) for group in groups.values()]))


def _are_near(d: mjx.Data, bounds: Sequence[Bound]) -> jax.Array:
    """Whether the two solids of each bound may be within its margin, all of the same shapes, `[n]` of bool."""
    ones, others, margins = zip(*bounds, strict=True)
    one, other = (Placed(d.xpos, d.xmat, solids) for solids in (ones, others))
    return are_near(one, other, np.array(margins))


class Placed:
    """n solids of one shape in the world, in one or in many positions of their bodies.

    Args:
      xpos, xmat: poses of the bodies, `[..., nbody, 3]` and `[..., nbody, 3, 3]`, arrays of numpy or of jax.
      solids: the solids.

    Attributes:
      middle, axes, half: as those of `Solid`, `[..., n, 3]`, `[..., n, 3, 3]` and `[..., n, 3]`.
      size, radius: those of the solids, `[n, 3]` and `[n]`.
      length: of half of the capsule's segment, `[n]`.
    """

    def __init__(self, xpos: Any, xmat: Any, solids: Sequence[Solid]):
        _, bodies, middle, axes, self.size, half, self.radius = (np.array(x) for x in zip(*solids, strict=True))
        self.shape, self.length = solids[0].shape, np.linalg.norm(half, axis=1)
        rotation = xmat[..., bodies, :, :]
        self.middle = xpos[..., bodies, :] + (rotation * middle[:, None]).sum(-1)
        self.axes = rotation @ axes
        if self.shape in FLAT_AXES:  # along an axis of the shape, which is needed anyway
            along = (axes * half[:, :, None]).sum(1)
            parts = np.where(abs(along) == abs(along).max(1, keepdims=True), along, 0.0)
            self.half = (self.axes * parts[:, None]).sum(-1)
        else:
            self.half = (rotation * half[:, None]).sum(-1)

    def find_length(self, axis: int) -> np.ndarray:
        """How far the solids reach from their middle along an axis of their shape, of `FLAT_AXES`, in m, `[n]`."""
        return self.size[:, 1 if self.shape == "cylinder" else axis]

    def find_extent(self, direction):
        """How far the solids reach from their middle along unit vectors `[..., n, 3]`, in m, `[..., n]`."""
        if self.shape == "sphere":
            return self.size[:, 0]
        if self.shape in ("box", "mesh", "sdf", "ellipsoid"):
            along = (self.axes * direction[..., None]).sum(-2) * self.size
            return _take_root((along**2).sum(-1)) if self.shape == "ellipsoid" else abs(along).sum(-1)
        along = abs((self.axes[..., 2] * direction).sum(-1))
        if self.shape == "cylinder":
            return along * self.size[:, 1] + _take_root((1 - along**2).clip(0.0)) * self.size[:, 0]
        return along * self.size[:, 1] + self.size[:, 0]


def are_near(one: Placed, other: Placed, margin: np.ndarray):
    """Whether two solids of each row may be within its margin, `[..., n]` of bool; only the first may be planes."""
    offset = other.middle - one.middle
    if one.shape == "plane":
        normal = one.axes[..., 2]
        return (normal * offset).sum(-1) - other.find_extent(normal) < margin
    gap = find_gap(-offset, one.half, other.half, one.length, other.length, PARALLEL)
    near = (gap**2).sum(-1) < (one.radius + other.radius + margin + _find_excess(one.length, other.length)) ** 2
    for solid in (one, other):
        for i in FLAT_AXES.get(solid.shape, ()):
            axis, partner = solid.axes[..., i], other if solid is one else one
            reach = solid.find_length(i) + partner.find_extent(axis) + margin
            near = near & (abs((axis * offset).sum(-1)) < reach)
    return near


def _take_root(x):
    return np.sqrt(x) if isinstance(x, np.ndarray) else jnp.sqrt(x)


def _find_excess(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """A bound on how much `find_gap` exceeds the distance of two segments, for their half-lengths in m, `[n]`.

    It is exact for parallel segments, from whatever point it starts. Turning the shorter segment about its middle until
    it is parallel moves its points by at most shorter * sine. So the gap is too long by at most 2 shorter * sine. For
    angles that count as parallel this is 2 shorter sqrt(PARALLEL). At larger ones the start is wrong by rounding alone,
    and the gap too long by less than 6 eps longer / sine too (measured, eps = 6e-8). The less of both is at most
    sqrt(12 eps shorter longer), below the result, which also bounds the gap for angles that count as parallel.
    """
    return 2 * np.sqrt(PARALLEL * one * other)
