"""C MuJoCo's `mj_forward` and `mj_step` for one environment, with the solver of the constraints handed in."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.dynamics.actuators import add_actuator_forces, is_idle
from envs.physics.dynamics.codes import DISABLED, INTEGRATOR, WRAP
from envs.physics.dynamics.forces import (
    compensates_gravity,
    find_armature,
    find_fluid_forces,
    find_passive_forces,
    has_fluid,
    is_disabled,
)
from envs.physics.dynamics.integrators import advance, find_coupled, find_integrated_acceleration, step_rk4
from envs.physics.dynamics.kinematics import add_fields, find_jacobians, place_bodies
from envs.physics.dynamics.linear_algebra import solve
from envs.physics.dynamics.newton_euler import find_bias, find_mass_matrix, find_poses
from envs.physics.dynamics.numbers import get_number, is_traced, is_zero
from envs.physics.dynamics.rotations import contract
from envs.physics.dynamics.sensors import add_readings
from envs.physics.dynamics.smooth import Smooth
from envs.physics.dynamics.transmissions import find_tendon_rates, find_tendons, find_transmissions
from envs.physics.dynamics.tree import make_tree

if TYPE_CHECKING:
    from mujoco import mjx

# Fields of the state before a step that are not those of the last stage of RK4.
READINGS = ("sensordata", "energy", "cfrc_ext")
# (model, mx, d, smooth) -> (qacc [nv], qfrc_constraint [nv])
Solver = Callable[..., tuple]


def unconstrained(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, smooth: Smooth) -> tuple:
    """The solution without constraints: (M^-1 qfrc_smooth, 0)."""
    return d.qacc_smooth, jnp.zeros(model.nv)


def forward(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, solve: Solver, also=()) -> mjx.Data:
    """Everything that follows from a state and controls, as by `mj_forward`.

    Args:
      model: the model.
      mx: its numbers, some of which may be arguments of the traced function.
      d: with time, qpos, qvel, act, ctrl, mocap poses and applied forces.
      solve: (model, mx, d, smooth) -> (qacc [nv], qfrc_constraint [nv]), where d has the poses of all bodies, tendons,
        qfrc_smooth and qacc_smooth; `unconstrained`, for example.
      also: names of fields to compute that no force needs: those of `add_fields`, and others that read the result. With
        the fields of `fields.ADDED` among them, d is a `data.Data`.

    Returns:
      The data.
    """
    return evaluate(model, mx, d, solve, also)[0]


def step(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, solve: Solver, also=()) -> mjx.Data:
    """The data after one time step with the model's integrator, as by `mj_step`; arguments as of `forward`."""
    return step_with_flag(model, mx, d, solve, also)[0]


def step_with_flag(model, mx, d: mjx.Data, solve: Solver, also=(), written_out: bool = True):
    """The data after one time step, and the largest `Smooth.flag` of its evaluations.

    Args:
      model, mx, d, solve, also: as of `forward`.
      written_out: as of `step_rk4`.
    """
    if model.opt.integrator == INTEGRATOR.RK4:
        stage_fields = [name for name in also if name not in READINGS]

        def find_rates(stage):
            stage, smooth = evaluate(model, mx, stage, solve, stage_fields, False)
            return stage, smooth.flag

        read = [name for name in READINGS if name == "sensordata" or name in also]
        first = evaluate(model, mx, d, solve, also)[0] if model.nsensor or len(read) > 1 else d
        d, flag = step_rk4(model, mx, d, find_rates, written_out)
        return d.replace(**{name: getattr(first, name) for name in read}), flag
    d, smooth = evaluate(model, mx, d, solve, also)
    return advance(model, mx, d, find_integrated_acceleration(model, mx, d, smooth), d.act_dot), smooth.flag


def evaluate(model, mx, d: mjx.Data, find_solution: Solver, also=(), sensors: bool = True):
    """The data of `forward`, and what the integrator needs besides."""
    d, smooth = find_positions(model, mx, d)
    d = add_fields(model, mx, d, smooth.tree, smooth.poses, also) if also else d
    others, gravcomp = find_passive_forces(model, mx, d, smooth)
    if "qfrc_fluid" in also and has_fluid(model, mx) and not is_disabled(model, DISABLED.SPRING, DISABLED.DAMPER):
        d = d.replace(qfrc_fluid=find_fluid_forces(model, mx, d, smooth))
    by_actuators = model.jnt_actgravcomp[model.dof_jntid].astype(bool)
    passive, bias = others + jnp.where(by_actuators, 0.0, gravcomp), _find_bias(model, mx, d, smooth)
    d = d.replace(qfrc_passive=jnp.asarray(passive), qfrc_gravcomp=jnp.asarray(gravcomp), qfrc_bias=bias)
    d = add_actuator_forces(model, mx, d, smooth)
    inner = passive - bias
    if compensates_gravity(model, mx) and not by_actuators.any():  # fewer equations than the sum of both
        inner = others - _find_bias(model, mx, d, smooth, compensated=True)
    d = d.replace(qfrc_smooth=inner + d.qfrc_actuator + d.qfrc_applied + _find_applied(model, d))
    d = d.replace(qacc_smooth=solve(smooth.mass, d.qfrc_smooth))
    qacc, constraint = find_solution(model, mx, d, smooth)
    d = d.replace(qacc=qacc, qfrc_constraint=constraint)
    return add_readings(model, mx, d, smooth, also, sensors), smooth


def find_inverse(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, smooth: Smooth):
    """The force that makes qacc, besides those of springs, dampers, fluids and constraints, as by `mj_inverse` [nv]."""
    force = _find_bias(model, mx, d, smooth, qacc=d.qacc) + find_armature(model, mx, "dof") * d.qacc
    armature = find_armature(model, mx, "tendon")
    if not is_zero(armature):
        J = smooth.tendon_jacobian
        force = force + contract(jnp.where(find_coupled(model), contract(J.T * armature, J), 0.0), d.qacc)
    return force - d.qfrc_passive - d.qfrc_constraint


def find_kinematics(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, also=()) -> mjx.Data:
    """The data with poses, and with those fields of `fields.KINEMATICS` that are named; from positions alone."""
    tree = make_tree(model, mx, d)
    poses = find_poses(tree, d.qpos, get_number(model, mx, "qpos0"))
    d = place_bodies(model, mx, d, tree, poses)
    if "ten_length" in also and model.ntendon:
        d = d.replace(ten_length=find_tendons(model, mx, d)[0])
    return add_fields(model, mx, d, tree, poses, also)


def find_positions(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data) -> tuple[mjx.Data, Smooth]:
    """The data with poses and lengths, and the quantities between the state and the forces."""
    d, tree, poses, mass, J = find_inertia(model, mx, d)
    moment = np.zeros((0, model.nv))
    if model.nu:
        lengths, moment = find_transmissions(model, mx, d, J)
        d = d.replace(actuator_length=lengths)
    speeds = contract(moment, d.qvel) * (0.0 if is_idle(model) else 1.0)
    return d, Smooth(tree, poses, mass, J, contract(J, d.qvel), moment, speeds)


def find_inertia(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data):
    """The data with poses and the lengths of tendons, and what the mass matrix follows from.

    Returns:
      (data, links, their poses relative to their parents, mass matrix with armatures [nv, nv], derivatives of the
      tendons' lengths [ntendon, nv]).
    """
    tree = make_tree(model, mx, d)
    poses = find_poses(tree, d.qpos, get_number(model, mx, "qpos0"))
    d = place_bodies(model, mx, d, tree, poses)
    mass = find_mass_matrix(tree, poses, model.nv) + find_armature(model, mx, "dof") * np.eye(model.nv)
    J = np.zeros((0, model.nv))
    if model.ntendon:
        lengths, J = find_tendons(model, mx, d)
        d = d.replace(ten_length=lengths)
        armature = find_armature(model, mx, "tendon")
        if not is_zero(armature):
            mass = mass + jnp.where(find_coupled(model), contract(J.T * armature, J), 0.0)
    return d, tree, poses, mass, J


def _find_bias(model, mx, d: mjx.Data, smooth: Smooth, compensated: bool = False, qacc=None):
    """Coriolis, centrifugal and gravitational forces, with those of the tendons' armature [nv]; and M qacc."""
    off = is_disabled(model, DISABLED.GRAVITY)
    gravity = np.zeros(3) if off else get_number(model, mx, "opt.gravity")
    bias = find_bias(smooth.tree, smooth.poses, d.qvel, gravity, compensated, qacc)
    armature = find_armature(model, mx, "tendon")
    if is_zero(armature) or not (model.wrap_type == WRAP.SITE).any():
        return bias
    rates = find_tendon_rates(model, d, smooth)
    return bias + contract(armature * rates, smooth.tendon_jacobian)


def _find_applied(model, d: mjx.Data):
    """The forces and torques that are applied to the bodies' centres of mass, on the joints [nv]."""
    if not is_traced(d.xfrc_applied) and is_zero(d.xfrc_applied):
        return 0.0
    J, J_r = find_jacobians(model, d, d.xipos, np.arange(model.nbody))
    wrench = d.xfrc_applied[:, None, :]
    return (J * wrench[..., :3] + J_r * wrench[..., 3:]).sum((0, 2))
