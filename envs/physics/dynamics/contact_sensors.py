"""Sensors of contacts: the force on a site's zone, and what touches what."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.dynamics.codes import OBJECT
from envs.physics.dynamics.numbers import SMALL
from envs.physics.dynamics.rays import MISS, find_distance, is_inside
from envs.physics.dynamics.reactions import Push
from envs.physics.dynamics.rotations import cross, length, rotate_back
from envs.physics.pairs import SHAPES

DATA = mujoco.mjtConDataField
# The values of one contact, in their order, with their sizes.
FIELDS = {"FOUND": 1, "FORCE": 3, "TORQUE": 3, "DIST": 1, "POS": 3, "NORMAL": 3, "TANGENT": 3}
NONE, NEAREST, STRONGEST, NET = range(4)  # how several contacts become the sensor's values


def read_touch(reader, sensor: int):
    """The sum of the normal forces on the site's body whose line, from the contact outwards, meets the site."""
    model, site = reader.model, int(reader.model.sensor_objid[sensor])
    body, total = int(model.site_bodyid[site]), jnp.zeros(())
    for push in reader.reactions.pushes if reader.reactions else []:
        if body in push.bodies:
            outwards = push.frame[0] * (-1.0 if body == push.bodies[1] else 1.0)
            meets = find_distance(*_describe_site(reader, site), push.position, outwards) < MISS
            total = total + jnp.where(meets, jnp.maximum(push.force[0], 0.0), 0.0)
    return total


def read_contact(reader, sensor: int):
    """The values of the contacts that match, in one slot or several, or of their sum."""
    model = reader.model
    fields, reduce = list_contact_fields(model, sensor), int(model.sensor_intprm[sensor, 1])
    matches = _list_matches(reader, sensor)
    number = sum((exists.astype(float) for _, exists, _ in matches), jnp.zeros(()))
    if fields == ["FOUND"]:
        return jnp.where(np.arange(model.sensor_dim[sensor] if reduce != NET else 1) < number, number, 0.0)
    values = (_add_up if reduce == NET else _choose)(matches, reduce)
    values["FOUND"] = number[None]
    return jnp.where(number > 0, jnp.concatenate([values[field] for field in fields]), 0.0)


def list_contact_fields(model: mujoco.MjModel, sensor: int) -> list[str]:
    """The values that a contact sensor has, in order."""
    wanted = int(model.sensor_intprm[sensor, 0])
    return [name for name in FIELDS if wanted >> int(getattr(DATA, f"mjCONDATA_{name}")) & 1]


def _describe_site(reader, site: int) -> tuple[str, Any, Any, Any]:
    """Shape, position, axes and size of a site."""
    size = reader.number("site_size")[site]
    return SHAPES[reader.model.site_type[site]], reader.d.site_xpos[site], reader.d.site_xmat[site], size


def _list_matches(reader, sensor: int) -> list[tuple[Push, Any, float]]:
    """The contacts that may match, whether they do, and the sign by which they are seen from the first object."""
    model = reader.model
    one = int(model.sensor_objtype[sensor]), int(model.sensor_objid[sensor])
    other = int(model.sensor_reftype[sensor]), int(model.sensor_refid[sensor])
    found = []
    for push in reader.reactions.pushes if reader.reactions else []:
        first, second = ([_matches(model, push, i, *which) for i in (0, 1)] for which in (one, other))
        if not any(first) or not any(second):
            continue
        exists = push.exists
        if one[0] == OBJECT.SITE:
            exists = exists & is_inside(*_describe_site(reader, one[1]), push.position)
        found.append((push, exists, _find_sign(first, second, one[0], other[0])))
    return found


def _matches(model, push: Push, side: int, kind: int, number: int) -> bool:
    """Whether one of a contact's two geoms belongs to an object."""
    if kind in (OBJECT.UNKNOWN, OBJECT.SITE):
        return True
    body = push.bodies[side]
    if kind == OBJECT.GEOM:
        return push.geoms[side] == number
    if kind == OBJECT.XBODY:
        while body > number:
            body = int(model.body_parentid[body])
    return body == number


def _find_sign(first: list[bool], second: list[bool], one: int, other: int) -> float:
    """1 if the normal points from the first object to the second, else -1."""
    if one == OBJECT.UNKNOWN and other == OBJECT.UNKNOWN:
        return 1.0
    if OBJECT.UNKNOWN not in (one, other):
        return 1.0 if first[0] and second[1] else -1.0
    return 1.0 if (first[0] if one != OBJECT.UNKNOWN else second[1]) else -1.0


def _choose(matches, reduce: int) -> dict:
    """The values of the contact that is nearest, or has the largest force."""
    best = jnp.full((), MISS)
    values = {name: jnp.zeros(size) for name, size in FIELDS.items()}
    for push, exists, sign in matches:
        force = (push.force**2).sum()
        criterion = jnp.where(exists, push.distance if reduce == NEAREST else -force, MISS)
        turn = np.array([1.0, 1.0, sign])
        own = {
            "FORCE": push.force * turn,
            "TORQUE": push.torque * turn,
            "DIST": push.distance[None],
            "POS": push.position,
            "NORMAL": push.frame[0] * sign,
            "TANGENT": push.frame[1] * sign,
        }
        is_better = criterion < best
        best = jnp.minimum(best, criterion)
        values |= {name: jnp.where(is_better, x, values[name]) for name, x in own.items()}
    return values


def _add_up(matches, _: int) -> dict:
    """The total force and its torque about the contacts' centre, weighted by their forces, in the world's axes."""
    weights = [jnp.where(exists, length(push.force), 0.0) for push, exists, _ in matches]
    total = sum(weights, jnp.zeros(()))
    center = sum((w * push.position for w, (push, _, _) in zip(weights, matches, strict=True)), jnp.zeros(3))
    center = center / jnp.maximum(total, SMALL)
    force = torque = jnp.zeros(3)
    for push, exists, sign in matches:
        own, spin = (jnp.where(exists, sign * rotate_back(push.frame, x), 0.0) for x in (push.force, push.torque))
        force, torque = force + own, torque + spin + cross(push.position - center, own)
    axes = np.eye(3)
    return {
        "FORCE": force,
        "TORQUE": torque,
        "DIST": jnp.zeros(1),
        "POS": center,
        "NORMAL": axes[0],
        "TANGENT": axes[1],
    }
