"""Equalities as constraints: points and frames of bodies held together, couplings of joints and of tendons."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.dynamics.codes import DISABLED
from envs.physics.dynamics.forces import is_disabled
from envs.physics.dynamics.kinematics import find_accelerations, find_body_velocities, find_jacobians
from envs.physics.dynamics.numbers import get_number
from envs.physics.dynamics.rotations import conjugate, cross_each, multiply, multiply_each, rotate_each
from envs.physics.dynamics.rows import Raw
from envs.physics.dynamics.smooth import Smooth

if TYPE_CHECKING:
    from mujoco import mjx


def find_equalities(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, smooth: Smooth) -> dict[str, Raw]:
    """The rows of all equalities; arguments as of `constraints.make_rows`."""
    if is_disabled(model, DISABLED.EQUALITY):
        return {}
    makers = {
        "connect": _make_connects,
        "weld": _make_welds,
        "joint": _make_joint_equalities,
        "tendon": _make_tendon_equalities,
    }
    parts = {kind: make(model, mx, d, smooth) for kind, make in makers.items()}
    return {kind: part for kind, part in parts.items() if part is not None}


def _make_connects(model, mx, d, smooth) -> Raw | None:
    """A point of one body stays at a point of another: the difference of the two points is 0."""
    ids = find_numbers(model, "connect")
    if not ids.size:
        return None
    one, other = (_find_anchors(model, mx, d, smooth, "connect", side) for side in (0, 1))
    return _make_rows(
        model,
        mx,
        d,
        ids,
        jacobian=(one.translation - other.translation).swapaxes(1, 2),
        position=one.point - other.point,
        weight=jnp.repeat(one.weight[:, :1] + other.weight[:, :1], 3, axis=1),
        bias=one.acceleration - other.acceleration,
    )


def _make_welds(model, mx, d, smooth) -> Raw | None:
    """A frame of one body stays at a frame of another: the rotation between them, too, is as given.

    The rotational error is the vector part of the quaternion q = p* q1, where q1 is the orientation of the first body
    as it should be for the second one, and p that of the second. With angular velocities w1 and w2, its rate is the
    vector part of p* (w1 - w2) q1 / 2.
    """
    ids = find_numbers(model, "weld")
    if not ids.size:
        return None
    one, other = (_find_anchors(model, mx, d, smooth, "weld", side) for side in (0, 1))
    scale = get_number(model, mx, "eq_data")[ids, 10:11]
    first = turn_as_wanted(model, mx, one.quaternion)

    def turn(first, second, velocity):
        return jax.vmap(_turn_between)(first, second, velocity)

    axes = jnp.moveaxis(one.rotation - other.rotation, 1, 0)
    turning = jnp.moveaxis(jax.vmap(turn, (None, None, 0))(first, other.quaternion, axes), 0, 2)
    rates = [jax.vmap(_differentiate_quaternion)(q, w) for q, w in ((first, one.spin), (other.quaternion, other.spin))]
    point = (first, other.quaternion, one.spin - other.spin)
    _, turning_bias = jax.jvp(turn, point, (*rates, one.spin_rate - other.spin_rate))
    error = jax.vmap(lambda q, p: multiply(conjugate(p), q)[1:])(first, other.quaternion)
    return _make_rows(
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


def _make_joint_equalities(model, mx, d, smooth) -> Raw | None:
    """The position of one joint is a polynomial of another's, or constant: y - y0 = p(x - x0)."""
    ids = find_numbers(model, "joint")
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


def _make_tendon_equalities(model, mx, d, smooth) -> Raw | None:
    """The length of one tendon is a polynomial of another's, or constant."""
    ids = find_numbers(model, "tendon")
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


def find_numbers(model: mujoco.MjModel, kind: str) -> np.ndarray:
    """The numbers of the equalities of a kind: "connect", "weld", "joint" or "tendon"."""
    return np.flatnonzero(model.eq_type == getattr(mujoco.mjtEq, f"mjEQ_{kind.upper()}"))


def _make_coupling_rows(model, mx, d, ids, has_second, positions, jacobians, weights) -> Raw:
    """Rows of y = p(x): y - p(x), with Jacobian dy - p'(x) dx; without a second element x = 0."""
    y, x = positions[0], positions[1] * has_second
    coefficients = get_number(model, mx, "eq_data")[ids, :5]
    powers = jnp.stack([jnp.ones_like(x), x, x**2, x**3, x**4], axis=1)
    slope = jnp.sum(coefficients[:, 1:] * powers[:, :4] * np.arange(1.0, 5.0), axis=1) * has_second
    position = y - jnp.sum(coefficients * powers, axis=1)
    jacobian = jacobians[0] - slope[:, None] * jacobians[1]
    weight = weights[0] + weights[1] * has_second
    zero = jnp.zeros_like(position)
    return _make_rows(model, mx, d, ids, jacobian[:, None], position[:, None], weight[:, None], zero[:, None])


def _make_rows(model, mx, d, ids, jacobian, position, weight, bias) -> Raw:
    """Rows of n equalities with k rows each, `[n, k, ...]`; which pull in both directions."""
    size = position.shape[1]
    violation = jnp.sqrt(jnp.sum(position**2, axis=1)) if size > 1 else position[:, 0]
    repeat = lambda x: jnp.repeat(x, size, axis=0)  # noqa: E731
    unbounded = np.full(position.size, np.inf)
    return Raw(
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


def place_anchors(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, kind: str, side: int) -> tuple:
    """(bodies, positions, orientations) of the first (0) or second (1) points of all equalities of a kind.

    They are sites, or points in the frames of bodies.
    """
    ids = find_numbers(model, kind)
    objects, is_site = (model.eq_obj1id, model.eq_obj2id)[side][ids], _are_of_sites(model, ids)
    sites = np.where(is_site, objects, 0)
    bodies = np.where(is_site, model.site_bodyid[sites], objects) if model.nsite else objects
    begin = 3 * (side if kind == "connect" else 1 - side)  # in eq_data
    local_points = get_number(model, mx, "eq_data")[ids, begin : begin + 3]
    point = d.xpos[bodies] + rotate_each(d.xmat[bodies], local_points)
    quaternion = d.xquat[bodies]
    if is_site.any():
        turned = multiply_each(quaternion, get_number(model, mx, "site_quat")[sites])
        point = jnp.where(is_site[:, None], d.site_xpos[sites], point)
        quaternion = jnp.where(is_site[:, None], turned, quaternion)
    return bodies, point, quaternion


def turn_as_wanted(model: mujoco.MjModel, mx: mjx.Model, quaternion: jax.Array) -> jax.Array:
    """The orientations of the first points of all welds as they should be for the second ones, `[n, 4]`."""
    ids = find_numbers(model, "weld")
    given = get_number(model, mx, "eq_data")[ids, 6:10]
    wanted = jnp.where(_are_of_sites(model, ids)[:, None], jnp.array([1.0, 0, 0, 0]), given)
    return multiply_each(quaternion, wanted)


def _are_of_sites(model, ids: np.ndarray) -> np.ndarray:
    return model.eq_objtype[ids] == mujoco.mjtObj.mjOBJ_SITE


def _find_anchors(model, mx, d, smooth, kind: str, side: int) -> _Anchors:
    """The points of `place_anchors`, with how they move."""
    bodies, point, quaternion = place_anchors(model, mx, d, kind, side)
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
