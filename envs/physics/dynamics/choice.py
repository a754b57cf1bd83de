"""Which contacts are part of a step's equations, and which are watched and left to C MuJoCo."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import mujoco
import numpy as np

from envs.physics.dynamics.kinematics import find_carriers
from envs.physics.dynamics.shapes import DEEPEST_ONLY, NUM_CONTACTS
from envs.physics.dynamics.simulations import COMMANDED, simulate
from envs.physics.pairs import Pair, get_shapes
from envs.physics.primitives import UnsupportedPrimitiveError

MOST_CONTACTS = 32  # points of contact that the equations of a step may have
SELDOM = 0.05  # share of the steps without commands; what touches in fewer is not chosen
LIGHT = 80  # as `_weigh` has it: some 500 equations
OFTEN = 0.2  # share of the steps with random commands, which are rougher than those of most tasks
VARYING_SHAPES = ("geom_pos", "geom_quat", "geom_size", "geom_rbound", "geom_aabb", "geom_margin", "pair_margin")
# Pairs of shapes whose contacts are C MuJoCo's only up to the accuracy, or the number of points, of its own iteration.
APPROXIMATE = DEEPEST_ONLY | {("ellipsoid", "ellipsoid")}


def choose_pairs(
    model: mujoco.MjModel, pairs: Sequence[Pair], varying: Collection[str] = ()
) -> tuple[list[Pair], list[Pair]]:
    """(chosen, watched): the pairs whose contacts are written out as equations, and the others.

    Chosen are the contacts of robots that go anywhere with fixed planes; what touches while the robot stands or falls
    without commands; and between bodies that often touch under random commands all contacts that cost little, because
    few joints move the geoms against each other, as with the fingers of a gripper. All of it up to `MOST_CONTACTS`
    points, most frequent ones first. If planes alone have more, they too must touch to be chosen.

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
    light = [pair for pair in others if _weigh(model, pair) <= LIGHT]
    often = {_find_bodies(model, pair) for pair in _list_frequent(model, light, COMMANDED, OFTEN)}
    meeting = [pair for pair in light if _find_bodies(model, pair) in often]
    for pair in dict.fromkeys([*_list_frequent(model, others, 0, SELDOM), *meeting]):
        if count_points(model, [*chosen, pair]) <= MOST_CONTACTS:
            chosen = [*chosen, pair]
    return chosen, [pair for pair in pairs if pair not in chosen]


def _is_floor(model: mujoco.MjModel, pair: Pair) -> bool:
    """Whether the first geom is a plane that does not move, and the second one's body goes as far as it likes."""
    one, other = _find_bodies(model, pair)
    is_fixed = model.body_weldid[one] == 0
    return bool(is_fixed) and get_shapes(model, pair)[0] == "plane" and _goes_anywhere(model, other)


def _find_bodies(model: mujoco.MjModel, pair: Pair) -> tuple[int, int]:
    """The numbers of the two bodies."""
    return int(model.geom_bodyid[pair.geom1]), int(model.geom_bodyid[pair.geom2])


def _goes_anywhere(model: mujoco.MjModel, body: int) -> bool:
    """Whether a free joint or a slide without limits moves the body."""
    joints = np.unique(model.dof_jntid[find_carriers(model)[body]])
    types, is_limited = model.jnt_type[joints], model.jnt_limited[joints].astype(bool)
    is_slide = types == mujoco.mjtJoint.mjJNT_SLIDE
    return bool(np.any((types == mujoco.mjtJoint.mjJNT_FREE) | (is_slide & ~is_limited)))


def _weigh(model: mujoco.MjModel, pair: Pair) -> int:
    """Points of contact, times condim^2, times the degrees of freedom that move the geoms against each other.

    The Hessian's part of a contact has about eight times as many equations.
    """
    one, other = find_carriers(model)[list(_find_bodies(model, pair))]
    return NUM_CONTACTS[get_shapes(model, pair)] * pair.condim**2 * int((one != other).sum())


def count_points(model: mujoco.MjModel, pairs: Sequence[Pair]) -> int:
    """How many points of contact the pairs can have together."""
    return sum(NUM_CONTACTS[get_shapes(model, pair)] for pair in pairs)


def drop_rarest(model: mujoco.MjModel, pairs: Sequence[Pair], share: float) -> tuple[list[Pair], list[Pair]]:
    """(kept, dropped): drops those that touch least often, until their equations are a share of those of all.

    First the share of the steps without commands counts, then that of the steps with commands. At least one is dropped.

    Args:
      model: a compiled model.
      pairs: chosen pairs, one or more.
      share: of the equations of all these contacts, in which each has as many as `_weigh` has it.
    """
    samples = [simulate(model, commanded).counts for commanded in (0, COMMANDED)[: 1 + bool(model.nu)]]
    rarest = sorted(pairs, key=lambda pair: [counts[frozenset((pair.geom1, pair.geom2))] for counts in samples])
    reached = np.cumsum([_weigh(model, pair) for pair in rarest])
    number = 1 + int(np.searchsorted(reached, share * reached[-1]))
    dropped = rarest[:number]
    return [pair for pair in pairs if pair not in dropped], dropped


def _list_frequent(model: mujoco.MjModel, pairs: Sequence[Pair], commanded: int, least: float) -> list[Pair]:
    """The pairs that touch in at least a share of the steps of simulations, most frequent first.

    Args:
      model, pairs: as in `choose_pairs`.
      commanded: the number of simulations with random commands, or 0 for one from each start without commands.
      least: the share.
    """
    if not pairs or (commanded and not model.nu):
        return []
    found = simulate(model, commanded)
    share = {pair: found.counts[frozenset((pair.geom1, pair.geom2))] / max(found.num_steps, 1) for pair in pairs}
    return sorted((pair for pair in pairs if share[pair] >= least), key=lambda pair: -share[pair])
