"""The constraints of a state: what the solver needs to know of equalities, friction loss, limits and contacts.

A constraint of dimension k acts on k numbers u, linear in the acceleration a of the degrees of freedom:

    u = J a - r

J is the constraint's Jacobian, and r the reference acceleration, which would take the constraint's violation and its
velocity to zero like a damped spring. The constraint pulls u to 0 with the force -s'(u), where s is a convex function;
`envs.physics.dynamics.solver` finds the acceleration at which all forces balance.

Source: Todorov, "Convex and analytically-invertible dynamics with contacts and constraints" (ICRA 2014), and MuJoCo's
documentation, chapter Computation, section Constraint model.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.dynamics.codes import DISABLED
from envs.physics.dynamics.forces import is_disabled
from envs.physics.dynamics.kinematics import find_accelerations, find_body_velocities, find_jacobians
from envs.physics.dynamics.numbers import get_number, is_traced
from envs.physics.dynamics.rotations import conjugate, cross_each, multiply, multiply_each, rotate_each
from envs.physics.dynamics.smooth import Smooth

if TYPE_CHECKING:
    from mujoco import mjx

DEFAULT_SOLREF = np.array([0.02, 1.0])
MIN_IMPEDANCE, MAX_IMPEDANCE = mujoco.mjMINIMP, mujoco.mjMAXIMP


Array = jax.Array | np.ndarray


class Rows(NamedTuple):
    """Constraints of dimension 1, whose force is that of a spring, between two bounds: s'(u) = clip(D u, low, high).

    An equality has no bounds, a limit only pushes (s' <= 0), and friction loss has both.

    Attributes:
      jacobian: J, `[n, nv]`.
      reference: r, `[n]`.
      stiffness: D, `[n]`; 0 if the constraint is not active.
      low, high: bounds of s', `[n]`, possibly infinite.
    """

    jacobian: jax.Array
    reference: jax.Array
    stiffness: jax.Array
    low: Array
    high: Array

    def apply(self, velocity: jax.Array) -> jax.Array:
        """J v, `[n]`."""
        return self.jacobian @ velocity

    def pull(self, forces: jax.Array) -> jax.Array:
        """J' w, `[nv]`."""
        return self.jacobian.T @ forces

    def value(self, u: jax.Array) -> jax.Array:
        """s(u) = s'(u) (u - s'(u) / (2 D)), summed over all rows; 0 where D = 0."""
        force = self.slope(u)
        safe = jnp.where(self.stiffness > 0, self.stiffness, 1.0)
        return jnp.sum(force * (u - force / (2 * safe)))

    def slope(self, u: jax.Array) -> jax.Array:
        """s'(u), `[n]`."""
        return jnp.clip(self.stiffness * u, self.low, self.high)

    def _curvature(self, u: jax.Array) -> jax.Array:
        force = self.stiffness * u
        return jnp.where((force > self.low) & (force < self.high), self.stiffness, 0.0)

    def slope_along(self, u: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
        """First and second derivative of s(u + t v) at t = 0, summed over all rows."""
        return jnp.sum(v * self.slope(u)), jnp.sum(v * v * self._curvature(u))

    def stiffen(self, u: jax.Array) -> jax.Array:
        """J' s''(u) J, `[nv, nv]`."""
        return (self.jacobian.T * self._curvature(u)) @ self.jacobian


class _Raw(NamedTuple):
    """Rows before their reference acceleration and stiffness are known.

    Attributes:
      jacobian: `[n, nv]`.
      position: violation of the constraint, beyond which it acts, `[n]`.
      impedance_position: the violation that decides the impedance, `[n]`.
      active: whether the constraint acts at all, `[n]`.
      weight: inverse inertia that the constraint sees at the initial position, `[n]`.
      solref, solimp: MuJoCo's parameters, `[n, 2]` and `[n, 5]`.
      low, high: bounds of s', `[n]`.
      bias: acceleration that belongs to the velocity alone, dJ/dt v, `[n]`.
    """

    jacobian: jax.Array
    position: jax.Array
    impedance_position: jax.Array
    active: Array
    weight: jax.Array
    solref: jax.Array
    solimp: jax.Array
    low: Array
    high: Array
    bias: jax.Array


def make_rows(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, smooth: Smooth) -> Rows:
    """The constraints of dimension 1 (all but contacts), in no particular order."""
    if is_disabled(model, DISABLED.CONSTRAINT):
        parts = []
    else:
        makers = [*EQUALITIES, _make_friction_loss, _make_joint_limits, _make_ball_limits, _make_tendon_limits]
        parts = [part for part in (make(model, mx, d, smooth) for make in makers) if part is not None]
    if not parts:
        empty = jnp.zeros(0)
        return Rows(jnp.zeros((0, model.nv)), empty, empty, empty, empty)
    raw = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
    stiffness, damping, impedance = find_impedance(model, mx, raw.solref, raw.solimp, raw.impedance_position)
    reference = -damping * (raw.jacobian @ d.qvel) - stiffness * impedance * raw.position - raw.bias
    active_stiffness = jnp.where(raw.active, 1 / find_regularization(impedance, raw.weight), 0.0)
    return Rows(raw.jacobian, reference, active_stiffness, raw.low, raw.high)


def find_impedance(
    model: mujoco.MjModel, mx: mjx.Model, solref: jax.Array, solimp: jax.Array, position: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """(k, b, d): stiffness and damping of the reference acceleration, -b v - k d x, and the impedance d in (0, 1).

    For solref = (time constant t, damping ratio z): b = 2 / (d_max t), k = 1 / (d_max t z)^2; for negative numbers
    (-stiffness, -damping): k = stiffness / d_max^2, b = damping / d_max. If only one number is positive, both are
    MuJoCo's defaults. The impedance rises from d_min to d_max as
    |position| rises from 0 to the width, along two powers that meet at the midpoint.

    Args:
      solref, solimp: MuJoCo's parameters, `[n, 2]` and `[n, 5]` (d_min, d_max, width, midpoint, power).
      position: distance from the constraint, `[n]`.
    """
    is_mixed = (solref[:, 0] > 0) != (solref[:, 1] > 0)
    first, second = jnp.where(is_mixed[:, None], DEFAULT_SOLREF, solref).T
    low, high, middle = (jnp.clip(solimp[:, i], MIN_IMPEDANCE, MAX_IMPEDANCE) for i in (0, 1, 3))
    width, power = jnp.maximum(solimp[:, 2], mujoco.mjMINVAL), jnp.maximum(solimp[:, 4], 1.0)
    time = (
        first if is_disabled(model, DISABLED.REFSAFE) else jnp.maximum(first, 2 * get_number(model, mx, "opt.timestep"))
    )
    is_standard = first > 0
    safe_time, ratio = jnp.where(is_standard, time, 1.0), jnp.where(is_standard, second, 1.0)
    stiffness = jnp.where(
        is_standard, 1 / jnp.maximum(mujoco.mjMINVAL, (high * safe_time * ratio) ** 2), -first / high**2
    )
    damping = jnp.where(is_standard, 2 / jnp.maximum(mujoco.mjMINVAL, high * safe_time), -second / high)
    x = jnp.minimum(jnp.abs(position) / width, 1.0)
    rising = x**power / middle ** (power - 1)
    settling = 1 - (1 - x) ** power / (1 - middle) ** (power - 1)
    shape = jnp.where(x <= middle, rising, settling)
    is_flat = (low == high) | (solimp[:, 2] <= mujoco.mjMINVAL)
    return stiffness, damping, jnp.where(is_flat, (low + high) / 2, low + shape * (high - low))


def find_regularization(impedance: jax.Array, weight: jax.Array) -> jax.Array:
    """R = 1 / D = w (1 - d) / d: at impedance d, the constraint does the share d of what would be needed."""
    return jnp.maximum(mujoco.mjMINVAL, weight * (1 - impedance) / impedance)


# --- equalities -------------------------------------------------------------------------------------------------------


def _make_connects(model, mx, d, smooth) -> _Raw | None:
    """A point of one body stays at a point of another: the difference of the two points is 0."""
    ids = _find_equalities(model, "CONNECT")
    if not ids.size:
        return None
    one, other = (
        _find_anchors(model, mx, d, smooth, ids, side, get_number(model, mx, "eq_data")[ids, 3 * side : 3 * side + 3])
        for side in (0, 1)
    )
    return _make_equality_rows(
        model,
        mx,
        d,
        ids,
        jacobian=(one.translation - other.translation).swapaxes(1, 2),
        position=one.point - other.point,
        weight=jnp.repeat(one.weight[:, :1] + other.weight[:, :1], 3, axis=1),
        bias=one.acceleration - other.acceleration,
    )


def _make_welds(model, mx, d, smooth) -> _Raw | None:
    """A frame of one body stays at a frame of another: the rotation between them, too, is as given.

    The rotational error is the vector part of the quaternion q = p* q1, where q1 is the orientation of the first body
    as it should be for the second one, and p that of the second. With angular velocities w1 and w2, its rate is the
    vector part of p* (w1 - w2) q1 / 2.
    """
    ids = _find_equalities(model, "WELD")
    if not ids.size:
        return None
    data = get_number(model, mx, "eq_data")[ids]
    one, other = (
        _find_anchors(model, mx, d, smooth, ids, side, data[:, 3 - 3 * side : 6 - 3 * side]) for side in (0, 1)
    )
    is_site = model.eq_objtype[ids] == mujoco.mjtObj.mjOBJ_SITE
    wanted = jnp.where(is_site[:, None], jnp.array([1.0, 0, 0, 0]), data[:, 6:10])
    scale = data[:, 10:11]
    first = multiply_each(one.quaternion, wanted)

    def turn(first, second, velocity):
        return jax.vmap(_turn_between)(first, second, velocity)

    axes = jnp.moveaxis(one.rotation - other.rotation, 1, 0)
    turning = jnp.moveaxis(jax.vmap(turn, (None, None, 0))(first, other.quaternion, axes), 0, 2)
    rates = [jax.vmap(_differentiate_quaternion)(q, w) for q, w in ((first, one.spin), (other.quaternion, other.spin))]
    point = (first, other.quaternion, one.spin - other.spin)
    _, turning_bias = jax.jvp(turn, point, (*rates, one.spin_rate - other.spin_rate))
    error = jax.vmap(lambda q, p: multiply(conjugate(p), q)[1:])(first, other.quaternion)
    return _make_equality_rows(
        model,
        mx,
        d,
        ids,
        jacobian=jnp.concatenate(
            [(one.translation - other.translation).swapaxes(1, 2), turning * scale[:, :, None]], axis=1
        ),
        position=jnp.concatenate([one.point - other.point, error * scale], axis=1),
        weight=jnp.repeat(one.weight + other.weight, 3, axis=1),
        bias=jnp.concatenate([one.acceleration - other.acceleration, turning_bias * scale], axis=1),
    )


def _make_joint_equalities(model, mx, d, smooth) -> _Raw | None:
    """The position of one joint is a polynomial of another's, or constant: y - y0 = p(x - x0)."""
    ids = _find_equalities(model, "JOINT")
    if not ids.size:
        return None
    first, second = model.eq_obj1id[ids], model.eq_obj2id[ids]
    displacement, rows = d.qpos - get_number(model, mx, "qpos0"), jnp.eye(model.nv)
    return _make_coupling_rows(
        model,
        mx,
        d,
        ids,
        has_second=second >= 0,
        positions=(displacement[model.jnt_qposadr[first]], displacement[model.jnt_qposadr[second]]),
        jacobians=(rows[model.jnt_dofadr[first]], rows[model.jnt_dofadr[second]]),
        weights=(
            get_number(model, mx, "dof_invweight0")[model.jnt_dofadr[first]],
            get_number(model, mx, "dof_invweight0")[model.jnt_dofadr[second]],
        ),
    )


def _make_tendon_equalities(model, mx, d, smooth) -> _Raw | None:
    """The length of one tendon is a polynomial of another's, or constant."""
    ids = _find_equalities(model, "TENDON")
    if not ids.size:
        return None
    first, second = model.eq_obj1id[ids], model.eq_obj2id[ids]
    stretch, rows = d.ten_length - get_number(model, mx, "tendon_length0"), smooth.tendon_jacobian
    return _make_coupling_rows(
        model,
        mx,
        d,
        ids,
        has_second=second >= 0,
        positions=(stretch[first], stretch[second]),
        jacobians=(rows[first], rows[second]),
        weights=(get_number(model, mx, "tendon_invweight0")[first], get_number(model, mx, "tendon_invweight0")[second]),
    )


EQUALITIES = (_make_connects, _make_welds, _make_joint_equalities, _make_tendon_equalities)


def _find_equalities(model, kind: str) -> np.ndarray:
    """The numbers of the equalities of a kind."""
    if is_disabled(model, DISABLED.EQUALITY):
        return np.empty(0, int)
    return np.flatnonzero(model.eq_type == getattr(mujoco.mjtEq, f"mjEQ_{kind}"))


def _make_coupling_rows(model, mx, d, ids, has_second, positions, jacobians, weights) -> _Raw:
    """Rows of y = p(x): y - p(x), with Jacobian dy - p'(x) dx; without a second element x = 0."""
    y, x = positions[0], positions[1] * has_second
    coefficients = get_number(model, mx, "eq_data")[ids, :5]
    powers = jnp.stack([jnp.ones_like(x), x, x**2, x**3, x**4], axis=1)
    slope = jnp.sum(coefficients[:, 1:] * powers[:, :4] * np.arange(1.0, 5.0), axis=1) * has_second
    position = y - jnp.sum(coefficients * powers, axis=1)
    jacobian = jacobians[0] - slope[:, None] * jacobians[1]
    weight = weights[0] + weights[1] * has_second
    zero = jnp.zeros_like(position)
    return _make_equality_rows(model, mx, d, ids, jacobian[:, None], position[:, None], weight[:, None], zero[:, None])


def _make_equality_rows(model, mx, d, ids, jacobian, position, weight, bias) -> _Raw:
    """Rows of n equalities with k rows each, `[n, k, ...]`; which pull in both directions."""
    size = position.shape[1]
    violation = jnp.sqrt(jnp.sum(position**2, axis=1)) if size > 1 else position[:, 0]
    repeat = lambda x: jnp.repeat(x, size, axis=0)  # noqa: E731
    unbounded = np.full(position.size, np.inf)
    return _Raw(
        jacobian=jacobian.reshape(-1, jacobian.shape[-1]),
        position=position.reshape(-1),
        impedance_position=repeat(violation),
        active=repeat(d.eq_active[ids]),
        weight=weight.reshape(-1),
        solref=repeat(get_number(model, mx, "eq_solref")[ids]),
        solimp=repeat(get_number(model, mx, "eq_solimp")[ids]),
        low=-unbounded,
        high=unbounded,
        bias=bias.reshape(-1),
    )


class _Anchors(NamedTuple):
    """Points fixed to bodies, n of them.

    Attributes:
      point, quaternion: position and orientation, `[n, 3]`, `[n, 4]`.
      translation, rotation: velocity and angular velocity per velocity of each degree of freedom, `[n, nv, 3]`.
      acceleration, spin, spin_rate: acceleration, angular velocity and its rate if the degrees of freedom do not
        accelerate, `[n, 3]`.
      weight: inverse inertia of the body for forces and torques, `[n, 2]`.
    """

    point: jax.Array
    quaternion: jax.Array
    translation: jax.Array
    rotation: jax.Array
    acceleration: jax.Array
    spin: jax.Array
    spin_rate: jax.Array
    weight: jax.Array


def _find_anchors(model, mx, d, smooth, ids, side: int, local_points) -> _Anchors:
    """The first (0) or second (1) points of equalities: sites, or points in the frames of bodies."""
    objects = (model.eq_obj1id, model.eq_obj2id)[side][ids]
    is_site = model.eq_objtype[ids] == mujoco.mjtObj.mjOBJ_SITE
    sites = np.where(is_site, objects, 0)
    bodies = np.where(is_site, model.site_bodyid[sites], objects) if model.nsite else objects
    point = d.xpos[bodies] + rotate_each(d.xmat[bodies], local_points)
    quaternion = d.xquat[bodies]
    if is_site.any():
        turned = multiply_each(quaternion, get_number(model, mx, "site_quat")[sites])
        point = jnp.where(is_site[:, None], d.site_xpos[sites], point)
        quaternion = jnp.where(is_site[:, None], turned, quaternion)
    spins, _ = find_body_velocities(smooth.tree, smooth.poses, d)
    spin_rates, accelerations = find_accelerations(smooth.tree, smooth.poses, d, np.zeros(3), None)
    lever, spin, spin_rate = point - d.xpos[bodies], spins[bodies], spin_rates[bodies]
    turning = cross_each(spin_rate, lever) + cross_each(spin, cross_each(spin, lever))
    weight = get_number(model, mx, "body_invweight0")[bodies]
    jacobians = find_jacobians(model, d, point, bodies)
    return _Anchors(point, quaternion, *jacobians, accelerations[bodies] + turning, spin, spin_rate, weight)


def _turn_between(first: jax.Array, second: jax.Array, velocity: jax.Array) -> jax.Array:
    """Vector part of p* w q / 2 for the orientations q = `first` and p = `second`."""
    pure = jnp.concatenate([jnp.zeros(1), velocity])
    return 0.5 * multiply(multiply(conjugate(second), pure), first)[1:]


def _differentiate_quaternion(q: jax.Array, spin: jax.Array) -> jax.Array:
    """dq/dt = w q / 2 of an orientation that turns with the angular velocity w of the world."""
    return 0.5 * multiply(jnp.concatenate([jnp.zeros(1), spin]), q)


# --- friction loss and limits -----------------------------------------------------------------------------------------


def _make_friction_loss(model, mx, d, smooth) -> _Raw | None:
    """Dry friction of joints and tendons: any motion is braked, with at most a given force."""
    dofs, tendons = np.flatnonzero(model.dof_frictionloss), np.flatnonzero(model.tendon_frictionloss)
    if is_disabled(model, DISABLED.FRICTIONLOSS) or not dofs.size + tendons.size:
        return None
    loss = jnp.concatenate(
        [get_number(model, mx, "dof_frictionloss")[dofs], get_number(model, mx, "tendon_frictionloss")[tendons]]
    )
    zero = jnp.zeros_like(loss)
    return _Raw(
        jacobian=jnp.concatenate([jnp.eye(model.nv)[dofs], smooth.tendon_jacobian[tendons]]),
        position=zero,
        impedance_position=zero,
        active=np.ones(loss.size, bool),
        weight=jnp.concatenate(
            [get_number(model, mx, "dof_invweight0")[dofs], get_number(model, mx, "tendon_invweight0")[tendons]]
        ),
        solref=jnp.concatenate(
            [get_number(model, mx, "dof_solref")[dofs], get_number(model, mx, "tendon_solref_fri")[tendons]]
        ),
        solimp=jnp.concatenate(
            [get_number(model, mx, "dof_solimp")[dofs], get_number(model, mx, "tendon_solimp_fri")[tendons]]
        ),
        low=-loss,
        high=loss,
        bias=zero,
    )


def _make_joint_limits(model, mx, d, smooth) -> _Raw | None:
    """Hinges and slides stay within their ranges."""
    is_scalar = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
    joints = np.flatnonzero(is_scalar & (model.jnt_limited > 0))
    if is_disabled(model, DISABLED.LIMIT) or not joints.size:
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


def _make_tendon_limits(model, mx, d, smooth) -> _Raw | None:
    """Tendons stay within their range of lengths."""
    tendons = np.flatnonzero(model.tendon_limited)
    if is_disabled(model, DISABLED.LIMIT) or not tendons.size:
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


def _make_limit_rows(position, jacobian, limits, margin, weight, solref, solimp) -> _Raw:
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


def _make_ball_limits(model, mx, d, smooth) -> _Raw | None:
    """Ball joints turn by at most a given angle about any axis."""
    joints = np.flatnonzero((model.jnt_type == mujoco.mjtJoint.mjJNT_BALL) & (model.jnt_limited > 0))
    if is_disabled(model, DISABLED.LIMIT) or not joints.size:
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


def _make_one_sided_rows(jacobian, distance, margin, weight, solref, solimp) -> _Raw:
    """Rows that push a distance out of its margin."""
    position = distance - margin
    return _Raw(
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
