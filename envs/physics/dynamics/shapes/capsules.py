"""Contacts between capsules."""

from __future__ import annotations

import jax.numpy as jnp

from envs.physics.dynamics.shapes.geometry import FAR, Contacts, Shape, cross, join_contacts, measure
from envs.physics.dynamics.shapes.spheres import touch_balls

PARALLEL = 1e-8  # below this squared sine of the angle between them axes are parallel, as for MuJoCo 3.17


def touch_capsule_capsule(one: Shape, other: Shape, margin) -> Contacts:
    """One contact, where the axes are closest, or two, at the ends of the stretch along which parallel axes face.

    With p = c + x h a and p' = c' + y h' a' on the axes,
    |p - p'|^2 = |c - c'|^2 + A x^2 + 2 B x y + D y^2 - 2 U x - 2 V y, and A D - B^2 = |h a x h' a'|^2, which unlike
    the difference is exact for nearly parallel axes. If the stretch has no length its contact counts twice.
    """
    axis, other_axis = one.rotation[:, 2] * one.size[1], other.rotation[:, 2] * other.size[1]
    offset = one.position - other.position
    A, B, D = one.size[1] ** 2, -(axis @ other_axis), other.size[1] ** 2
    U, V = -(axis @ offset), other_axis @ offset
    perpendicular = cross(axis, other_axis)
    determinant = perpendicular @ perpendicular
    parallel = determinant < PARALLEL * (A * D)
    fallback = jnp.where(parallel, jnp.asarray([1.0, 0.0, 0.0], axis.dtype), perpendicular / measure(determinant)[1])

    def touch_at(x, y):
        return touch_balls(
            one.position + x * axis, one.size[0], other.position + y * other_axis, other.size[0], fallback
        )

    x = jnp.clip((D * U - B * V) / jnp.where(parallel, 1.0, determinant), -1, 1)
    y = jnp.clip((V - B * x) / D, -1, 1)
    closest = jnp.clip((U - B * y) / A, -1, 1), y
    low, high = (_match_end(end, A, B, D, U, V) for end in (jnp.where(B > 0, 1.0, -1.0), jnp.where(B > 0, -1.0, 1.0)))
    contact = touch_at(*(jnp.where(parallel, end, inner) for end, inner in zip(low, closest, strict=True)))
    second = touch_at(*high)
    return join_contacts(contact, second._replace(distance=jnp.where(parallel, second.distance, FAR)))


def _match_end(y, A, B, D, U, V):
    """Where the second axis ends beside the first, (x, y); if that is beyond it, its end and what is beside that."""
    place = (U - B * y) / A
    x = jnp.clip(place, -1, 1)
    return x, jnp.where(place == x, y, jnp.clip((V - B * x) / D, -1, 1))
