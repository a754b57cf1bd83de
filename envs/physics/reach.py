"""Whether two geoms can meet within the ranges of the joints: a bound on their distance, never a guess.

Each geom is enclosed in a capsule: the points within `r` of a segment. Between two of them lies a chain of joints. At
the centre of a box of joint positions, let `n` be the unit vector from one segment to the other. Seen from a link in
the middle of the chain, an end `p` of a segment moves along `n`, if the joints move by at most `h_j`, by at most

    sum_j |n . (u_j x (p - c_j))| h_j + 1/2 sum_jk a_max(j, k) h_j h_k :

the first derivatives (hinges of axes `u_j` through `c_j`) and a bound on the second ones, in which joints count from
the link on, and `a_k` is the largest distance of the end from the axis of joint `k` anywhere in the box. Nor does the
end move by more than `sum_j 2 b_j sin(h_j / 2)`, with the distances `b_j` at the centre, if the joints move one after
the other from the link on: this is less for large boxes. What is left of the distance, less the radii, is a bound on
the distance anywhere in the box. A box where it does not exceed the margin is halved, until all boxes are safe, a
centre shows that the capsules meet, or there are too many boxes: then the geoms are said to meet.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import mujoco

# Limits of joints are soft: positions beyond the range that count as possible, in rad and as a fraction of the range.
ALLOWANCE = {"hinge": 0.2, "slide": 0.2}
MAX_BOXES = 2000  # boxes of joint positions to look at for two bodies
NUM_SAMPLES = 300  # random positions that are tried first
PARALLEL = 1e-12  # squared sine of an angle that is more than rounding
SMALL = 1e-15  # mjMINVAL


class Reach:
    """The positions that the joints of a model can take, and the capsules around its geoms."""

    def __init__(self, model: mujoco.MjModel):
        import mujoco

        self._model, self._data = model, mujoco.MjData(model)
        self._low, self._high = find_ranges(model)
        self._is_plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        self._is_unknown = model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD
        self._centre, self._axis, self._radius = enclose_geoms(model)

    def can_meet(self, pairs: Sequence[tuple[int, int, float]]) -> np.ndarray:
        """Whether the geoms of each pair `(geom, geom, margin in m)` can come as close as the margin, `[P]` of bool."""
        meets = self._meet_somewhere(pairs)
        bodies = self._model.geom_bodyid
        groups = {}
        for number in np.flatnonzero(~meets).tolist():
            groups.setdefault((*bodies[list(pairs[number][:2])],), []).append(number)
        for (one, other), numbers in groups.items():
            chain = self._find_chain(int(one), int(other))
            meets[numbers] = True if chain is None else self._search(chain, [pairs[i] for i in numbers])
        return meets

    # --- positions ----------------------------------------------------------------------------------------------------

    def _place(self, joints: Sequence[int], positions: np.ndarray, geoms: np.ndarray):
        """Ends of the geoms' segments, `[N, G, 2, 3]`, normals of planes, and the joints' anchors and axes."""
        import mujoco

        model, data = self._model, self._data
        data.qpos[:] = model.qpos0
        addresses, number = model.jnt_qposadr[list(joints)], len(positions)
        places, frames = np.empty((number, model.ngeom, 3)), np.empty((number, model.ngeom, 9))
        anchors, axes = np.empty((2, number, model.njnt, 3))
        for i, position in enumerate(positions):
            data.qpos[addresses] = position
            mujoco.mj_kinematics(model, data)
            places[i], frames[i], anchors[i], axes[i] = data.geom_xpos, data.geom_xmat, data.xanchor, data.xaxis
        frames = frames[:, geoms].reshape(number, len(geoms), 3, 3)
        middle = places[:, geoms] + np.einsum("ngij,gj->ngi", frames, self._centre[geoms])
        half = np.einsum("ngij,gj->ngi", frames, self._axis[geoms])
        return np.stack([middle - half, middle + half], 2), frames[..., 2], anchors[:, joints], axes[:, joints]

    def _find_distance(self, ends, normals, first: np.ndarray, second: np.ndarray, pairs):
        """Distances between the capsules of pairs, beyond the margin, `[N, P]` in m; unit vectors between them."""
        geoms = np.array([pair[:2] for pair in pairs])
        middle, half = ends.mean(2), (ends[..., 1, :] - ends[..., 0, :]) / 2
        offset, length = middle[:, second] - middle[:, first], np.linalg.norm(half, axis=-1)
        gap = find_gap(offset, half[:, second], half[:, first], length[:, second], length[:, first], PARALLEL)
        apart = np.linalg.norm(gap, axis=-1)
        is_plane, normal = self._is_plane[geoms[:, 0]], normals[:, first]
        height = np.einsum("npki,npi->npk", ends[:, second] - ends[:, first, :1], normal).min(2)
        direction = np.where(is_plane[:, None], normal, gap / np.maximum(apart, 1e-300)[..., None])
        reserve = self._radius[geoms].sum(1) + np.array([pair[2] for pair in pairs])
        return np.where(is_plane, height, apart) - reserve, direction

    def _meet_somewhere(self, pairs) -> np.ndarray:
        """Whether the capsules of each pair meet in one of some random positions, or nothing is known of them."""
        import mujoco

        model = self._model
        scalar = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
        joints = np.flatnonzero(scalar & np.isfinite(self._low))
        random = np.random.default_rng(0)
        positions = random.uniform(self._low[joints], self._high[joints], (NUM_SAMPLES, len(joints)))
        geoms, places = np.unique([pair[:2] for pair in pairs], return_inverse=True)
        first, second = places.reshape(-1, 2).T
        ends, normals, *_ = self._place(joints.tolist(), positions, geoms)
        unknown = self._is_unknown[geoms]
        distance, _ = self._find_distance(ends, normals, first, second, pairs)
        return (distance <= 0).any(0) | unknown[first] | unknown[second]

    # --- the chain between two bodies ---------------------------------------------------------------------------------

    def _find_chain(self, one: int, other: int) -> list[int] | None:
        """The joints between two bodies, in order; None if one has no bounds, or a body is moved from outside."""
        paths = [self._list_ancestors(body) for body in (one, other)]
        common = set(paths[0]) & set(paths[1])
        up, down = ([body for body in path if body not in common] for path in paths)
        if (self._model.body_mocapid[[*up, *down]] >= 0).any():
            return None
        joints = [j for body in up for j in reversed(self._list_joints(body))]
        joints += [j for body in reversed(down) for j in self._list_joints(body)]
        return joints if np.isfinite(self._low[joints]).all() else None

    def _list_ancestors(self, body: int) -> list[int]:
        path = [body]
        while path[-1]:
            path.append(int(self._model.body_parentid[path[-1]]))
        return path

    def _list_joints(self, body: int) -> list[int]:
        begin = int(self._model.body_jntadr[body])
        return list(range(begin, begin + int(self._model.body_jntnum[body])))

    # --- the search ---------------------------------------------------------------------------------------------------

    def _search(self, chain: list[int], pairs) -> np.ndarray:
        """Whether each pair of geoms of two bodies can meet, `[P]` of bool."""
        geoms, places = np.unique([pair[:2] for pair in pairs], return_inverse=True)
        search = _Search(self, chain, pairs, geoms, *places.reshape(-1, 2).T)
        boxes = np.stack([self._low[chain], self._high[chain]], 1)[None]
        meets, undecided, number = np.zeros(len(pairs), bool), np.ones((1, len(pairs)), bool), 0
        while undecided.any():
            number += len(boxes)
            if number > MAX_BOXES:
                return meets | undecided.any(0)
            centre, half = boxes.mean(2), (boxes[..., 1] - boxes[..., 0]) / 2
            distance, moves = search.bound(centre, half)
            meets |= ((distance <= 0) & undecided).any(0)
            undecided &= (distance - moves.sum(2) <= 0) & ~meets
            if undecided.any():
                boxes, undecided = _split(boxes, undecided, np.where(undecided[..., None], moves, 0).max(1))
        return meets


@dataclasses.dataclass
class _Search:
    """Bounds on the distances of some pairs of geoms of two bodies, as functions of boxes of joint positions."""

    reach: Reach
    chain: list[int]
    pairs: Sequence[tuple[int, int, float]]
    geoms: np.ndarray
    first: np.ndarray
    second: np.ndarray

    def __post_init__(self):
        import mujoco

        model = self.reach._model
        self.is_slide = model.jnt_type[self.chain] == mujoco.mjtJoint.mjJNT_SLIDE
        start = model.qpos0[model.jnt_qposadr[self.chain]]
        low, high = self.reach._low[self.chain], self.reach._high[self.chain]
        self.travel = np.where(self.is_slide, np.maximum(np.abs(low - start), np.abs(high - start)), 0)
        ends, _, anchors, _ = self.reach._place(self.chain, start[None], self.geoms)
        self.limits = self._find_limits(ends[0], anchors[0])
        is_first = self.limits[0] < self.limits[1]  # the joints that turn the shorter side
        self.belongs = is_first, ~is_first

    def bound(self, centre: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances at the centres of boxes `[N, P]`, and by how much each joint may lessen them, `[N, P, J]`."""
        ends, normals, anchors, axes = self.reach._place(self.chain, centre, self.geoms)
        distance, direction = self.reach._find_distance(ends, normals, self.first, self.second, self.pairs)
        straight = curved = np.zeros(())
        for side, places in enumerate((self.first, self.second)):
            arms, slopes = _find_arms(ends[:, places], anchors, axes, direction, self.is_slide)
            moves = np.where(self.is_slide, 1.0, arms) * self._find_turns(half)[:, None]
            order = np.arange(len(self.chain))[:: -1 if side else 1]  # from the geom on
            moved = np.cumsum(moves[..., order], -1)[..., order] - moves  # by the joints nearer to the geom
            arms = np.minimum(self.limits[side], arms + moved)
            straight = straight + np.where(self.belongs[side], moves, 0)
            curved = curved + self._find_curved_moves(arms, slopes, half, order, self.belongs[side])
        return distance, np.where((curved.sum(2) < straight.sum(2))[..., None], curved, straight)

    def _find_turns(self, half: np.ndarray) -> np.ndarray:
        """How far the joints move a point at the distance 1 m from their axes at most, `[N, J]` in m."""
        return np.where(self.is_slide, half, 2 * np.sin(np.minimum(half, np.pi) / 2))

    def _find_curved_moves(self, arms, slopes, half, order, belongs) -> np.ndarray:
        """The largest displacement along the direction between the geoms, by the joints that belong to a side."""
        moves = slopes * half[:, None]
        bends = np.where(self.is_slide, 0, arms)
        for place, k in enumerate(order):
            for j in order[place:]:  # from joint k on, away from the geom
                bend = 1.0 if self.is_slide[k] and not self.is_slide[j] else bends[..., k]
                term = (0.5 if j == k else 1.0) * bend * (half[:, j] * half[:, k])[:, None] * belongs[:, j]
                moves[..., j] += term
        return np.where(belongs, moves, 0)

    def _find_limits(self, ends, anchors) -> list[np.ndarray]:
        """The longest arms of both sides in any position, `[P, J]`: lengths of the links between, and travels."""
        if not len(anchors):
            return [np.zeros((len(self.pairs), 0))] * 2
        links = np.linalg.norm(np.diff(anchors, axis=0), axis=1)
        limits = []
        for places, side in ((self.first, slice(None)), (self.second, slice(None, None, -1))):
            near = np.linalg.norm(ends[places] - anchors[side][:1], axis=2).max(1)
            steps = np.concatenate([near[:, None], np.broadcast_to(links[side], (len(places), len(links)))], 1)
            limits.append((np.cumsum(steps, 1) + np.cumsum(self.travel[side]))[:, side])
        planes = self.reach._is_plane[self.geoms]
        return [np.where(planes[x][:, None], np.inf, y) for x, y in zip((self.first, self.second), limits, strict=True)]


def _split(boxes: np.ndarray, undecided: np.ndarray, moves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Halves the boxes that are undecided for some pair, across the joint that moves most there."""
    rest = undecided.any(1)
    boxes, undecided = boxes[rest], undecided[rest]
    rows, joint = np.arange(len(boxes)), moves[rest].argmax(1)
    lower, upper = boxes.copy(), boxes.copy()
    lower[rows, joint, 1] = upper[rows, joint, 0] = boxes[rows, joint].mean(1)
    return np.concatenate([lower, upper]), np.concatenate([undecided, undecided])


def find_ranges(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of each joint's position, infinite where there are none, that include the initial one and keyframes."""
    import mujoco

    kinds, disable = mujoco.mjtJoint, mujoco.mjtDisableBit
    hinge, slide = model.jnt_type == kinds.mjJNT_HINGE, model.jnt_type == kinds.mjJNT_SLIDE
    off = disable.mjDSBL_LIMIT | disable.mjDSBL_CONSTRAINT
    limited = model.jnt_limited.astype(bool) & (hinge | slide) & (not model.opt.disableflags & off)
    low, high = model.jnt_range.T
    allowance = np.where(hinge, ALLOWANCE["hinge"], ALLOWANCE["slide"] * (high - low))
    known = np.concatenate([model.qpos0[None], model.key_qpos])[:, model.jnt_qposadr]
    low, high = np.minimum(low - allowance, known.min(0)), np.maximum(high + allowance, known.max(0))
    free = np.where(hinge, np.pi, np.inf)
    return np.where(limited, low, -free), np.where(limited, high, free)


def enclose_geoms(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Capsules around the geoms, in their frames: the middle, half the segment, and the radius.

    A box lies within the capsule whose segment is its longest axis, and whose radius is half its other diagonal. An
    ellipsoid of semi-axes a >= b >= c lies within a capsule as long as itself, of radius b: at x > a - b along its
    axis, (x - a + b)^2 + b^2 (1 - x^2 / a^2) is convex in x and at both ends at most b^2.
    """
    import mujoco

    centre, size = model.geom_aabb[:, :3].copy(), model.geom_aabb[:, 3:].copy()
    longest, rows = size.argmax(1), np.arange(model.ngeom)
    axis = np.zeros((model.ngeom, 3))
    axis[rows, longest] = size[rows, longest]
    others = np.array([[1, 2], [0, 2], [0, 1]])[longest]
    radius = np.linalg.norm(size[rows[:, None], others], axis=1)
    for geom, kind in enumerate(map(mujoco.mjtGeom, model.geom_type.tolist())):
        name, given = kind.name.removeprefix("mjGEOM_"), model.geom_size[geom]
        if name in ("SPHERE", "CAPSULE", "CYLINDER"):
            length = 0 if name == "SPHERE" else given[1]
            centre[geom], axis[geom], radius[geom] = 0, (0, 0, length), given[0]
        elif name == "PLANE":
            centre[geom], axis[geom], radius[geom] = 0, 0, 0
        elif name == "ELLIPSOID":
            radius[geom] = size[geom, others[geom]].max()
            axis[geom, longest[geom]] -= radius[geom]
    return centre, axis, radius


def _find_arms(ends, anchors, axes, direction, is_slide) -> tuple[np.ndarray, np.ndarray]:
    """The larger distance of the ends of segments `[N, P, 2, 3]` from the axes of joints, `[N, P, J]`.

    And the larger speed of the ends along a direction `[N, P, 3]`, if the joint moves by 1 rad/s, or m/s.
    """
    axes = axes[:, None, None]
    speeds = np.cross(axes, ends[:, :, :, None] - anchors[:, None, None])
    arms = np.linalg.norm(speeds, axis=-1).max(2)
    speeds = np.where(is_slide[:, None], axes, speeds)
    return arms, np.abs(np.einsum("npkji,npi->npkj", speeds, direction)).max(2)


def find_gap(offset, u, v, one: np.ndarray, other: np.ndarray, parallel: float):
    """The shortest vector from the segment t v to offset + s u, |s|, |t| <= 1, `[..., 3]`.

    The best s for the whole lines, the best t for this s, and the best s for that t, each within its bounds, are the
    solution (Ericson, "Real-Time Collision Detection", section 5.1.9).

    Args:
      offset, u, v: `[..., 3]`, arrays of numpy or of jax.
      one, other: |u| and |v|, known when tracing, `[...]`.
      parallel: the squared sine of an angle below which s and t are less exact; more than the rounding errors.
    """
    gap = offset
    if not other.any():
        return offset + _divide(-(u * offset).sum(-1), one)[..., None] * u if one.any() else offset
    along_other = (v * offset).sum(-1)
    if one.any():
        along_one, mixed, areas = (u * offset).sum(-1), (u * v).sum(-1), (one * other) ** 2
        across = (areas - mixed**2).clip(parallel * areas + SMALL)
        s = ((mixed * along_other - along_one * other**2) / across).clip(-1, 1)
        s = _divide(mixed * _divide(mixed * s + along_other, other) - along_one, one)
        gap = offset + s[..., None] * u
        along_other = along_other + s * mixed
    return gap - _divide(along_other, other)[..., None] * v


def _divide(x, length: np.ndarray):
    """x / length^2 between -1 and 1; 0 for a segment without length."""
    return (x * np.where(length > 0, 1 / np.maximum(length, 1e-6) ** 2, 0.0)).clip(-1, 1)
