"""Pairs of geoms divided into those whose contacts are equations and those that are watched, within a size."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import NamedTuple

import mujoco

from envs.physics.dynamics.bounds import choose_bounds
from envs.physics.dynamics.choice import VARYING_SHAPES, choose_pairs, drop_rarest
from envs.physics.dynamics.watch import Bound
from envs.physics.interpreter import Program
from envs.physics.models import model_digest
from envs.physics.pairs import Pair, candidate_pairs
from envs.physics.primitives import UnsupportedPrimitiveError

LARGEST_PROGRAM = 30_000  # equations; more take minutes to compile, and are not faster than C MuJoCo


class Division(NamedTuple):
    """The pairs whose contacts are equations, those that are watched, and bounds of the latter."""

    chosen: list[Pair]
    watched: list[Pair]
    bounds: list[Bound]


NO_PAIRS = Division([], [], [])
_latest: dict[tuple, Division] = {}  # of the last model: all its programs need the same one


def divide_pairs(model: mujoco.MjModel, varying: Collection[str]) -> Division:
    """The candidate pairs as `choose_pairs` divides them; `varying` are fields of the model that may differ."""
    name = model_digest(model), *varying
    if name not in _latest:
        _latest.clear()
        _latest[name] = _watch(model, *choose_pairs(model, candidate_pairs(model, varying), varying))
    return _latest[name]


def _watch(model: mujoco.MjModel, chosen: list[Pair], watched: list[Pair]) -> Division:
    return Division(chosen, watched, choose_bounds(model, watched) if watched else [])


def make_within_size(
    model: mujoco.MjModel, varying: Collection[str], make: Callable[[Division], Program], has_contacts: bool = True
) -> Program:
    """The program with the contacts of `divide_pairs`; if it is too long, without those of the rarest pairs.

    They are then watched, if shapes do not vary.

    Args:
      model, varying: as for `divide_pairs`.
      make: makes the program.
      has_contacts: whether contacts have an influence on the results.

    Raises:
      UnsupportedPrimitiveError: it is too long even so.
    """
    division = divide_pairs(model, varying) if has_contacts else NO_PAIRS
    program = make(division)
    if len(program) <= LARGEST_PROGRAM:
        return program
    own = len(make(NO_PAIRS))
    while len(program) > LARGEST_PROGRAM > own and division.chosen and not set(varying) & set(VARYING_SHAPES):
        share = (len(program) - LARGEST_PROGRAM) / (len(program) - own)
        kept, dropped = drop_rarest(model, division.chosen, share)
        division = _watch(model, kept, [*division.watched, *dropped])
        program = make(division)
    if len(program) > LARGEST_PROGRAM:
        raise UnsupportedPrimitiveError(_describe_size(len(program), own, division))
    return program


def _describe_size(number: int, own: int, division: Division) -> str:
    """What so many equations are for, and what to leave out."""
    line = f"its {number:,} equations (more than {LARGEST_PROGRAM:,} take minutes to compile): "
    if number > own:
        line += f"{own:,} are its own and {number - own:,} those of contacts: "
    if own > LARGEST_PROGRAM:
        return f"{line}leave out bodies, joints, tendons and sensors that the task does not need"
    pairs = len(division.chosen) + len(division.watched)
    return (
        f"{line}<contact><exclude body1= body2=/></contact> or contype and conaffinity leave out those of the {pairs} "
        "pairs of geoms that the task does not need"
    )
