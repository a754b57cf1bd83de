"""A textbook controller that reaches a goal: resolved motion rate control.

The end effector moves straight towards its goal, with a twist in proportion to what is left, and damped least squares
find the joint velocities (`envs.robots.twists`):

    V = GAIN (x_g - x, theta axis),        q'* = J^T (J J^T + lambda^2 I)^-1 V,        within the limits of the joints

A position is commanded as the velocity's step, a twist as J q'*, and a torque as what inverse dynamics say for the
acceleration (q'* - q') / RESPONSE, which is computed-torque control. It knows the model. It does not plan: a joint at
its limit may keep it from a goal.

Source: Whitney, "Resolved motion rate control of manipulators and human prostheses" (1969); Siciliano et al.,
"Robotics: Modelling, Planning and Control" (2009), sections 3.7 and 8.5.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from envs.physics import compile_forward, compile_inverse, scalarize
from envs.robots.arms import Arm
from envs.robots.controls import APPROACH, Control
from envs.robots.twists import damped_least_squares, limit_velocities

GAIN = 5.0  # twist for what is left of the way [1/s]
RESPONSE = 0.05  # in which the velocity is to be reached, where torques are commanded [s]

Controller = Callable[[jax.Array, jax.Array, jax.Array, jax.Array | None], jax.Array]


def make_resolved_rate(control: Control, speeds: np.ndarray, kind: str, dt: float) -> Controller:
    """The controller of an arm under one kind of control.

    Args:
      control: how actions command the arm.
      speeds: largest speeds of the joints [n].
      kind: of `envs.robots.CONTROLS`.
      dt: seconds between two commands.

    Returns:
      `act(qpos [nq], qvel [nv], position [3], turn [3] or None) -> action [m]` in [-1, 1], for the way that is left:
      position x_g - x [m] and turn theta axis [rad].
    """
    find_velocity = _make_velocity(control.arm, speeds, dt)
    limits = jnp.asarray(control.limits)
    find_torque = _make_torque(control.arm) if kind == "torque" else None

    def act(qpos, qvel, position, turn):
        twist = GAIN * jnp.concatenate([position, jnp.zeros(3) if turn is None else turn])
        velocity, jacobian = find_velocity(qpos, twist, turn is not None)
        if kind == "twist":
            twist = jacobian @ velocity / limits
            return twist / jnp.maximum(1.0, jnp.max(jnp.abs(twist)))
        if find_torque is not None:
            return jnp.clip(find_torque(qpos, qvel, velocity) / limits, -1.0, 1.0)
        command = velocity / APPROACH if kind == "position" else velocity
        return jnp.clip(command / limits, -1.0, 1.0)

    return act


def _make_velocity(arm: Arm, speeds: np.ndarray, dt: float) -> Callable[..., tuple[jax.Array, jax.Array]]:
    """(q'* [n], J [6, n]) for a twist `[6]`, of which the rotation is left free where it does not count."""
    places, dofs = arm.qpos_of, arm.dof_of
    low, high = arm.ranges
    jacobians = compile_forward(arm.model, outputs=(f"site_jacp[{arm.site}]", f"site_jacr[{arm.site}]"))

    def solve(jacobian, twist, qpos):
        return limit_velocities(damped_least_squares(jacobian, twist), qpos[places], low, high, speeds, dt)

    number = len(dofs)
    linear, whole = (scalarize(solve, *map(jnp.zeros, ((m, number), m, arm.model.nq))) for m in (3, 6))

    def find(qpos, twist, turns):
        jacobian = jnp.concatenate(jacobians(qpos))[:, dofs]
        velocity = whole(jacobian, twist, qpos) if turns else linear(jacobian[:3], twist[:3], qpos)
        return velocity, jacobian

    return find


def _make_torque(arm: Arm) -> Callable[[jax.Array, jax.Array, jax.Array], jax.Array]:
    """Tau of the arm's joints [n] for wanted velocities [n]: M(q) (q'* - q') / RESPONSE + c(q, q') - passive forces."""
    dofs = arm.dof_of
    inverse = compile_inverse(arm.model)

    def find(qpos, qvel, velocity):
        qacc = jnp.zeros_like(qvel).at[dofs].set((velocity - qvel[dofs]) / RESPONSE)
        return inverse(qpos, qvel, qacc)[0][dofs]

    return find
