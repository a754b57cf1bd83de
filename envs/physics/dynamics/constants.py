"""What MuJoCo derives from a model at its initial position: inverse inertias, lengths, anchors, damping of servos.

With the mass matrix M at qpos0, the inverse inertia that a constraint with the Jacobian J sees there is J M^-1 J'. For
joints and bodies MuJoCo keeps its mean over directions.

Source: MuJoCo's documentation, chapter Computation, section Constraint model, and chapter XML Reference (dampratio).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.dynamics.codes import GAIN, OBJECT
from envs.physics.dynamics.forces import find_armature
from envs.physics.dynamics.forward import find_inertia
from envs.physics.dynamics.kinematics import find_carried, find_jacobians
from envs.physics.dynamics.numbers import SMALL, get_number, module_of
from envs.physics.dynamics.rotations import CONJUGATE, contract, length, multiply_each, rotate_each
from envs.physics.dynamics.transmissions import find_transmissions
from envs.physics.dynamics.tree import BALL, FREE

if TYPE_CHECKING:
    from mujoco import mjx

SIMPLE_SLIDES = 2  # body_simple of a body that only slides
WELD_IS_DERIVED = 11  # place in eq_data of the mark that the relative pose of a weld was not given


def scale_inertia(model: mujoco.MjModel, mass: Any) -> Any:
    """Moments of inertia of bodies of these masses [nbody] whose density changes by the same factor everywhere.

    A body without mass keeps its own.
    """
    heavy = model.body_mass > 0
    scale = module_of(mass).where(heavy, mass / np.where(heavy, model.body_mass, 1.0), 1.0)
    return scale[:, None] * model.body_inertia


def find_constants(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, servos: np.ndarray) -> dict[str, Any]:
    """The derived fields that a step depends on, by name.

    Args:
      model: the model.
      mx: its numbers, some of which may be arguments of the traced function.
      d: with qpos = qpos0 and the initial poses of mocap bodies.
      servos: numbers of position servos whose damping follows from a ratio.
    """
    d, _, _, mass, tendon_jacobian = find_inertia(model, mx, d)
    mass = jnp.asarray(mass)
    inverse = jnp.linalg.inv(mass)
    found = {
        "body_subtreemass": contract(find_carried(model).astype(float), get_number(model, mx, "body_mass")),
        "body_invweight0": _weigh_bodies(model, mx, d, inverse),
        # the diagonal without the armature of tendons, which C MuJoCo adds later
        "dof_M0": jnp.diag(mass) - contract(find_armature(model, mx, "tendon"), tendon_jacobian**2),
        "dof_invweight0": _weigh_joints(model, mx, inverse),
        "eq_data": _find_relative_poses(model, mx, d),
    }
    if model.ntendon:
        found["tendon_length0"] = d.ten_length
        found["tendon_invweight0"] = _weigh(tendon_jacobian, inverse)
    has_muscles = (model.actuator_gaintype == GAIN.MUSCLE).any()
    if has_muscles or servos.size:
        moment = jnp.asarray(find_transmissions(model, mx, d, tendon_jacobian)[1])
    if has_muscles:
        found["actuator_acc0"] = length(contract(moment, inverse))
    if servos.size:
        found["actuator_biasprm"] = _find_biases(model, mx, servos, _weigh(moment[servos], inverse))
    return found


def _weigh(jacobian, inverse):
    """The diagonal of J M^-1 J' for J [n, nv]."""
    return (contract(jacobian, inverse) * jacobian).sum(-1)


def _weigh_bodies(model, mx, d: mjx.Data, inverse):
    """Inverse inertias for forces and torques at the bodies' centres of mass, means over the directions [nbody, 2].

    For a force on a body that only slides it is the inverse of its mass, in all directions.
    """
    jacobians = find_jacobians(model, d, d.xipos, np.arange(model.nbody))
    force, torque = (jnp.einsum("nvi,vw,nwi->n", J, inverse, J) / 3 for J in jacobians)
    slides, inverse_mass = _find_sliding(model, mx)
    return jnp.stack([jnp.where(slides, inverse_mass, force), torque], 1)


def _weigh_joints(model, mx, inverse):
    """Inverse inertias of the degrees of freedom, means over those of a joint that are alike [nv].

    Of a body that only slides, it is the inverse of its mass, without armature.
    """
    slides, inverse_mass = (x[model.dof_bodyid] for x in _find_sliding(model, mx))
    return jnp.where(slides, inverse_mass, contract(_average_joints(model), jnp.diag(inverse)))


def _find_sliding(model, mx):
    """Which bodies only slide, along their own axes, and carry nothing; and the inverse of their masses [nbody]."""
    slides = model.body_simple == SIMPLE_SLIDES
    return slides, 1 / jnp.where(slides, get_number(model, mx, "body_mass"), 1.0)


def _average_joints(model) -> np.ndarray:
    """The matrix that takes means over the three directions of forces, and of torques, of each joint [nv, nv]."""
    result = np.eye(model.nv)
    for kind, dof in zip(model.jnt_type, model.jnt_dofadr, strict=True):
        for begin in {FREE: (dof, dof + 3), BALL: (dof,)}.get(int(kind), ()):
            result[begin : begin + 3, begin : begin + 3] = 1 / 3
    return result


def _find_relative_poses(model, mx, d: mjx.Data):
    """The parameters of equalities, with what makes those between bodies hold at the initial position.

    That is the second anchor of a `connect`, and the relative pose of a `weld` whose pose is not given.
    """
    data = get_number(model, mx, "eq_data")
    between_bodies = model.eq_objtype == OBJECT.BODY
    connects = np.flatnonzero(between_bodies & (model.eq_type == mujoco.mjtEq.mjEQ_CONNECT))
    is_derived = model.eq_data[:, WELD_IS_DERIVED] != 0
    welds = np.flatnonzero(between_bodies & (model.eq_type == mujoco.mjtEq.mjEQ_WELD) & is_derived)
    for ids, objects in (
        (connects, (model.eq_obj1id, model.eq_obj2id)),
        (welds, (model.eq_obj2id, model.eq_obj1id)),  # the first point of a weld is one of the second body
    ):
        if ids.size:
            one, other = (each[ids] for each in objects)
            point = d.xpos[one] + rotate_each(d.xmat[one], data[ids, :3]) - d.xpos[other]
            data = jnp.asarray(data).at[ids, 3:6].set(rotate_each(d.xmat[other].swapaxes(1, 2), point))
    if welds.size:
        first, second = d.xquat[model.eq_obj1id[welds]], d.xquat[model.eq_obj2id[welds]]
        data = jnp.asarray(data).at[welds, 6:10].set(multiply_each(first * CONJUGATE, second))
    return data


def _find_biases(model, mx, servos: np.ndarray, weight):
    """Parameters of the actuators' biases, with the damping 2 z sqrt(k / w) of these servos.

    The ratio z is that of the compiled model, k the gain, and w the inverse inertia that the servo sees.
    """
    gain = get_number(model, mx, "actuator_gainprm")[servos, 0]
    damping = 2.0 * _find_ratios(model)[servos] * jnp.sqrt(gain / weight)
    return jnp.asarray(get_number(model, mx, "actuator_biasprm")).at[servos, 2].set(-damping)


def _find_ratios(model) -> np.ndarray:
    """The damping ratios of the position servos of a compiled model [nu]."""
    d, mass, moment = mujoco.MjData(model), np.empty((model.nv, model.nv)), np.empty((model.nu, model.nv))
    mujoco.mj_fwdPosition(model, d)
    mujoco.mj_fullM(model, d, mass)
    mujoco.mju_sparse2dense(moment, d.actuator_moment, d.moment_rownnz, d.moment_rowadr, d.moment_colind)
    stiffness = model.actuator_gainprm[:, 0] / np.maximum(_weigh(moment, np.linalg.inv(mass)), SMALL)
    return -model.actuator_biasprm[:, 2] / (2.0 * np.sqrt(np.maximum(stiffness, SMALL)))
