"""Contacts of a sphere, the first shape, with another shape that is not a plane."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from envs.physics.dynamics.shapes.geometry import TINY, Contacts, Shape, measure, touch_ball


def touch_sphere_sphere(one: Shape, other: Shape, margin: jax.Array) -> Contacts:
    """One contact: d = |c' - c| - r - r'. Between spheres of the same centre the normal is the world's x axis."""
    return touch_balls(one.position, one.size[0], other.position, other.size[0])


def touch_sphere_capsule(sphere: Shape, capsule: Shape, margin: jax.Array) -> Contacts:
    """One contact, with the ball about the point of the capsule's axis that is next to the sphere."""
    (radius, half_length), axis = capsule.size[:2], capsule.rotation[:, 2]
    place = jnp.clip((sphere.position - capsule.position) @ axis, -half_length, half_length)
    return touch_balls(sphere.position, sphere.size[0], capsule.position + place * axis, radius)


def touch_balls(centre, radius, other_centre, other_radius, fallback=(1.0, 0.0, 0.0)) -> Contacts:
    """The contact of two balls; the fallback is the normal if they have the same centre."""
    offset = other_centre - centre
    length, divisor = measure(offset @ offset)
    normal = jnp.where(length < TINY, jnp.asarray(fallback, offset.dtype), offset / divisor)
    return touch_ball(centre, radius, length - (radius + other_radius), normal)


def touch_sphere_cylinder(sphere: Shape, cylinder: Shape, margin: jax.Array) -> Contacts:
    """One contact, with the cylinder's side, end or edge, whichever is next to the sphere's centre.

    With x the centre's height and s its distance from the axis, a = |x| - h and b = s - r are how far it is beyond the
    end and the side; the distance is |max((a, b), 0)| outside and max(a, b) inside.
    """
    radius, half_length = cylinder.size[:2]
    axis = cylinder.rotation[:, 2]
    offset = sphere.position - cylinder.position
    height = offset @ axis
    radial = offset - height * axis
    span, divisor = measure(radial @ radial)
    beyond_end, beyond_side = abs(height) - half_length, span - radius
    outside = (beyond_end >= 0) & (beyond_side >= 0)
    edge, edge_divisor = measure(beyond_end * beyond_end + beyond_side * beyond_side)
    at_end = beyond_end > beyond_side
    end = jnp.where(outside, beyond_end / edge_divisor, jnp.where(at_end, 1.0, 0.0))
    side = jnp.where(outside, beyond_side / edge_divisor, jnp.where(at_end, 0.0, 1.0))
    distance = jnp.where(outside, edge, jnp.maximum(beyond_end, beyond_side))
    out = jnp.where(span < TINY, -cylinder.rotation[:, 0], radial / divisor)
    normal = -(jnp.where(height > 0, end, -end) * axis + side * out)
    return touch_ball(sphere.position, sphere.size[0], distance - sphere.size[0], normal)


def touch_sphere_box(sphere: Shape, box: Shape, margin: jax.Array) -> Contacts:
    """One contact, with the box's point next to the sphere's centre, or with its next face if the centre is inside."""
    centre = (sphere.position - box.position) @ box.rotation
    depth, normal = find_face(centre, box.size)
    return touch_ball(sphere.position, sphere.size[0], depth - sphere.size[0], box.rotation @ normal)


def find_face(point: jax.Array, size: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The distance of a point from a box's surface, negative inside, and the direction from the point to it.

    Of faces equally near the first counts, in the order -x, x, -y, y, -z, z.
    """
    inward = jnp.clip(point, -size, size) - point
    length, divisor = measure(inward @ inward)
    gap = size - abs(point)
    x, y, z = gap
    first = (x <= y) & (x <= z)
    second = ~first & (y <= z)
    nearest = jnp.stack([first, second, ~first & ~second])
    face = jnp.where(nearest, jnp.where(point > 0, -1.0, 1.0), 0.0)
    inside = length < TINY
    return jnp.where(inside, -jnp.minimum(jnp.minimum(x, y), z), length), jnp.where(inside, face, inward / divisor)
