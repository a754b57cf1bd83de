"""Limits of joints and tendons, and dry friction in them, as constraints."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.dynamics.codes import DISABLED
from envs.physics.dynamics.forces import is_disabled
from envs.physics.dynamics.numbers import get_number, is_traced
from envs.physics.dynamics.rows import Raw
from envs.physics.dynamics.smooth import Smooth

if TYPE_CHECKING:
    from mujoco import mjx


def find_friction_loss(model: mujoco.MjModel, mx: mjx.Model, smooth: Smooth) -> dict[str, Raw]:
    """Dry friction of joints and tendons: any motion is braked, with at most a given force."""
    losses = [get_number(model, mx, f"{kind}_frictionloss") for kind in ("dof", "tendon")]
    dofs, tendons = (np.arange(len(x)) if is_traced(x) else np.flatnonzero(x) for x in losses)
    if is_disabled(model, DISABLED.FRICTIONLOSS) or not dofs.size + tendons.size:
        return {}

    def gather(of_dofs, of_tendons):
        return jnp.concatenate([of_dofs[dofs], of_tendons[tendons]])

    def get(name, tendon_name):
        return gather(get_number(model, mx, name), get_number(model, mx, tendon_name))

    loss = gather(*losses)
    zero = jnp.zeros_like(loss)
    part = Raw(
        jacobian=gather(jnp.eye(model.nv), smooth.tendon_jacobian),
        position=zero,
        impedance_position=zero,
        active=np.ones(loss.size, bool),
        weight=get("dof_invweight0", "tendon_invweight0"),
        solref=get("dof_solref", "tendon_solref_fri"),
        solimp=get("dof_solimp", "tendon_solimp_fri"),
        low=-loss,
        high=loss,
        bias=zero,
    )
    return {"friction loss": part}


def find_limits(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, smooth: Smooth) -> dict[str, Raw]:
    """The rows of all limits; arguments as of `constraints.make_rows`."""
    if is_disabled(model, DISABLED.LIMIT):
        return {}
    makers = {"joint limit": _make_joint_limits, "ball limit": _make_ball_limits, "tendon limit": _make_tendon_limits}
    parts = {kind: make(model, mx, d, smooth) for kind, make in makers.items()}
    return {kind: part for kind, part in parts.items() if part is not None}


def _make_joint_limits(model, mx, d, smooth) -> Raw | None:
    """Hinges and slides stay within their ranges."""
    is_scalar = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
    joints = np.flatnonzero(is_scalar & (model.jnt_limited > 0))
    if not joints.size:
        return None
    dofs = model.jnt_dofadr[joints]
    return _make_limit_rows(
        position=d.qpos[model.jnt_qposadr[joints]],
        jacobian=jnp.eye(model.nv)[dofs],
        limits=get_number(model, mx, "jnt_range")[joints],
        margin=get_number(model, mx, "jnt_margin")[joints],
        weight=get_number(model, mx, "dof_invweight0")[dofs],
        solref=get_number(model, mx, "jnt_solref")[joints],
        solimp=get_number(model, mx, "jnt_solimp")[joints],
    )


def _make_tendon_limits(model, mx, d, smooth) -> Raw | None:
    """Tendons stay within their range of lengths."""
    tendons = np.flatnonzero(model.tendon_limited)
    if not tendons.size:
        return None
    return _make_limit_rows(
        position=d.ten_length[tendons],
        jacobian=smooth.tendon_jacobian[tendons],
        limits=get_number(model, mx, "tendon_range")[tendons],
        margin=get_number(model, mx, "tendon_margin")[tendons],
        weight=get_number(model, mx, "tendon_invweight0")[tendons],
        solref=get_number(model, mx, "tendon_solref_lim")[tendons],
        solimp=get_number(model, mx, "tendon_solimp_lim")[tendons],
    )


def _make_limit_rows(position, jacobian, limits, margin, weight, solref, solimp) -> Raw:
    """Rows of `low <= position <= high`; the Jacobian is that of the distance to the limit.

    Of the two ends only the nearer one acts, but for ranges so narrow that their margins overlap.
    """
    above, below = position - limits[:, 0], limits[:, 1] - position
    is_lower = above < below
    nearer, farther = jnp.minimum(above, below), jnp.maximum(above, below)
    if is_traced(limits, margin):
        both = np.arange(len(position))
    else:
        both = np.flatnonzero(limits[:, 1] - limits[:, 0] < 2 * margin)
    rows = np.concatenate([np.arange(len(position)), both])
    sign = jnp.concatenate([jnp.where(is_lower, 1.0, -1.0), jnp.where(is_lower, -1.0, 1.0)[both]])
    distance = jnp.concatenate([nearer, farther[both]])
    return _make_one_sided_rows(
        sign[:, None] * jacobian[rows], distance, margin[rows], weight[rows], solref[rows], solimp[rows]
    )


def _make_ball_limits(model, mx, d, smooth) -> Raw | None:
    """Ball joints turn by at most a given angle about any axis."""
    joints = np.flatnonzero((model.jnt_type == mujoco.mjtJoint.mjJNT_BALL) & (model.jnt_limited > 0))
    if not joints.size:
        return None
    quaternions = d.qpos[model.jnt_qposadr[joints][:, None] + np.arange(4)]
    axis, angle = jax.vmap(_split_rotation)(quaternions)
    jacobian = jnp.zeros((len(joints), model.nv))
    jacobian = jacobian.at[np.arange(len(joints))[:, None], model.jnt_dofadr[joints][:, None] + np.arange(3)].set(-axis)
    distance = jnp.max(get_number(model, mx, "jnt_range")[joints], axis=1) - angle
    weight = get_number(model, mx, "dof_invweight0")[model.jnt_dofadr[joints]]
    parameters = get_number(model, mx, "jnt_solref")[joints], get_number(model, mx, "jnt_solimp")[joints]
    return _make_one_sided_rows(jacobian, distance, get_number(model, mx, "jnt_margin")[joints], weight, *parameters)


def _split_rotation(q: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(axis, angle in [0, pi]) of the rotation of a quaternion; the axis of no rotation is 0."""
    squared = jnp.sum(q[1:] ** 2)
    is_turned = squared > mujoco.mjMINVAL**2
    sine = jnp.sqrt(jnp.where(is_turned, squared, 1.0))
    half = jnp.arctan2(sine, jnp.abs(q[0]))
    sign = jnp.where(q[0] < 0, -1.0, 1.0)
    axis = jnp.where(is_turned, sign * q[1:] / sine, 0.0)
    return axis, jnp.where(is_turned, 2 * half, 0.0)


def _make_one_sided_rows(jacobian, distance, margin, weight, solref, solimp) -> Raw:
    """Rows that push a distance out of its margin."""
    position = distance - margin
    return Raw(
        jacobian=jacobian,
        position=position,
        impedance_position=position,
        active=position < 0,
        weight=weight,
        solref=solref,
        solimp=solimp,
        low=np.full(position.size, -np.inf),
        high=np.zeros(position.size),
        bias=jnp.zeros_like(position),
    )
