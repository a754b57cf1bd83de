"""Joint positions that put the end effector at a place: inverse kinematics by damped least squares.

With what is left of the way, e, the Jacobians J and J_r of the position and the rotation, and the angle that is left to
the rotation of the start times its axis, t, each step is

    g = D(J_r, t),       q <- clip(q + g + D(J, e - J g), low, high),       D(J, v) = J^T (J J^T + lambda^2 I)^-1 v

so that the place comes first, and the orientation is kept as far as the joints leave it free.

Source: Nakamura, Hanafusa and Yoshikawa, "Task-priority based redundancy control of robot manipulators" (IJRR 1987).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from envs.robots.arms import Arm
from envs.robots.twists import DAMPING

NUM_STEPS = 25
LONGEST = 0.1  # step of the place [m]
TURN = 0.5  # share of the turn that is left, in a step


class Placed(NamedTuple):
    """Where an arm ends up.

    Attributes:
      angles: positions of its joints `[n]` [rad or m].
      position: of the end effector `[3]` [m].
      rotation: of the body that carries it `[3, 3]`.
    """

    angles: np.ndarray
    position: np.ndarray
    rotation: np.ndarray


def put(arm: Arm, place: np.ndarray, start: np.ndarray) -> Placed:
    """The arm with its end effector as near as it gets to a place, oriented as far as possible as at the start.

    Args:
      arm: the arm; its joints stay within their ranges.
      place: `[3]` [m].
      start: positions of its joints `[n]` [rad or m].
    """
    import mujoco

    model, data = arm.model, mujoco.MjData(arm.model)
    places, dofs = arm.qpos_of, arm.dof_of
    site, (low, high) = model.site(arm.site).id, arm.ranges
    body = int(model.site_bodyid[site])
    jacobian, turning = np.empty((3, model.nv)), np.empty((3, model.nv))
    data.qpos[:], wanted, angles = arm.qpos, None, np.clip(start, low, high)
    for _ in range(NUM_STEPS):
        data.qpos[places] = angles
        mujoco.mj_fwdPosition(model, data)
        rotation = data.xmat[body].reshape(3, 3)
        wanted = rotation.copy() if wanted is None else wanted
        mujoco.mj_jacSite(model, data, jacobian, turning, site)
        left = place - data.site_xpos[site]
        left *= min(1.0, LONGEST / max(float(np.linalg.norm(left)), 1e-12))
        kept = _damp(turning[:, dofs], TURN * _find_turn(wanted, rotation))
        angles = np.clip(angles + kept + _damp(jacobian[:, dofs], left - jacobian[:, dofs] @ kept), low, high)
    data.qpos[places] = angles
    mujoco.mj_fwdPosition(model, data)
    return Placed(angles, data.site_xpos[site].copy(), data.xmat[body].reshape(3, 3).copy())


def _damp(jacobian: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """J^T (J J^T + lambda^2 I)^-1 v."""
    return jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + DAMPING**2 * np.eye(len(jacobian)), velocity)


def _find_turn(goal: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Half the sum of the cross products of the axes: the sine of the angle that is left, times its axis."""
    return np.cross(rotation, goal, axis=0).sum(1) / 2
