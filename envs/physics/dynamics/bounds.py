"""Bounds on the distances of watched pairs that take few equations, and seldom say in vain that geoms may touch.

A bound is of two solids: around some geoms of one body, and around some of a second one. One pair of spheres is enough
for two bodies that stay far apart. Where it is not, there are capsules, boxes, or bounds of fewer geoms, down to those
of a single pair. What is enough is a matter of speed alone: each bound holds in any position. A step that is left to C
MuJoCo in vain counts as many equations, and how often that would be is counted in some simulations and positions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from envs.physics.dynamics.simulations import COMMANDED, Poses, draw_poses, simulate
from envs.physics.dynamics.solids import Solid, list_enclosures, make_solids
from envs.physics.dynamics.watch import FLAT_AXES, Bound, Placed, are_near
from envs.physics.pairs import Pair, find_margin

# Of robots with 7 to 18 degrees of freedom, C MuJoCo's step takes as long as 50,000 to 200,000 equations. A low number,
# as equations also have to be compiled.
C_STEP = 50_000
# Numbers of equations, as counted: of the pose of a solid in the world,
PLACING = {"plane": 0, "sphere": 18, "capsule": 33, "ellipsoid": 33, "cylinder": 36, "box": 66, "mesh": 66, "sdf": 66}
HEIGHT = {"sphere": 6, "other": 15}  # of the height above a plane,
GAP = (10, 24, 61)  # of the gap between capsules, of which so many have a segment,
EXTENT = {"sphere": 10, "other": 23}  # and of the extents along the axis of a solid, by the shape of the other one

GeomPair = tuple[int, int]


class Cover(NamedTuple):
    """Bounds of some pairs, and their cost: equations, and steps that they leave to C MuJoCo in vain."""

    cost: float
    bounds: list[Bound]


def choose_bounds(model: mujoco.MjModel, pairs: Sequence[Pair]) -> list[Bound]:
    """Bounds that together say whether any of the pairs may touch.

    Args:
      model: a compiled model.
      pairs: geoms of other shapes than height fields, of which only the first may be a plane.
    """
    solids, margins = make_solids(model), {}
    for pair in pairs:
        geoms = _sort_by_body(solids, pair)
        margins[geoms] = max(margins.get(geoms, -np.inf), find_margin(model, pair))
    samples = [simulate(model, 0).poses, draw_poses(model)]
    samples += [simulate(model, COMMANDED).poses] if model.nu else []
    chooser = _Chooser(solids, margins, [poses for poses in samples if len(poses.xpos)])
    bounds: list[Bound] = []
    for group in _group(solids, list(margins)):
        bounds += chooser.cover(group, bounds).bounds
    return bounds


def _sort_by_body(solids: list[Solid], pair: Pair) -> GeomPair:
    """The two geoms, a plane first, and else by their bodies."""
    is_sorted = solids[pair.geom1].shape == "plane" or solids[pair.geom1].body <= solids[pair.geom2].body
    return (pair.geom1, pair.geom2) if is_sorted else (pair.geom2, pair.geom1)


def _group(solids: list[Solid], pairs: list[GeomPair]) -> list[list[GeomPair]]:
    """The pairs of the same two bodies, and those of the same plane and body."""
    groups: dict[tuple, list[GeomPair]] = {}
    for pair in pairs:
        one, other = (solids[geom] for geom in pair)
        groups.setdefault((one.body, other.body, pair[0] if one.shape == "plane" else None), []).append(pair)
    return list(groups.values())


class _Chooser:
    """Chooses bounds by samples of the poses of bodies, each of which has the same weight."""

    def __init__(self, solids: list[Solid], margins: dict[GeomPair, float], samples: list[Poses]):
        self.solids, self.margins = solids, margins
        self.poses = Poses(*(np.concatenate(x) for x in zip(*samples, strict=True)))
        self.weights = np.concatenate([np.full(len(x.xpos), 1 / len(x.xpos) / len(samples)) for x in samples])
        self.placed: dict[int, Placed] = {}
        self.enclosures: dict[tuple[int, ...], list[Solid]] = {}
        self.near = {pair: self._is_near(self._bound(solids[pair[0]], solids[pair[1]], [pair])) for pair in margins}

    def cover(self, pairs: list[GeomPair], others: Sequence[Bound]) -> Cover:
        """The cheapest cover of pairs of geoms of two bodies, where there are these other bounds anyway."""
        best = Cover(np.inf, [])
        for equations, bound in self._list_bounds(pairs, others):
            if equations < best.cost:
                cover = Cover(equations + C_STEP * self._count_in_vain(bound, pairs), [bound])
                best = min(best, cover, key=lambda x: x.cost)
        if len(pairs) > 1 and best.cost > 2 * GAP[0]:
            best = min(best, self._divide(pairs, others), key=lambda x: x.cost)
        return best

    def _divide(self, pairs: list[GeomPair], others: Sequence[Bound]) -> Cover:
        """The cover of two halves."""
        one, other = _halve(self.solids, pairs)
        first = self.cover(one, others)
        second = self.cover(other, [*others, *first.bounds])
        return Cover(first.cost + second.cost, first.bounds + second.bounds)

    def _list_bounds(self, pairs: list[GeomPair], others: Sequence[Bound]) -> list[tuple[int, Bound]]:
        """The single bounds of all the pairs, with their numbers of equations, fewest first."""
        known = {id(solid) for bound in others for solid in (bound.one, bound.other)}
        ones, twos = (self._enclose({pair[side] for pair in pairs}) for side in (0, 1))
        bounds = [self._bound(one, two, pairs) for one in ones for two in twos]
        return sorted(((_count_equations(bound, known), bound) for bound in bounds), key=lambda x: x[0])

    def _bound(self, one: Solid, other: Solid, pairs: list[GeomPair]) -> Bound:
        return Bound(one, other, max(self.margins[pair] for pair in pairs))

    def _enclose(self, geoms: set[int]) -> list[Solid]:
        key = tuple(sorted(geoms))
        if key not in self.enclosures:
            self.enclosures[key] = list_enclosures([self.solids[geom] for geom in key])
        return self.enclosures[key]

    def _count_in_vain(self, bound: Bound, pairs: list[GeomPair]) -> float:
        """The share of the positions in which the bound says "near", and the bounds of the single pairs do not."""
        return float(self.weights @ (self._is_near(bound) & ~np.any([self.near[pair] for pair in pairs], axis=0)))

    def _is_near(self, bound: Bound) -> np.ndarray:
        """Whether the solids of a bound may be within its margin in each position, `[T]` of bool."""
        return are_near(self._place(bound.one), self._place(bound.other), np.array([bound.margin]))[:, 0]

    def _place(self, solid: Solid) -> Placed:
        if id(solid) not in self.placed:
            self.placed[id(solid)] = Placed(*self.poses, [solid])
        return self.placed[id(solid)]


def _halve(solids: list[Solid], pairs: list[GeomPair]) -> tuple[list[GeomPair], list[GeomPair]]:
    """The pairs of the geoms in two halves of a body, of that one whose geoms are spread out more."""
    sides = [np.unique([pair[side] for pair in pairs]) for side in (0, 1)]
    middles = [np.array([solids[geom].middle for geom in geoms]) for geoms in sides]
    spreads = [np.ptp(x, axis=0) for x in middles]
    side = max((0, 1), key=lambda i: (len(sides[i]) > 1, spreads[i].max()))
    order = np.argsort(middles[side][:, spreads[side].argmax()], kind="stable")
    half = set(sides[side][order[: len(order) // 2]].tolist())
    return [pair for pair in pairs if pair[side] in half], [pair for pair in pairs if pair[side] not in half]


def _count_equations(bound: Bound, known: set[int]) -> int:
    """About how many equations a bound has, without those of the poses of known solids, given by `id`."""
    one, other = bound.one, bound.other
    number = sum(PLACING[solid.shape] for solid in (one, other) if id(solid) not in known)
    if one.shape == "plane":
        return number + HEIGHT.get(other.shape, HEIGHT["other"])
    number += GAP[int(one.half.any()) + int(other.half.any())]
    for solid, partner in ((one, other), (other, one)):
        number += len(FLAT_AXES.get(solid.shape, ())) * EXTENT.get(partner.shape, EXTENT["other"])
    return number
