"""Finds features of a model that prevent scalar equations of its step, and names them as in the MJCF.

Most of them show in the model itself, whereas tracing the step of a large model takes minutes until it fails.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import mujoco

# Pairs of shapes whose contacts MJX finds without an index that depends on the data.
SCALAR_CONTACTS = {("plane", shape) for shape in ("sphere", "capsule", "ellipsoid", "cylinder")}
SCALAR_CONTACTS |= {("sphere", "sphere"), ("sphere", "capsule"), ("capsule", "capsule")}


def find_obstacles(model: mujoco.MjModel) -> list[str]:
    """Features of a model without scalar equations, and what to change, one phrase each.

    These are contacts between shapes that are not in `SCALAR_CONTACTS`, and constraints solved in several iterations.
    """
    pairs = [] if _is_disabled(model, "CONSTRAINT") else list(find_colliding_geoms(model))
    return [*_find_contacts(model, pairs), *_find_iterations(model, pairs)]


def find_likely_obstacles(model: mujoco.MjModel) -> list[str]:
    """Features that are obstacles if an output depends on them, as in `find_obstacles`.

    These are tendons that wrap around a geom, and limits on the number of contacts.
    """
    return [*_find_wrapped_tendons(model), *_find_contact_limits(model)]


def _find_contacts(model: mujoco.MjModel, pairs: list[tuple[int, int]]) -> Iterator[str]:
    others = [pair for pair in pairs if tuple(_get_shape(model, geom) for geom in pair) not in SCALAR_CONTACTS]
    if others:
        first, second = (f"{_describe_geom(model, geom)} ({_get_shape(model, geom)})" for geom in others[0])
        more = f", and {len(others) - 1} more such pairs," if len(others) > 1 else ""
        yield (
            f"{first} and {second}{more} can collide: make them spheres or capsules, or disable their contact "
            "by contype and conaffinity or <contact><exclude/></contact>"
        )


def _find_wrapped_tendons(model: mujoco.MjModel) -> Iterator[str]:
    import mujoco

    around = (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER)
    for i in range(model.ntendon):
        begin, number = model.tendon_adr[i], model.tendon_num[i]
        if np.isin(model.wrap_type[begin : begin + number], around).any():
            yield f"tendon {_format_name(model.tendon(i))} wraps around a geom: route it through sites only"


def _find_contact_limits(model: mujoco.MjModel) -> Iterator[str]:
    for name in ("max_contact_points", "max_geom_pairs"):
        if any(model.numeric(i).name == name for i in range(model.nnumeric)):
            yield f"the custom number {name} selects among contacts: remove it"


def _find_iterations(model: mujoco.MjModel, pairs: list[tuple[int, int]]) -> Iterator[str]:
    constraints = ", ".join(_describe_constraints(model, pairs))
    if constraints and model.opt.iterations > 1:
        yield (
            f"{model.opt.iterations} iterations of the solver, which may stop early, for "
            f'{constraints}: set <option iterations="1" ls_iterations="4"/>'
        )


def _describe_constraints(model: mujoco.MjModel, pairs: list[tuple[int, int]]) -> Iterator[str]:
    """The kinds of constraints that need the solver, one phrase each."""
    if pairs:
        first, second = (_describe_geom(model, geom) for geom in pairs[0])
        yield f"contacts (of {first} and {second}{_count_others(pairs)})"
    joints = np.flatnonzero(model.jnt_limited)
    tendons = np.flatnonzero(model.tendon_limited)
    if not _is_disabled(model, "CONSTRAINT", "LIMIT"):
        if joints.size:
            yield f"the range of joint {_format_name(model.joint(joints[0]))}{_count_others(joints)}"
        if tendons.size:
            yield f"the range of tendon {_format_name(model.tendon(tendons[0]))}{_count_others(tendons)}"
    lossy = model.dof_frictionloss.any() or model.tendon_frictionloss.any()
    if lossy and not _is_disabled(model, "CONSTRAINT", "FRICTIONLOSS"):
        yield "frictionloss"
    if model.neq and not _is_disabled(model, "CONSTRAINT", "EQUALITY"):
        yield "equality constraints"


def _is_disabled(model: mujoco.MjModel, *names: str) -> bool:
    import mujoco

    return any(model.opt.disableflags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}") for name in names)


def find_colliding_geoms(model: mujoco.MjModel) -> Iterator[tuple[int, int]]:
    """Pairs of geoms that may touch by MuJoCo's rules, each ordered by shape.

    Either the model lists the pair, or the geoms match by contype and conaffinity, and their bodies move relative to
    each other and are neither excluded nor parent and child.
    """
    if _is_disabled(model, "CONTACT"):
        return
    listed = {_sort_pair(model, *pair) for pair in zip(model.pair_geom1, model.pair_geom2, strict=True)}
    yield from sorted(listed)
    for first, second in itertools.combinations(range(model.ngeom), 2):
        pair = _sort_pair(model, first, second)
        if (
            pair not in listed
            and _geoms_match(model, first, second)
            and _bodies_meet(model, *model.geom_bodyid[[first, second]])
        ):
            yield pair


def _sort_pair(model: mujoco.MjModel, first: int, second: int) -> tuple[int, int]:
    first, second = sorted((int(first), int(second)), key=lambda geom: model.geom_type[geom])
    return first, second


def _geoms_match(model: mujoco.MjModel, first: int, second: int) -> bool:
    flat = ("plane", "hfield")
    if _get_shape(model, first) in flat and _get_shape(model, second) in flat:
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
    return not related or _is_disabled(model, "FILTERPARENT")


def _get_shape(model: mujoco.MjModel, geom: int) -> str:
    import mujoco

    return mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()


def _describe_geom(model: mujoco.MjModel, geom: int) -> str:
    name = model.geom(geom).name
    return f"geom '{name}'" if name else f"a geom of body {_format_name(model.body(model.geom_bodyid[geom]))}"


def _format_name(element) -> str:
    return f"'{element.name}'" if element.name else f"number {element.id}"


def _count_others(elements) -> str:
    return f" and {len(elements) - 1} more" if len(elements) > 1 else ""
