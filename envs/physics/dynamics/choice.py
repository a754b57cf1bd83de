"""Which contacts are part of a step's equations, and which are watched and left to C MuJoCo."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence

import mujoco
import numpy as np

from envs.physics.dynamics.shapes import DEEPEST_ONLY, NUM_CONTACTS
from envs.physics.pairs import Pair, get_shapes
from envs.physics.primitives import UnsupportedPrimitiveError

MOST_CONTACTS = 32  # points of contact that the equations of a step may have
SECONDS = 1.0  # of the simulation that shows what touches, from each keyframe, or else from the initial position
SELDOM = 0.05  # share of its steps; what touches in fewer is not chosen
VARYING_SHAPES = ("geom_pos", "geom_quat", "geom_size", "geom_rbound", "geom_aabb", "geom_margin", "pair_margin")
# Pairs of shapes whose contacts are C MuJoCo's only up to the accuracy, or the number of points, of its own iteration.
APPROXIMATE = DEEPEST_ONLY | {("ellipsoid", "ellipsoid")}


def choose_pairs(
    model: mujoco.MjModel, pairs: Sequence[Pair], varying: Collection[str] = ()
) -> tuple[list[Pair], list[Pair]]:
    """(chosen, watched): the pairs whose contacts are written out as equations, and the others.

    Chosen are contacts with fixed planes, and what touches while the robot stands or falls without commands, most
    frequent ones first, up to `MOST_CONTACTS` points. If planes alone have more, they too must touch to be chosen.

    Args:
      model: a compiled model.
      pairs: candidate pairs.
      varying: fields of the model that may have other values than in it; if shapes may, no pair can be watched.

    Raises:
      UnsupportedPrimitiveError: shapes may vary whose contacts have no form as equations.
    """
    if set(varying) & set(VARYING_SHAPES):
        formless = sorted({get_shapes(model, pair) for pair in pairs} - NUM_CONTACTS.keys())
        if formless:
            raise UnsupportedPrimitiveError(f"contacts of {' and '.join(formless[0])} of shapes that vary")
        return list(pairs), []
    possible = [pair for pair in pairs if get_shapes(model, pair) in NUM_CONTACTS.keys() - APPROXIMATE]
    floor = [pair for pair in possible if _is_floor(model, pair)]
    chosen = floor if count_points(model, floor) <= MOST_CONTACTS else []
    others = [pair for pair in possible if pair not in chosen]
    for pair in _list_frequent(model, others) if others else []:
        if count_points(model, [*chosen, pair]) <= MOST_CONTACTS:
            chosen = [*chosen, pair]
    return chosen, [pair for pair in pairs if pair not in chosen]


def _is_floor(model: mujoco.MjModel, pair: Pair) -> bool:
    """Whether the first geom is a plane that does not move."""
    is_fixed = model.body_weldid[model.geom_bodyid[pair.geom1]] == 0
    return bool(is_fixed) and get_shapes(model, pair)[0] == "plane"


def count_points(model: mujoco.MjModel, pairs: Sequence[Pair]) -> int:
    """How many points of contact the pairs can have together."""
    return sum(NUM_CONTACTS[get_shapes(model, pair)] for pair in pairs)


def _list_frequent(model: mujoco.MjModel, pairs: Sequence[Pair]) -> list[Pair]:
    """The pairs that touch in at least the share `SELDOM` of the steps of a simulation, most frequent first."""
    counts: Counter[frozenset[int]] = Counter()
    num_steps = max(int(SECONDS / model.opt.timestep), 1)
    starts = range(model.nkey) if model.nkey else [None]
    for key in starts:
        data = mujoco.MjData(model)
        if key is not None:
            mujoco.mj_resetDataKeyframe(model, data, key)
        for _ in range(num_steps):
            mujoco.mj_step(model, data)
            touching = data.contact.geom[np.asarray(data.contact.efc_address) >= 0]
            counts.update({frozenset(geoms) for geoms in touching.tolist()})
    share = {pair: counts[frozenset((pair.geom1, pair.geom2))] / (num_steps * len(starts)) for pair in pairs}
    return sorted((pair for pair in pairs if share[pair] >= SELDOM), key=lambda pair: -share[pair])
