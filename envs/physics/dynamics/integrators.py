"""From accelerations to the next state."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.dynamics.actuators import (
    find_actuator_derivative,
    find_enabled,
    find_next_activations,
    is_idle,
    wrap_activations,
)
from envs.physics.dynamics.codes import DISABLED, INTEGRATOR
from envs.physics.dynamics.forces import (
    evaluate_coefficient,
    find_joint_damping,
    find_passive_derivative,
    is_disabled,
)
from envs.physics.dynamics.kinematics import find_carriers
from envs.physics.dynamics.linear_algebra import solve, solve_general
from envs.physics.dynamics.newton_euler import find_bias, find_force
from envs.physics.dynamics.numbers import get_number, is_zero
from envs.physics.dynamics.rotations import contract, from_rotation_vector, multiply, normalize, skew
from envs.physics.dynamics.smooth import Smooth
from envs.physics.dynamics.tree import BALL, FREE

if TYPE_CHECKING:
    from mujoco import mjx


def find_integrated_acceleration(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, smooth: Smooth):
    """The acceleration by which a step changes the velocity [nv]; RK4, which has several, is not meant here."""
    if model.opt.integrator == INTEGRATOR.EULER:
        return _find_euler(model, mx, d, smooth)
    if model.opt.integrator == INTEGRATOR.IMPLICITFAST:
        return _find_implicitfast(model, mx, d, smooth)
    return _find_implicit(model, mx, d, smooth)


def _find_euler(model, mx, d: mjx.Data, smooth: Smooth):
    """(M + h B)^-1 (M qacc), B the derivative of the joints' damping; qacc if there is none."""
    linear, higher = find_joint_damping(model, mx)
    undamped = is_zero(linear) and is_zero(higher)
    if undamped or is_disabled(model, DISABLED.EULERDAMP) or is_disabled(model, DISABLED.DAMPER):
        return d.qacc
    slope = evaluate_coefficient(linear, higher, jnp.abs(d.qvel), derivative=True)
    matrix = smooth.mass + get_number(model, mx, "opt.timestep") * slope * np.eye(model.nv)
    return solve(matrix, d.qfrc_smooth + d.qfrc_constraint)


def find_coupled(model: mujoco.MjModel) -> np.ndarray:
    """Which velocities C MuJoCo's sparse matrices couple: of joints one of which carries the other [nv, nv]."""
    carries = find_carriers(model)[model.dof_bodyid] & np.tri(model.nv, dtype=bool)
    return carries | carries.T


def _find_implicitfast(model, mx, d: mjx.Data, smooth: Smooth):
    """(M - h D)^-1 (M qacc), D the derivative of the forces of actuators and dampers.

    D has no entries between joints neither of which carries the other, and that of the bias force only for single free
    bodies, whose own equations C MuJoCo solves with it.
    """
    step = get_number(model, mx, "opt.timestep")
    slope = find_actuator_derivative(model, mx, d, smooth) + find_passive_derivative(model, mx, d, smooth)
    slope = jnp.where(find_coupled(model), slope, 0.0)
    force = d.qfrc_smooth + d.qfrc_constraint
    matrix = smooth.mass - step * slope
    free = [link for link in smooth.tree.links if link.kind == FREE and is_single(model, link.joint)]
    if not free:
        return d.qacc if is_zero(slope) else solve(matrix, force)
    single = np.zeros(model.nv, bool)
    qacc = jnp.zeros(model.nv)
    for link in free:
        here = link.dofs
        single[here] = True
        R = smooth.poses[smooth.tree.links.index(link)][0]
        block = matrix[here, here] + step * jnp.pad(_find_free_bias_derivative(link, R, d.qvel[here]), ((0, 0), (3, 0)))
        qacc = qacc.at[here].set(solve_general(block, force[here]))
    rest = np.nonzero(~single)[0]
    return qacc.at[rest].set(solve(matrix[np.ix_(rest, rest)], force[rest])) if rest.size else qacc


def is_single(model: mujoco.MjModel, joint: int) -> bool:
    """Whether the body of a free joint moves by nothing else and carries nothing."""
    body = model.jnt_bodyid[joint]
    tree = model.dof_treeid[model.jnt_dofadr[joint]]
    whole = model.tree_dofnum[tree] == 6 and model.body_subtreemass[body] == model.body_mass[body]
    return bool(whole and model.body_jntnum[body] == 1)


def _find_free_bias_derivative(link, R, qvel):
    """Derivative of a single free body's bias force with respect to its angular velocity [6, 3]."""
    turn = skew(qvel[3:])
    columns = []
    for axis in np.eye(3):  # the derivative of [omega x]^2 along an axis e is [e x] [omega x] + [omega x] [e x]
        along = skew(axis)
        force, torque = find_force(link, contract(along, turn) + contract(turn, along), np.zeros(3))
        columns.append(jnp.concatenate([contract(R, force), torque]))
    return jnp.stack(columns, 1)


def _find_implicit(model, mx, d: mjx.Data, smooth: Smooth):
    """(M - h D)^-1 (M qacc), D the derivative of all smooth forces, the bias force included."""
    gravity = np.zeros(3)  # which does not depend on the velocity
    bias = jax.jacfwd(lambda qvel: find_bias(smooth.tree, smooth.poses, qvel, gravity))(d.qvel)
    slope = find_actuator_derivative(model, mx, d, smooth) + find_passive_derivative(model, mx, d, smooth)
    slope = jnp.where(find_coupled(model), slope, 0.0) - bias
    matrix = smooth.mass - get_number(model, mx, "opt.timestep") * slope
    return solve_general(matrix, d.qfrc_smooth + d.qfrc_constraint)


# --- the state --------------------------------------------------------------------------------------------------------


def advance(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, qacc, act_dot, qvel=None) -> mjx.Data:
    """The data with the state after a step.

    Args:
      model: the model.
      mx: its numbers.
      d: with the state before the step, and qacc, which the next step's solver starts from.
      qacc: the acceleration that changes qvel [nv].
      act_dot: rates of the activations [na].
      qvel: the velocity that changes qpos, if not the new one [nv].
    """
    step = get_number(model, mx, "opt.timestep")
    if model.na and not is_idle(model):
        owners = np.concatenate([np.full(n, i) for i, n in enumerate(np.maximum(model.actuator_actnum, 0))]).astype(int)
        rate = jnp.where(find_enabled(model)[owners], act_dot, 0.0)
        d = d.replace(act=wrap_activations(model, mx, d, find_next_activations(model, mx, d, rate)))
    d = d.replace(qvel=d.qvel + step * qacc, qacc_warmstart=d.qacc, time=d.time + step)
    return d.replace(qpos=integrate_position(model, d.qpos, d.qvel if qvel is None else qvel, step))


def integrate_position(model: mujoco.MjModel, qpos, qvel, step):
    """The position after moving with a constant velocity; quaternions turn by theirs and are of unit length.

    Args:
      model: the model.
      qpos: [nq].
      qvel: [nv].
      step: time, s.

    Returns:
      qpos [nq].
    """
    linear = np.zeros((model.nv, model.nq))
    rotations = []
    for kind, q, v in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True):
        number = {FREE: 3, BALL: 0}.get(int(kind), 1)
        linear[v + np.arange(number), q + np.arange(number)] = 1.0
        if kind in (FREE, BALL):
            rotations.append((q + number, v + number))
    moved = qpos + contract(step * qvel, linear)
    for q, v in rotations:
        moved = moved.at[q : q + 4].set(_turn(qpos[q : q + 4], qvel[v : v + 3], step))
    return moved


def _turn(quat, spin, step):
    """The orientation, normalised, after turning with this angular velocity in its own axes."""
    return multiply(normalize(quat), from_rotation_vector(step * spin))


RK4_SHARES = (0.0, 0.5, 0.5, 1.0)  # of the time step, after which each stage is
RK4_WEIGHTS = (1 / 6, 1 / 3, 1 / 3, 1 / 6)


def step_rk4(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, evaluate: Callable, written_out: bool):
    """A step of the classical Runge-Kutta method, as C MuJoCo has it: positions of stages from mean velocities.

    Args:
      model: the model.
      mx: its numbers.
      d: the data with the state before the step.
      evaluate: data -> (data with qacc and act_dot of its state, flag).
      written_out: write the stages out, which can be differentiated, instead of keeping them as a loop.

    Returns:
      The data after the step, of which all but the state is that of the last stage, and the largest flag.
    """
    step = get_number(model, mx, "opt.timestep")

    def proceed(share, weight, state):
        stage, (qvel, qacc, act_dot), total, flag = state
        stage = stage.replace(
            qpos=integrate_position(model, d.qpos, share * qvel, step),
            qvel=d.qvel + step * share * qacc,
            act=d.act + step * share * act_dot,
            time=d.time + step * share,
        )
        stage, here = evaluate(stage)
        rate = stage.qvel, stage.qacc, stage.act_dot
        return stage, rate, jax.tree.map(lambda x, dx: x + weight * dx, total, rate), jnp.maximum(flag, here)

    still = jax.tree.map(jnp.zeros_like, (d.qvel, d.qvel, d.act))
    state = d, still, still, jnp.zeros(())
    if written_out:
        for share, weight in zip(RK4_SHARES, RK4_WEIGHTS, strict=True):
            state = proceed(share, weight, state)
    else:
        state = _repeat_stages(proceed, state, jnp.any(jnp.isnan(d.qpos)))
    stage, _, (qvel, qacc, act_dot), flag = state
    stage = stage.replace(qpos=d.qpos, qvel=d.qvel, act=d.act, time=d.time)
    return advance(model, mx, stage, qacc, act_dot, qvel), flag


def _repeat_stages(proceed: Callable, state, is_lost):
    """The state after the stages, as a loop, whose equations are there only once.

    Its length depends on the data, if only where they are NaN anyway: so the interpreter does not write it out.
    """

    def body(carry):
        i, state = carry
        after = proceed(jnp.array(RK4_SHARES)[i], jnp.array(RK4_WEIGHTS)[i], state)
        return i + 1, jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), after, state)

    def goes_on(carry):
        return carry[0] < len(RK4_SHARES) + is_lost

    return jax.lax.while_loop(goes_on, body, (jnp.zeros((), int), jax.tree.map(jnp.asarray, state)))[1]
