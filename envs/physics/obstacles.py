"""What keeps a model's step from being scalar equations, in the model's own words.

A short look at the model tells most of it, where tracing the step of a large one takes minutes before it ends at the
same thing.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import mujoco

# Shapes of two geoms whose contact MJX finds without looking up anything by an index that depends on the data.
SCALAR_CONTACTS = {("plane", shape) for shape in ("sphere", "capsule", "ellipsoid", "cylinder")}
SCALAR_CONTACTS |= {("sphere", "sphere"), ("sphere", "capsule"), ("capsule", "capsule")}


def obstacles(model: mujoco.MjModel) -> list[str]:
    """Features of a model whose forces have no scalar equations, with what to change, one phrase each.

    They are contacts between other shapes than in `SCALAR_CONTACTS`, and constraints that are solved in several
    iterations.
    """
    pairs = [] if _disabled(model, "CONSTRAINT") else list(colliding_geoms(model))
    return [*_contacts(model, pairs), *_iterations(model, pairs)]


def likely_obstacles(model: mujoco.MjModel) -> list[str]:
    """Features that are obstacles where something depends on them, as in `obstacles`.

    They are tendons that wrap around a geom, and contacts of which the nearest are chosen.
    """
    return [*_wrapped_tendons(model), *_chosen_contacts(model)]


def _contacts(model: mujoco.MjModel, pairs: list[tuple[int, int]]) -> Iterator[str]:
    others = [pair for pair in pairs if tuple(_shape(model, geom) for geom in pair) not in SCALAR_CONTACTS]
    if others:
        first, second = (f"{_geom(model, geom)} ({_shape(model, geom)})" for geom in others[0])
        more = f", and {len(others) - 1} more such pairs," if len(others) > 1 else ""
        yield (
            f"{first} and {second}{more} can collide: give them the shape of a sphere or capsule, or keep them apart "
            "by contype and conaffinity or <contact><exclude/></contact>"
        )


def _wrapped_tendons(model: mujoco.MjModel) -> Iterator[str]:
    import mujoco

    around = (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER)
    for i in range(model.ntendon):
        begin, number = model.tendon_adr[i], model.tendon_num[i]
        if np.isin(model.wrap_type[begin : begin + number], around).any():
            yield f"tendon {_name(model.tendon(i))} wraps around a geom: lead it over sites only"


def _chosen_contacts(model: mujoco.MjModel) -> Iterator[str]:
    for name in ("max_contact_points", "max_geom_pairs"):
        if any(model.numeric(i).name == name for i in range(model.nnumeric)):
            yield f"the custom number {name} chooses among contacts: leave it out"


def _iterations(model: mujoco.MjModel, pairs: list[tuple[int, int]]) -> Iterator[str]:
    constraints = ", ".join(_constraints(model, pairs))
    if constraints and model.opt.iterations > 1:
        yield (
            f"{model.opt.iterations} iterations of the solver, of which fewer are taken where that is enough, for "
            f'{constraints}: set <option iterations="1" ls_iterations="4"/>'
        )


def _constraints(model: mujoco.MjModel, pairs: list[tuple[int, int]]) -> Iterator[str]:
    """What needs the solver, one phrase for each kind."""
    if pairs:
        first, second = (_geom(model, geom) for geom in pairs[0])
        yield f"contacts (of {first} and {second}{_more(pairs)})"
    joints = np.flatnonzero(model.jnt_limited)
    tendons = np.flatnonzero(model.tendon_limited)
    if not _disabled(model, "CONSTRAINT", "LIMIT"):
        if joints.size:
            yield f"the range of joint {_name(model.joint(joints[0]))}{_more(joints)}"
        if tendons.size:
            yield f"the range of tendon {_name(model.tendon(tendons[0]))}{_more(tendons)}"
    lossy = model.dof_frictionloss.any() or model.tendon_frictionloss.any()
    if lossy and not _disabled(model, "CONSTRAINT", "FRICTIONLOSS"):
        yield "frictionloss"
    if model.neq and not _disabled(model, "CONSTRAINT", "EQUALITY"):
        yield "equality constraints"


def _disabled(model: mujoco.MjModel, *names: str) -> bool:
    import mujoco

    return any(model.opt.disableflags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}") for name in names)


def colliding_geoms(model: mujoco.MjModel) -> Iterator[tuple[int, int]]:
    """Pairs of geoms that may touch by MuJoCo's rules, each in the order of its shapes.

    A pair is in the list of the model's own, or its geoms match by contype and conaffinity and belong to bodies that
    move against one another and are neither excluded nor parent and child.
    """
    if _disabled(model, "CONTACT"):
        return
    own = {_in_order(model, *pair) for pair in zip(model.pair_geom1, model.pair_geom2, strict=True)}
    yield from sorted(own)
    for first, second in itertools.combinations(range(model.ngeom), 2):
        pair = _in_order(model, first, second)
        if (
            pair not in own
            and _match(model, first, second)
            and _bodies_meet(model, *model.geom_bodyid[[first, second]])
        ):
            yield pair


def _in_order(model: mujoco.MjModel, first: int, second: int) -> tuple[int, int]:
    first, second = sorted((int(first), int(second)), key=lambda geom: model.geom_type[geom])
    return first, second


def _match(model: mujoco.MjModel, first: int, second: int) -> bool:
    flat = ("plane", "hfield")
    if _shape(model, first) in flat and _shape(model, second) in flat:
        return False
    kinds, wanted = model.geom_contype, model.geom_conaffinity
    return bool(kinds[first] & wanted[second] or kinds[second] & wanted[first])


def _bodies_meet(model: mujoco.MjModel, first: int, second: int) -> bool:
    if (min(first, second) << 16) + max(first, second) in model.exclude_signature:
        return False
    one, other = model.body_weldid[[first, second]]
    if one == other:
        return False
    parents = model.body_weldid[model.body_parentid[[one, other]]]
    related = one and other and (parents[0] == other or parents[1] == one)
    return not related or _disabled(model, "FILTERPARENT")


def _shape(model: mujoco.MjModel, geom: int) -> str:
    import mujoco

    return mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()


def _geom(model: mujoco.MjModel, geom: int) -> str:
    name = model.geom(geom).name
    return f"geom '{name}'" if name else f"a geom of body {_name(model.body(model.geom_bodyid[geom]))}"


def _name(element) -> str:
    return f"'{element.name}'" if element.name else f"number {element.id}"


def _more(elements) -> str:
    return f" and {len(elements) - 1} more" if len(elements) > 1 else ""
