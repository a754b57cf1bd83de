"""Shapes, contacts between them, and the vectors that both are made of."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

TINY = 1e-15  # a vector shorter than this has no direction, as for MuJoCo
FAR = 1e10  # the distance of a contact that does not exist


class Shape(NamedTuple):
    """A geom in the world.

    Attributes:
      position: its centre [m], [3].
      rotation: its axes as columns, [3, 3].
      size: MuJoCo's `geom_size` [m], [3].
    """

    position: jax.Array
    rotation: jax.Array
    size: jax.Array


class Contacts(NamedTuple):
    """The contacts of two shapes, first and second.

    Attributes:
      distance: between the surfaces [m], negative where they overlap, [k].
      position: halfway between the surfaces [m], [k, 3].
      frame: rows are the normal from the first to the second shape and two tangents, [k, 3, 3].
    """

    distance: jax.Array
    position: jax.Array
    frame: jax.Array


def join_contacts(*contacts: Contacts) -> Contacts:
    """Contacts one after the other."""
    return Contacts(*(jnp.concatenate(parts) for parts in zip(*contacts, strict=True)))


def touch_ball(centre: jax.Array, radius: jax.Array, distance: jax.Array, normal: jax.Array) -> Contacts:
    """The contact of a ball, the first shape, whose surface is deepest along a known normal."""
    position = centre + normal * (radius + 0.5 * distance)
    return Contacts(distance[None], position[None], make_frame(normal)[None])


def make_frame(normal: jax.Array) -> jax.Array:
    """MuJoCo's contact frame of a unit normal n: y along e - (n e) n, z = n x y.

    Here e is the world's y axis, or its z axis if n is within 60 degrees of the y axis, so that y is never short.
    """
    x, y, z = normal
    steep = abs(y) >= 0.5
    along = jnp.where(steep, z, y)
    scale = 1 / jnp.sqrt(1 - along * along)
    axis = jnp.stack([jnp.zeros_like(x), jnp.where(steep, 0.0, 1.0), jnp.where(steep, 1.0, 0.0)])
    third = jnp.stack([jnp.where(steep, y, -z), jnp.where(steep, -x, 0.0), jnp.where(steep, 0.0, x)])
    return jnp.stack([normal, (axis - along * normal) * scale, third * scale])


def make_frame_along(normal: jax.Array, direction: jax.Array) -> jax.Array:
    """The contact frame of a unit normal whose first tangent is a direction's part across the normal."""
    across, length = normalize(direction - (direction @ normal) * normal)
    tangent = jnp.where(length < TINY, jnp.asarray([1.0, 0.0, 0.0], normal.dtype), across)
    return jnp.stack([normal, tangent, cross(normal, tangent)])


def normalize(vector: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(v / |v|, |v|), and (v, 0) where v is 0, with finite derivatives there."""
    length, divisor = measure(vector @ vector)
    return vector / divisor, length


def measure(square: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(sqrt(s), a number to divide by), which are (0, 1) where sqrt(s) < TINY, with finite derivatives there."""
    short = square < TINY**2
    length = jnp.sqrt(jnp.where(short, 1.0, square))
    return jnp.where(short, 0.0, length), length


def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """The vector product."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
