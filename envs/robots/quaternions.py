"""Rotations of a base by unit quaternions (w, x, y, z).

Written out, as XLA is slow at many small products of arrays outside of scalar equations.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def to_matrix(quaternion: jax.Array) -> jax.Array:
    """The rotation matrix `[3, 3]` of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )


def find_down(quaternion: jax.Array) -> jax.Array:
    """R^T (0, 0, -1) of a unit quaternion (w, x, y, z): the direction of gravity in the base's frame `[3]`."""
    w, x, y, z = quaternion
    return -jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x**2 + y**2)])


def rotate_back(quaternion: jax.Array, vector: jax.Array) -> jax.Array:
    """R^T v of a unit quaternion (w, x, y, z) and a vector `[3]`: v + 2 w (v x u) + 2 (v x u) x u, u = (x, y, z)."""
    axis = quaternion[1:]
    cross = jnp.cross(vector, axis)
    return vector + 2 * (quaternion[0] * cross + jnp.cross(cross, axis))


def turn_about_z(angle: jax.Array, quaternion: jax.Array) -> jax.Array:
    """The quaternion of a rotation that is followed by a turn about the world's z axis."""
    cos, sin = jnp.cos(angle / 2), jnp.sin(angle / 2)
    w, x, y, z = quaternion
    return jnp.stack([cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w])
