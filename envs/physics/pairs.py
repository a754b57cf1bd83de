"""Pairs of geoms that may touch, by MuJoCo's rules, without those that never meet within the ranges of the joints."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING

import numpy as np

from envs.physics.reach import Reach

if TYPE_CHECKING:
    import mujoco

# Fields of the model that decide whether two geoms can meet.
GEOMETRY = ("body_pos", "body_quat", "jnt_pos", "jnt_axis", "jnt_range", "qpos0")
GEOMETRY += ("geom_pos", "geom_quat", "geom_size", "geom_rbound", "geom_aabb", "geom_margin", "pair_margin")


SHAPES = ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh", "sdf")  # as mjtGeom


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two geoms that may touch, ordered as in MuJoCo's contacts: by type, then as the rules list them.

    `index` is that of the `<pair>` that names them, or -1; `condim` the number of dimensions of the contact force.
    """

    geom1: int
    geom2: int
    index: int
    condim: int


def candidate_pairs(model: mujoco.MjModel, varying: Collection[str] = ()) -> list[Pair]:
    """The pairs of geoms that may touch: those of `colliding_pairs` that can meet.

    Two geoms meet if their distance is at most the margin of their contact. A pair is left out only where bounding
    spheres stay further apart in every position within the ranges of the joints, widened as `reach.ALLOWANCE` says.

    Args:
      model: a compiled model.
      varying: fields of the model that may have other values than in it. With one of `GEOMETRY` all pairs are kept.
    """
    pairs = colliding_pairs(model)
    if not pairs or set(varying) & set(GEOMETRY):
        return pairs
    meets = Reach(model).can_meet([(pair.geom1, pair.geom2, find_margin(model, pair)) for pair in pairs])
    return [pair for pair, can in zip(pairs, meets, strict=True) if can]


def colliding_pairs(model: mujoco.MjModel) -> list[Pair]:
    """The pairs of geoms of which MuJoCo looks for contacts, those of `<pair>` first.

    Either the model lists the pair, with a margin that can be met, or the geoms match by contype and conaffinity, and
    their bodies move relative to each other and are neither excluded nor parent and child.
    """
    import mujoco

    if _is_disabled(model, "CONTACT") or _is_disabled(model, "CONSTRAINT"):
        return []
    listed = list(zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True))
    pairs = [
        Pair(*_sort(model, *pair), i, int(model.pair_dim[i]))
        for i, pair in enumerate(listed)
        if model.pair_margin[i] > -mujoco.mjMAXVAL and not _are_flat(model, *pair)
    ]
    known = {frozenset(pair) for pair in listed}
    for first, second in _list_matching(model):
        if frozenset((first, second)) not in known:
            pairs.append(Pair(*_sort(model, first, second), -1, _find_condim(model, first, second)))
    return pairs


def get_shapes(model: mujoco.MjModel, pair: Pair) -> tuple[str, str]:
    """The names of the shapes of a pair's geoms."""
    return SHAPES[model.geom_type[pair.geom1]], SHAPES[model.geom_type[pair.geom2]]


def has_constraints(model: mujoco.MjModel) -> bool:
    """Whether a step of the model may need the solver: equalities, friction loss, limits or possible contacts."""
    fields = (model.neq, model.dof_frictionloss, model.tendon_frictionloss, model.jnt_limited, model.tendon_limited)
    return not _is_disabled(model, "CONSTRAINT") and (any(map(np.any, fields)) or bool(colliding_pairs(model)))


def find_margin(model: mujoco.MjModel, pair: Pair) -> float:
    """The distance (m) at which MuJoCo makes a contact of the pair."""
    import mujoco

    if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE:
        return float(model.opt.o_margin)
    if pair.index >= 0:
        return float(model.pair_margin[pair.index])
    return float(model.geom_margin[[pair.geom1, pair.geom2]].sum())


def _list_matching(model: mujoco.MjModel) -> Iterator[tuple[int, int]]:
    """Pairs of geoms that collide by the masks of the geoms and the kinship of their bodies."""
    touching = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    bodies = {body: touching[model.geom_bodyid[touching] == body] for body in np.unique(model.geom_bodyid[touching])}
    for one, other in itertools.combinations(bodies, 2):
        if _bodies_meet(model, int(one), int(other)):
            for first, second in itertools.product(bodies[one].tolist(), bodies[other].tolist()):
                if _geoms_match(model, first, second):
                    yield first, second


def _bodies_meet(model: mujoco.MjModel, first: int, second: int) -> bool:
    if (min(first, second) << 16) + max(first, second) in model.exclude_signature:
        return False
    one, other = (int(x) for x in model.body_weldid[[first, second]])
    if one == other or not model.body_dofnum[[one, other]].any():  # bodies moved from outside have no dofs
        return False
    parents = model.body_weldid[model.body_parentid[[one, other]]]
    related = one and other and (parents[0] == other or parents[1] == one)
    return not related or _is_disabled(model, "FILTERPARENT")


def _geoms_match(model: mujoco.MjModel, first: int, second: int) -> bool:
    if _are_flat(model, first, second):
        return False
    kinds, wanted = model.geom_contype, model.geom_conaffinity
    return bool(kinds[first] & wanted[second] or kinds[second] & wanted[first])


def _are_flat(model: mujoco.MjModel, first: int, second: int) -> bool:
    """Whether both are planes or height fields, which do not touch each other."""
    import mujoco

    return bool(max(model.geom_type[[first, second]]) <= int(mujoco.mjtGeom.mjGEOM_HFIELD))


def _sort(model: mujoco.MjModel, first: int, second: int) -> tuple[int, int]:
    return (second, first) if model.geom_type[first] > model.geom_type[second] else (first, second)


def _find_condim(model: mujoco.MjModel, first: int, second: int) -> int:
    """That of the geom of higher priority, else the larger."""
    priorities, condims = model.geom_priority[[first, second]], model.geom_condim[[first, second]]
    if priorities[0] == priorities[1]:
        return int(condims.max())
    return int(condims[priorities.argmax()])


def _is_disabled(model: mujoco.MjModel, name: str) -> bool:
    import mujoco

    return bool(model.opt.disableflags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"))
