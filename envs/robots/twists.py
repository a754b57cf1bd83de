"""Joint velocities that move the end effector by a twist: damped least squares.

With the Jacobian J [6, n] of the end effector and its desired twist V = (velocity, angular velocity), both in the frame
of the world,

    q' = J^T (J J^T + lambda^2 I)^-1 V,                 the minimum of  |J q' - V|^2 + lambda^2 |q'|^2

which stays bounded where J loses rank: |q'| <= |V| / (2 lambda).

Source: Nakamura and Hanafusa, "Inverse kinematic solutions with singularity robustness for robot manipulator control"
(ASME JDSMC 1986); Wampler (IEEE SMC 1986).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from envs.physics.dynamics.linear_algebra import solve

DAMPING = 0.05  # lambda, in m for the velocity and, with rows of the rotation, in rad


def damped_least_squares(jacobian: jax.Array, twist: jax.Array, damping: float = DAMPING) -> jax.Array:
    """q' = J^T (J J^T + lambda^2 I)^-1 V, `[n]`.

    Args:
      jacobian: J `[m, n]`.
      twist: V `[m]`.
      damping: lambda, above 0.
    """
    square = jacobian @ jacobian.T + damping**2 * jnp.eye(jacobian.shape[0], dtype=jacobian.dtype)
    return jacobian.T @ solve(square, twist)


def limit_velocities(
    velocity: jax.Array, qpos: jax.Array, low: ArrayLike, high: ArrayLike, limit: ArrayLike, dt: float
) -> jax.Array:
    """The velocities, slowed down as a whole to their limits, and each stopped at the end of its range.

        v = q' min(1, min_i limit_i / |q'_i|),            then  v_i clipped to [(low_i - q_i) / dt, (high_i - q_i) / dt]

    A common factor keeps the direction of the twist. A joint beyond its range may only come back, at most at its limit.

    Args:
      velocity: q' `[n]`.
      qpos: joint positions `[n]`.
      low, high: their ranges `[n]`, which may be infinite.
      limit: largest speeds `[n]`.
      dt: seconds for which the velocities hold.
    """
    low, high, limit = map(jnp.asarray, (low, high, limit))
    slowed = velocity * jnp.minimum(1.0, jnp.min(limit / jnp.maximum(jnp.abs(velocity), 1e-12)))
    stopped = jnp.clip(slowed, (low - qpos) / dt, (high - qpos) / dt)
    return jnp.clip(stopped, -limit, limit)
