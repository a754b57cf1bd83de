"""Whether geoms come so near that they may touch, by bounds on their distance.

Most of the pairs of geoms that could touch never do: the links of an arm, the trunk of a robot that walks. Their
contacts would be most of a step's equations. Such pairs are only watched: a step in which one of them may touch is left
to C MuJoCo.

Two geoms are apart if there is a gap between the capsules around them, or between their extents along an axis of one of
them. Of a geom above a plane the extent decides alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.dynamics.rotations import rotate_each
from envs.physics.pairs import SHAPES, Pair, find_margin
from envs.physics.reach import enclose_geoms, find_gap

if TYPE_CHECKING:
    from mujoco import mjx

# Axes along which a shape reaches less far than the capsule around it.
FLAT_AXES = {"cylinder": (2,), "box": (0, 1, 2), "mesh": (0, 1, 2), "sdf": (0, 1, 2)}
PARALLEL = 1e-6  # squared sine of an angle, below which segments count as parallel in single precision
MANY_PAIRS = 64  # of geoms, above which those of a body are put together, so that there are fewer
THICKER = 3.0  # how much thicker than the thickest of them the one capsule around several of a body may be
LARGER = 3.0  # how much more volume than all of them the one box around several of a body may have


class Solid(NamedTuple):
    """A geom, or the one capsule or box around several of a body, with a capsule around it; in the body's frame.

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


def may_touch(model: mujoco.MjModel, d: mjx.Data, pairs: Sequence[Pair]) -> jax.Array:
    """Whether the geoms of any of these pairs may be within the margin of a contact, scalar of bool.

    Args:
      model: the model.
      d: with the poses of bodies.
      pairs: geoms of other shapes than height fields, of which only the first may be a plane.
    """
    groups: dict[tuple[str, str], list[tuple[Solid, Solid, float]]] = {}
    for one, other, margin in _list_solids(model, pairs):
        groups.setdefault((one.shape, other.shape), []).append((one, other, margin))
    return jnp.any(jnp.concatenate([_are_near(d, *group) for group in groups.items()]))


def _list_solids(model, pairs: Sequence[Pair]) -> list[tuple[Solid, Solid, float]]:
    """The pairs as solids with their margins; of very many pairs, several solids of a body become one."""
    capsules = enclose_geoms(model)
    solids = {geom: _make_solid(model, geom, capsules) for pair in pairs for geom in (pair.geom1, pair.geom2)}
    bundles = solids | _bundle_geoms(solids) if len(pairs) > MANY_PAIRS else solids
    margins: dict[tuple[int, int], float] = {}
    found: dict[tuple[int, int], tuple[Solid, Solid]] = {}
    for pair in pairs:
        table = solids if solids[pair.geom1].shape == "plane" else bundles
        one, other = table[pair.geom1], table[pair.geom2]
        key = id(one), id(other)
        found[key] = one, other
        margins[key] = max(margins.get(key, -np.inf), find_margin(model, pair))
    return [(*solids, margins[key]) for key, solids in found.items()]


def _bundle_geoms(solids: dict[int, Solid]) -> dict[int, Solid]:
    """The one capsule around a body's spheres and capsules, and the one box around its boxes, by geom."""
    found: dict[int, Solid] = {}
    for body in {solid.body for solid in solids.values()}:
        for shapes, enclose in ((("sphere", "capsule"), _enclose_in_capsule), (("box",), _enclose_in_box)):
            members = [geom for geom, solid in solids.items() if solid.body == body and solid.shape in shapes]
            bundle = enclose([solids[geom] for geom in members]) if len(members) > 1 else None
            if bundle is not None:
                found.update(dict.fromkeys(members, bundle))
    return found


def _make_solid(model, geom: int, capsules: tuple[np.ndarray, ...]) -> Solid:
    """A geom, with its capsule of those of `enclose_geoms`."""
    centre, axis, radius = (x[geom] for x in capsules)
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, model.geom_quat[geom])
    axes, shape = axes.reshape(3, 3), SHAPES[model.geom_type[geom]]
    size = model.geom_aabb[geom, 3:] if shape in ("mesh", "sdf") else model.geom_size[geom]
    body = int(model.geom_bodyid[geom])
    return Solid(shape, body, model.geom_pos[geom] + axes @ centre, axes, size, axes @ axis, float(radius))


def _enclose_in_capsule(solids: list[Solid]) -> Solid | None:
    """One capsule around all, along the longest line between their ends; None if it is much thicker than they are."""
    ends = np.concatenate([[solid.middle - solid.half, solid.middle + solid.half] for solid in solids])
    radii = np.repeat([solid.radius for solid in solids], 2)
    distances = np.linalg.norm(ends[:, None] - ends, axis=2)
    first, last = np.unravel_index(distances.argmax(), distances.shape)
    line = (ends[last] - ends[first]) / max(distances.max(), mujoco.mjMINVAL)
    along = (ends - ends[first]) @ line
    radius = float((np.linalg.norm(ends - ends[first] - along[:, None] * line, axis=1) + radii).max())
    if radius > THICKER * radii.max():
        return None
    low, high = along.min(), along.max()
    length = (high - low) / 2
    axes = np.stack([np.zeros(3), np.zeros(3), line], axis=1)  # of a capsule only the third one matters
    middle = ends[first] + (low + high) / 2 * line
    return Solid("capsule", solids[0].body, middle, axes, np.array([radius, length, 0.0]), length * line, radius)


def _enclose_in_box(solids: list[Solid]) -> Solid | None:
    """The smallest box around all in the axes of one of them; None if it has much more volume than they have."""
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    corners = np.concatenate([solid.middle + signs * solid.size @ solid.axes.T for solid in solids])
    spans = [(corners @ solid.axes).min(0) for solid in solids], [(corners @ solid.axes).max(0) for solid in solids]
    low, high = map(np.array, spans)
    best = int(np.prod(high - low, axis=1).argmin())
    axes, middle, size = solids[best].axes, (low[best] + high[best]) / 2, (high[best] - low[best]) / 2
    if np.prod(size) > LARGER * sum(np.prod(solid.size) for solid in solids):
        return None
    longest = int(size.argmax())
    radius = float(np.linalg.norm(np.delete(size, longest)))
    return Solid("box", solids[0].body, axes @ middle, axes, size, axes[:, longest] * size[longest], radius)


def _are_near(d: mjx.Data, shapes: tuple[str, str], pairs: list[tuple[Solid, Solid, float]]) -> jax.Array:
    """Whether the two solids of each pair may be within its margin, all of the same shapes, `[n]` of bool."""
    ones, others, margins = zip(*pairs, strict=True)
    one, other, margin = _Placed(d, ones), _Placed(d, others), np.array(margins)
    offset = other.middle - one.middle
    if shapes[0] == "plane":
        normal = one.axes[:, :, 2]
        return jnp.sum(normal * offset, axis=1) - other.find_extent(normal) < margin
    gap = find_gap(-offset, one.half, other.half, one.length, other.length, PARALLEL)
    near = jnp.sum(gap**2, axis=1) < (one.radius + other.radius + margin + _find_excess(one.length, other.length)) ** 2
    for solid in (one, other):
        for i in FLAT_AXES.get(solid.shape, ()):
            axis = solid.axes[:, :, i]
            reach = one.find_extent(axis) + other.find_extent(axis) + margin
            near = near & (jnp.abs(jnp.sum(axis * offset, axis=1)) < reach)
    return near


def _find_excess(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """A bound on how much `find_gap` exceeds the distance of two segments, for their half-lengths in m, `[n]`.

    It is exact for parallel segments, from whatever point it starts. Turning the shorter segment about its middle until
    it is parallel moves its points by at most shorter * sine. So the gap is too long by at most 2 shorter * sine. For
    angles that count as parallel this is 2 shorter sqrt(PARALLEL). At larger ones the start is wrong by rounding alone,
    and the gap too long by less than 6 eps longer / sine too (measured, eps = 6e-8). The less of both is at most
    sqrt(12 eps shorter longer), below the result, which also bounds the gap for angles that count as parallel.
    """
    return 2 * np.sqrt(PARALLEL * one * other)


class _Placed:
    """Solids of one shape in the world; attributes as of `Solid`, one row for each."""

    def __init__(self, d: mjx.Data, solids: Sequence[Solid]):
        _, bodies, middle, axes, self.size, half, self.radius = (np.array(x) for x in zip(*solids, strict=True))
        self.shape, self.length = solids[0].shape, np.linalg.norm(half, axis=1)
        rotation = d.xmat[bodies]
        self.middle = d.xpos[bodies] + rotate_each(rotation, middle)
        self.axes = jnp.matmul(rotation, axes)
        self.half = rotate_each(rotation, half)

    def find_extent(self, direction: jax.Array) -> jax.Array:
        """How far the geoms reach from their middle along unit vectors `[n, 3]`, in m, `[n]`."""
        if self.shape in ("box", "mesh", "sdf", "ellipsoid"):
            along = jnp.einsum("nij,ni->nj", self.axes, direction) * self.size
            return jnp.sqrt(jnp.sum(along**2, axis=1)) if self.shape == "ellipsoid" else jnp.sum(jnp.abs(along), axis=1)
        along = jnp.sum(self.axes[:, :, 2] * direction, axis=1)
        if self.shape == "cylinder":
            across = jnp.sqrt(jnp.maximum(1 - along**2, 0.0))
            return jnp.abs(along) * self.size[:, 1] + across * self.size[:, 0]
        length = self.size[:, 1] if self.shape == "capsule" else np.zeros(len(self.size))
        return jnp.abs(along) * length + self.size[:, 0]
