"""Forces of springs, dampers, fluids and gravity compensation, and their derivatives with respect to velocities."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.dynamics.codes import DISABLED, TRANSMISSION
from envs.physics.dynamics.kinematics import find_body_velocities, find_jacobians
from envs.physics.dynamics.numbers import SMALL, get_number, is_traced, is_zero, module_of
from envs.physics.dynamics.rotations import contract, cross_each, length, normalize, rotate_each, subtract
from envs.physics.dynamics.smooth import Smooth
from envs.physics.dynamics.tree import BALL, FREE

if TYPE_CHECKING:
    from mujoco import mjx

JOINT_TRANSMISSIONS = (TRANSMISSION.JOINT, TRANSMISSION.JOINTINPARENT)


def is_disabled(model: mujoco.MjModel, *flags: int) -> bool:
    """Whether the model's options disable all of these."""
    return all(model.opt.disableflags & flag for flag in flags)


def find_passive_forces(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, smooth: Smooth):
    """Forces of springs, dampers and fluids, and of gravity compensation, (others [nv], gravcomp [nv]).

    With springs and dampers disabled C MuJoCo has no passive forces at all.
    """
    zero = np.zeros(model.nv)
    if is_disabled(model, DISABLED.SPRING, DISABLED.DAMPER):
        return zero, zero
    force = zero if is_disabled(model, DISABLED.SPRING) else _find_springs(model, mx, d)
    force = force if is_disabled(model, DISABLED.DAMPER) else force + _find_dampers(model, mx, d)
    if model.ntendon:
        force = force + contract(find_tendon_forces(model, mx, d, smooth), smooth.tendon_jacobian)
    if has_fluid(model, mx):
        force = force + find_fluid_forces(model, mx, d, smooth)
    return force, find_gravity_compensation(model, mx, d)


# --- springs and dampers ----------------------------------------------------------------------------------------------


def evaluate_coefficient(linear, higher, x, derivative: bool = False):
    """k(x) = k_0 + sum_i k_i x^i, of a force -x k(x), or the derivative of x k(x), k_0 + sum_i (i + 1) k_i x^i.

    Args:
      linear: k_0 [n].
      higher: k_1, k_2, ... [n, number].
      x: [n].
      derivative: whether the derivative is meant.

    Returns:
      [n].
    """
    power = 1.0
    for i in range(higher.shape[-1]):
        if is_zero(higher[:, i:]):
            break
        power = power * x
        linear = linear + (i + 2 if derivative else 1) * higher[:, i] * power
    return linear


def _find_springs(model, mx, d: mjx.Data):
    """Forces of the joints' springs [nv]."""
    stiffness, higher = get_number(model, mx, "jnt_stiffness"), get_number(model, mx, "jnt_stiffnesspoly")
    rest = get_number(model, mx, "qpos_spring")
    force = np.zeros(model.nv)
    scalar = ~np.isin(model.jnt_type, (FREE, BALL))
    stiff = np.ones(model.njnt, bool) if is_traced(stiffness, higher) else (stiffness != 0) | higher.any(-1)
    (joints,) = np.nonzero(scalar & stiff)
    if joints.size:
        q = model.jnt_qposadr[joints]
        x = d.qpos[q] - rest[q]
        values = -x * evaluate_coefficient(stiffness[joints], higher[joints], x)
        force = force + _spread(values, model.jnt_dofadr[joints], model.nv)
    for joint in np.nonzero(~scalar & stiff)[0]:
        dof, q = model.jnt_dofadr[joint], model.jnt_qposadr[joint]
        coefficient = stiffness[joint : joint + 1], higher[joint : joint + 1]
        if model.jnt_type[joint] == FREE:
            pull = _pull_back(*coefficient, d.qpos[q : q + 3] - rest[q : q + 3])
            force = force + _spread(pull, dof + np.arange(3), model.nv)
            dof, q = dof + 3, q + 3
        pull = _pull_back(*coefficient, subtract(normalize(d.qpos[q : q + 4]), rest[q : q + 4]))
        force = force + _spread(pull, dof + np.arange(3), model.nv)
    return force


def _spread(values, places: np.ndarray, size: int):
    """A vector [size] with these values at these places."""
    return contract(values, np.eye(size)[places])


def _pull_back(stiffness, higher, shift):
    """-k(|x|) x."""
    return -shift * evaluate_coefficient(stiffness, higher, 0.0 if is_zero(higher) else length(shift)[None])


def find_tendon_forces(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, smooth: Smooth):
    """Forces of the tendons' springs, which have a dead band, and dampers, by which they would get longer [ntendon]."""
    force = np.zeros(model.ntendon)
    stiffness, higher = get_number(model, mx, "tendon_stiffness"), get_number(model, mx, "tendon_stiffnesspoly")
    if not is_disabled(model, DISABLED.SPRING) and not (is_zero(stiffness) and is_zero(higher)):
        low, high = get_number(model, mx, "tendon_lengthspring").T
        x = jnp.maximum(d.ten_length - high, 0.0) + jnp.minimum(d.ten_length - low, 0.0)
        force = force - x * evaluate_coefficient(stiffness, higher, x)
    damping, higher = find_tendon_damping(model, mx)
    if not is_disabled(model, DISABLED.DAMPER) and not (is_zero(damping) and is_zero(higher)):
        v = smooth.tendon_velocity
        force = force - v * evaluate_coefficient(damping, higher, jnp.abs(v))
    return force


def find_joint_damping(model: mujoco.MjModel, mx: mjx.Model) -> tuple[Any, Any]:
    """Damping of the velocities, with that of actuators at their joints: (linear [nv], higher [nv, number])."""
    return _find_damping(model, mx, "dof")


def find_tendon_damping(model: mujoco.MjModel, mx: mjx.Model) -> tuple[Any, Any]:
    """Damping of the tendons, with that of actuators at them: (linear [ntendon], higher [ntendon, number])."""
    return _find_damping(model, mx, "tendon")


def _find_damping(model, mx, kind: str) -> tuple[Any, Any]:
    linear, higher = get_number(model, mx, f"{kind}_damping"), get_number(model, mx, f"{kind}_dampingpoly")
    if not (model.actuator_damping.any() or model.actuator_dampingpoly.any()):
        return linear, higher
    share = _find_shares(model, mx, kind)
    return linear + contract(share, model.actuator_damping), higher + contract(share, model.actuator_dampingpoly)


def find_armature(model: mujoco.MjModel, mx: mjx.Model, kind: str):
    """Armature of the velocities (kind="dof") or the tendons (kind="tendon"), with that of actuators at them."""
    armature = get_number(model, mx, f"{kind}_armature")
    if not model.actuator_armature.any():
        return armature
    return armature + contract(_find_shares(model, mx, kind), model.actuator_armature)


def _find_shares(model, mx, kind: str):
    """The squared gears of the actuators at velocities (kind="dof") or tendons (kind="tendon") [n, nu]."""
    targets = model.dof_jntid if kind == "dof" else np.arange(model.ntendon)
    transmissions = JOINT_TRANSMISSIONS if kind == "dof" else (TRANSMISSION.TENDON,)
    here = np.isin(model.actuator_trntype, transmissions) & (model.actuator_trnid[:, 0] == targets[:, None])
    return here * get_number(model, mx, "actuator_gear")[:, 0] ** 2


def _find_dampers(model, mx, d: mjx.Data):
    """Forces of the joints' dampers [nv]."""
    linear, higher = find_joint_damping(model, mx)
    return -d.qvel * evaluate_coefficient(linear, higher, jnp.abs(d.qvel))


# --- gravity compensation and fluids ----------------------------------------------------------------------------------


def find_gravity_compensation(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data):
    """Forces on the joints that carry a share of the bodies' weight [nv]."""
    if not compensates_gravity(model, mx):
        return np.zeros(model.nv)
    share, gravity = get_number(model, mx, "body_gravcomp"), get_number(model, mx, "opt.gravity")
    bodies = np.arange(model.nbody) if is_traced(share) else np.nonzero(share)[0]
    weight = get_number(model, mx, "body_mass")[bodies] * share[bodies]
    J, _ = find_jacobians(model, d, d.xipos[bodies], bodies)
    return -(contract(J, gravity) * weight[:, None]).sum(0)


def compensates_gravity(model: mujoco.MjModel, mx: mjx.Model) -> bool:
    """Whether the weight of bodies is compensated."""
    off = is_disabled(model, DISABLED.SPRING, DISABLED.DAMPER) or is_disabled(model, DISABLED.GRAVITY)
    return not (off or is_zero(get_number(model, mx, "body_gravcomp")) or is_zero(get_number(model, mx, "opt.gravity")))


def has_fluid(model: mujoco.MjModel, mx: mjx.Model) -> bool:
    """Whether the medium has a density or a viscosity."""
    return not (is_zero(get_number(model, mx, "opt.density")) and is_zero(get_number(model, mx, "opt.viscosity")))


def find_fluid_forces(model, mx, d: mjx.Data, smooth: Smooth):
    """Drag and viscous forces on the boxes of the bodies' inertia [nv]."""
    rows, velocity, linear, quadratic = _find_drag(model, mx, d, smooth)
    force = linear * velocity + quadratic * jnp.abs(velocity) * velocity
    return -(rows * force[:, :, None]).sum((0, 1))


def _find_drag(model, mx, d: mjx.Data, smooth: Smooth):
    """Velocities of the bodies' boxes relative to the medium, and the coefficients of the forces against them.

    Returns:
      (rows [n, 6, nv], velocity [n, 6], linear [n, 6], quadratic [n, 6]): angular and linear velocities in the axes of
      the inertia are rows qvel, less the wind; the force is -(linear v + quadratic |v| v).
    """
    mass, inertia = get_number(model, mx, "body_mass"), get_number(model, mx, "body_inertia")
    bodies = np.arange(1, model.nbody)
    if not is_traced(mass):
        bodies = bodies[mass[1:] >= SMALL]
    J, J_r = find_jacobians(model, d, d.xipos[bodies], bodies)
    axes = d.ximat[bodies]
    rows = jnp.concatenate([jnp.einsum("nvi,nij->njv", x, axes) for x in (J_r, J)], 1)
    spin, velocity = find_body_velocities(smooth.tree, smooth.poses, d)
    spin, velocity = spin[bodies], velocity[bodies]
    velocity = velocity + cross_each(spin, d.xipos[bodies] - d.xpos[bodies]) - get_number(model, mx, "opt.wind")
    back = axes.swapaxes(-1, -2)
    velocity = jnp.concatenate([rotate_each(back, spin), rotate_each(back, velocity)], 1)
    linear, quadratic = _find_drag_coefficients(
        mass[bodies], inertia[bodies], get_number(model, mx, "opt.density"), get_number(model, mx, "opt.viscosity")
    )
    return rows, velocity, linear, quadratic


def _find_drag_coefficients(mass, inertia, density, viscosity):
    """Linear and quadratic drag of boxes with this mass and inertia, [n, 6] each."""
    xp = module_of(mass, inertia)
    size = xp.sqrt(xp.maximum(SMALL, inertia.sum(-1, keepdims=True) - 2.0 * inertia) / mass[:, None] * 6.0)
    diameter = size.mean(-1, keepdims=True)
    linear = xp.concatenate([np.pi * diameter**3 + 0.0 * size, 3.0 * np.pi * diameter + 0.0 * size], -1)
    next_, last = size[:, [1, 2, 0]], size[:, [2, 0, 1]]
    quadratic = xp.concatenate([size * (next_**4 + last**4) / 64.0, 0.5 * next_ * last], -1)
    return linear * viscosity, quadratic * density


# --- derivatives ------------------------------------------------------------------------------------------------------


def find_passive_derivative(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, smooth: Smooth):
    """Derivative of the passive forces with respect to qvel [nv, nv], symmetric."""
    result = np.zeros((model.nv, model.nv))
    if is_disabled(model, DISABLED.SPRING, DISABLED.DAMPER):
        return result
    if has_fluid(model, mx):
        rows, velocity, linear, quadratic = _find_drag(model, mx, d, smooth)
        slope = linear + 2.0 * quadratic * jnp.abs(velocity)
        result = result - jnp.einsum("niv,ni,niw->vw", rows, slope, rows)
    if is_disabled(model, DISABLED.DAMPER):
        return result
    linear, higher = find_joint_damping(model, mx)
    if not (is_zero(linear) and is_zero(higher)):
        slope = evaluate_coefficient(linear, higher, jnp.abs(d.qvel), derivative=True)
        result = result - slope * np.eye(model.nv)
    linear, higher = find_tendon_damping(model, mx)
    if not model.ntendon or (is_zero(linear) and is_zero(higher)):
        return result
    slope = evaluate_coefficient(linear, higher, jnp.abs(smooth.tendon_velocity), derivative=True)
    return result - contract(smooth.tendon_jacobian.T * slope, smooth.tendon_jacobian)
