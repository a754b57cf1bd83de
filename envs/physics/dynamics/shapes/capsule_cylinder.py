"""Contact of a capsule with a cylinder."""

from __future__ import annotations

import jax.numpy as jnp

from envs.physics.dynamics.shapes.geometry import TINY, Contacts, Shape
from envs.physics.dynamics.shapes.spheres import touch_sphere_cylinder

ROUNDS = 5
PARALLEL = 1e-12  # squared sine or cosine of the angle between the axes


def touch_capsule_cylinder(capsule: Shape, cylinder: Shape, margin) -> Contacts:
    """One contact, of the ball about the point of the capsule's axis that is next to the cylinder.

    With p(x) on the axis, of height z and distance s from the cylinder's axis, (|z| - h)^2 + (s - r)^2 is least between
    the place where s is least and the nearest place where |z| <= h; there Newton's method for it stays. MuJoCo has
    two contacts where the capsule lies along the cylinder's end, within some 5 degrees, unless the model's flag
    multiccd is off. Where the capsule's axis pierces the cylinder, MuJoCo's normal may be another.
    """
    middle = (capsule.position - cylinder.position) @ cylinder.rotation
    step = capsule.size[1] * (capsule.rotation[:, 2] @ cylinder.rotation)
    radius, half_length = cylinder.size[:2]
    square, across, along = middle[:2] @ middle[:2], middle[:2] @ step[:2], step[:2] @ step[:2]
    steep, level = along < PARALLEL * capsule.size[1] ** 2, step[2] ** 2 < PARALLEL * capsule.size[1] ** 2
    nearest = jnp.clip(jnp.where(steep, 0.0, -across / jnp.where(steep, 1.0, along)), -1, 1)
    rise = middle[2] + nearest * step[2]
    to_side = (jnp.clip(rise, -half_length, half_length) - rise) / jnp.where(level, 1.0, step[2])
    beside = jnp.clip(nearest + jnp.where(level, 0.0, to_side), -1, 1)
    side = jnp.where(rise > 0, 1.0, -1.0)
    line = square, across, along, side * middle[2] - half_length, side * step[2]
    x = _approach(line, radius, jnp.minimum(nearest, beside), jnp.maximum(nearest, beside))
    ball = capsule._replace(position=capsule.position + (x * capsule.size[1]) * capsule.rotation[:, 2])
    return touch_sphere_cylinder(ball, cylinder, margin)


def _approach(line, radius, low, high):
    """The place between two others where a line is next to the edge of a cylinder's end.

    Its distance from the axis is sqrt(square + 2 x across + x^2 along), its height above the end start + x slope.
    """
    square, across, along, start, slope = line
    x = 0.5 * (low + high)
    for _ in range(ROUNDS):
        span = jnp.sqrt(jnp.maximum(square + x * (2 * across + x * along), TINY))
        change = (across + x * along) / span
        beyond_end, beyond_side = jnp.maximum(start + x * slope, 0.0), jnp.maximum(span - radius, 0.0)
        first = beyond_end * slope + beyond_side * change
        second = slope * slope + jnp.where(beyond_side > 0, along - (along - change * change) * radius / span, 0.0)
        x = jnp.clip(x - first / jnp.maximum(second, TINY), low, high)
    return x
