"""Lengths of tendons and actuators, and what they do to the joints."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.dynamics.codes import TRANSMISSION, WRAP
from envs.physics.dynamics.kinematics import (
    add_axes,
    find_accelerations,
    find_body_velocities,
    find_carriers,
    find_jacobians,
)
from envs.physics.dynamics.numbers import SMALL, get_number, is_traced
from envs.physics.dynamics.rotations import (
    contract,
    cross,
    cross_each,
    length,
    multiply,
    normalize,
    rotate,
    rotate_back,
    subtract,
    to_matrix,
    to_rotation_vector,
)
from envs.physics.dynamics.smooth import Smooth
from envs.physics.dynamics.tree import BALL, FREE
from envs.physics.features import wraps_around_geoms

if TYPE_CHECKING:
    from mujoco import mjx


# --- tendons ----------------------------------------------------------------------------------------------------------


def find_tendons(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data):
    """Lengths of the tendons and their derivatives.

    Args:
      model: the model.
      mx: its numbers.
      d: with the poses of bodies, geoms, sites and joints.

    Returns:
      (length [ntendon], J [ntendon, nv]).
    """
    if wraps_around_geoms(model):
        return _find_wrapped(mx, d, model)
    segments = _list_segments(model)
    lengths, rows = _find_segments(model, d, segments) if segments else (None, None)
    result = []
    for tendon in range(model.ntendon):
        if model.wrap_type[model.tendon_adr[tendon]] == WRAP.JOINT:
            result.append(_sum_joints(model, mx, d, tendon))
            continue
        which = [i for i, segment in enumerate(segments) if segment[0] == tendon]
        weight = np.zeros(len(segments))
        weight[which] = [segments[i][3] for i in which]
        result.append((contract(weight, lengths), contract(weight, rows)))
    lengths, rows = zip(*result, strict=True)
    return jnp.stack(lengths), jnp.stack(rows) if is_traced(*rows) else np.stack(rows)


def _find_wrapped(mx: mjx.Model, d: mjx.Data, model):
    """The same by MJX, which needs the velocities' axes about the centres of mass."""
    from envs.physics.models import import_mjx

    d = import_mjx().tendon(mx, add_axes(model, d))
    return d.ten_length, d._impl.ten_J


def _sum_joints(model, mx, d: mjx.Data, tendon: int):
    """A linear combination of joint positions."""
    wraps = np.arange(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    joints, weight = model.wrap_objid[wraps], get_number(model, mx, "wrap_prm")[wraps]
    row = (np.eye(model.nv)[model.jnt_dofadr[joints]] * weight[:, None]).sum(0)
    return (weight * d.qpos[model.jnt_qposadr[joints]]).sum(), row


def _list_segments(model) -> list[tuple[int, int, int, float]]:
    """Straight pieces of the tendons: (tendon, first site, second site, 1 / divisor of the pulley)."""
    segments = []
    for tendon in range(model.ntendon):
        weight, before = 1.0, None
        for wrap in range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon]):
            if model.wrap_type[wrap] == WRAP.PULLEY:
                weight, before = 1.0 / max(SMALL, model.wrap_prm[wrap]), None
            elif model.wrap_type[wrap] == WRAP.SITE:
                site = int(model.wrap_objid[wrap])
                if before is not None:
                    segments.append((tendon, before, site, weight))
                before = site
    return segments


def _find_segments(model, d: mjx.Data, segments):
    """Lengths of the segments [n] and their derivatives [n, nv]."""
    first, second = (np.array([segment[i] for segment in segments]) for i in (1, 2))
    lengths, directions = _find_directions(d, first, second)
    here, there = (find_jacobians(model, d, d.site_xpos[s], model.site_bodyid[s])[0] for s in (first, second))
    rows = ((there - here) * directions[:, None, :]).sum(-1)
    return lengths, jnp.where((model.site_bodyid[first] != model.site_bodyid[second])[:, None], rows, 0.0)


def _find_directions(d: mjx.Data, first, second):
    """Lengths and unit vectors from site to site."""
    difference = d.site_xpos[second] - d.site_xpos[first]
    lengths = length(difference)
    fine = (lengths >= SMALL)[:, None]
    return lengths, jnp.where(fine, difference / jnp.where(fine, lengths[:, None], 1.0), np.array([1.0, 0.0, 0.0]))


def find_tendon_accelerations(model: mujoco.MjModel, d: mjx.Data, velocities, accelerations):
    """dJ/dt qvel: the accelerations of the tendons' lengths for qacc = 0 [ntendon].

    A length between points with relative position r, velocity v and acceleration a has the second derivative
    a u + (v v - (v u)^2) / |r| with u = r / |r|.

    Args:
      model: the model.
      d: with the poses of sites.
      velocities: of the sites [nsite, 3], m/s.
      accelerations: of the sites for qacc = 0 and without gravity [nsite, 3], m/s^2.
    """
    segments = _list_segments(model)
    if not segments:
        return np.zeros(model.ntendon)
    first, second = (np.array([segment[i] for segment in segments]) for i in (1, 2))
    lengths, u = _find_directions(d, first, second)
    v, a = velocities[second] - velocities[first], accelerations[second] - accelerations[first]
    fine = lengths > SMALL
    turning = ((v * v).sum(-1) - (v * u).sum(-1) ** 2) / jnp.where(fine, lengths, 1.0)
    rates = (a * u).sum(-1) + jnp.where(fine, turning, 0.0)
    rates = jnp.where(model.site_bodyid[first] != model.site_bodyid[second], rates, 0.0)
    weight = np.zeros((model.ntendon, len(segments)))
    for i, segment in enumerate(segments):
        weight[segment[0], i] = segment[3]
    return contract(weight, rates)


def find_tendon_pulls(model: mujoco.MjModel, d: mjx.Data, force):
    """Forces of straight tendons on the bodies, and their torques about the world's origin.

    Args:
      model: the model.
      d: with the poses of sites.
      force: by which the tendons would get longer [ntendon], N.

    Returns:
      (force [nbody, 3], torque [nbody, 3]).
    """
    segments = _list_segments(model)
    if not segments:
        return np.zeros((model.nbody, 3)), np.zeros((model.nbody, 3))
    tendon, first, second = (np.array([segment[i] for segment in segments]) for i in (0, 1, 2))
    push = _find_directions(d, first, second)[1] * (force[tendon] * np.array([s[3] for s in segments]))[:, None]
    ends = np.eye(model.nbody)[model.site_bodyid]
    on_sites = [(ends[second], push, d.site_xpos[second]), (ends[first], -push, d.site_xpos[first])]
    forces = sum(contract(end.T, f) for end, f, _ in on_sites)
    return forces, sum(contract(end.T, cross_each(x, f)) for end, f, x in on_sites)


def find_tendon_rates(model: mujoco.MjModel, d: mjx.Data, smooth: Smooth):
    """dJ/dt qvel [ntendon], as `find_tendon_accelerations`, from the motion of the bodies."""
    spin, velocity = find_body_velocities(smooth.tree, smooth.poses, d)
    spin_rate, acceleration = find_accelerations(smooth.tree, smooth.poses, d, np.zeros(3), None)
    body = model.site_bodyid
    arm = d.site_xpos - d.xpos[body]
    turning = cross_each(spin[body], arm)
    acceleration = acceleration[body] + cross_each(spin_rate[body], arm) + cross_each(spin[body], turning)
    return find_tendon_accelerations(model, d, velocity[body] + turning, acceleration)


# --- actuators --------------------------------------------------------------------------------------------------------


def find_transmissions(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, tendon_jacobian):
    """Lengths of the actuators and their derivatives.

    Args:
      model: the model.
      mx: its numbers.
      d: with the poses of bodies, sites and joints and the lengths of tendons.
      tendon_jacobian: derivatives of the tendons' lengths [ntendon, nv].

    Returns:
      (length [nu], moment [nu, nv]); the moment is a numpy array if it is constant.
    """
    gear = get_number(model, mx, "actuator_gear")
    lengths, moments = [], []
    for actuator in range(model.nu):
        kind, (first, _) = model.actuator_trntype[actuator], model.actuator_trnid[actuator]
        if kind in (TRANSMISSION.JOINT, TRANSMISSION.JOINTINPARENT):
            pair = _find_joint(model, d, first, gear[actuator], kind == TRANSMISSION.JOINTINPARENT)
        elif kind == TRANSMISSION.TENDON:
            pair = d.ten_length[first] * gear[actuator, 0], tendon_jacobian[first] * gear[actuator, 0]
        elif kind == TRANSMISSION.SLIDERCRANK:
            pair = _find_slider_crank(model, mx, d, actuator, gear[actuator, 0])
        else:
            pair = _find_site(model, mx, d, actuator, gear[actuator])
        lengths.append(pair[0])
        moments.append(pair[1])
    moment = jnp.stack(moments) if is_traced(*moments) else np.stack(moments)
    return jnp.stack(lengths), moment


def _find_joint(model, d: mjx.Data, joint: int, gear, in_parent: bool):
    """An actuator at a joint: a gear for each of its velocities, in the axes of the child or of the parent."""
    kind, dof, q = model.jnt_type[joint], model.jnt_dofadr[joint], model.jnt_qposadr[joint]
    units = np.eye(model.nv)[dof : dof + {FREE: 6, BALL: 3}.get(int(kind), 1)]
    if kind not in (FREE, BALL):
        return d.qpos[q] * gear[0], units[0] * gear[0]
    quat = normalize(d.qpos[q + 3 * (kind == FREE) : q + 3 * (kind == FREE) + 4])
    turning = gear[3:] if kind == FREE else gear[:3]
    if in_parent:
        turning = rotate_back(to_matrix(quat), turning)
    if kind == FREE:
        return jnp.zeros(()), contract(gear[:3], units[:3]) + contract(turning, units[3:])
    return (to_rotation_vector(quat) * turning).sum(), contract(turning, units)


def _find_slider_crank(model, mx, d: mjx.Data, actuator: int, gear):
    """The slider's length along its axis a to the crank's pin at v: l = a v - sqrt((a v)^2 + r^2 - v v)."""
    crank, slider = model.actuator_trnid[actuator]
    rod = get_number(model, mx, "actuator_cranklength")[actuator]
    axis = d.site_xmat[slider, :, 2]
    v = d.site_xpos[crank] - d.site_xpos[slider]
    along = (axis * v).sum()
    square = along * along + rod * rod - (v * v).sum()
    fine = square > 0
    root = jnp.where(fine, jnp.sqrt(jnp.where(fine, square, 1.0)), 0.0)
    safe = jnp.where(fine, root, 1.0)
    slope = jnp.where(fine, 1.0 - along / safe, 1.0)
    by_point = slope * axis + jnp.where(fine, 1.0 / safe, 0.0) * v
    by_axis = slope * v
    sites = np.array([crank, slider])
    J, J_r = find_jacobians(model, d, d.site_xpos[sites], model.site_bodyid[sites])
    # a turn by w moves the axis by w x a, so by_axis (w x a) = w (a x by_axis)
    moment = contract(J[0] - J[1], by_point) + contract(J_r[1], cross(axis, by_axis))
    return (along - root) * gear, moment * gear


def _find_site(model, mx, d: mjx.Data, actuator: int, gear):
    """A wrench at a site, in its axes or in those of a reference site, relative to which the length is."""
    site, reference = model.actuator_trnid[actuator]
    if reference == -1:
        J, J_r = (x[0] for x in find_jacobians(model, d, d.site_xpos[site][None], model.site_bodyid[site : site + 1]))
        R = d.site_xmat[site]
        return jnp.zeros(()), contract(J, rotate(R, gear[:3])) + contract(J_r, rotate(R, gear[3:]))
    sites = np.array([site, reference])
    J, J_r = find_jacobians(model, d, d.site_xpos[sites], model.site_bodyid[sites])
    R = d.site_xmat[reference]
    kept = ~_common_velocities(model, *model.site_bodyid[sites])
    shift = rotate_back(R, d.site_xpos[site] - d.site_xpos[reference])
    quats = get_number(model, mx, "site_quat")
    # the order of the factors is C MuJoCo's
    turned = [multiply(d.xquat[model.site_bodyid[s]], quats[s]) for s in sites]
    span = (shift * gear[:3]).sum() + (subtract(*turned) * gear[3:]).sum()
    moment = contract(J[0] - J[1], rotate(R, gear[:3])) + contract(J_r[0] - J_r[1], rotate(R, gear[3:]))
    return span, moment * kept


def _common_velocities(model, first: int, second: int) -> np.ndarray:
    """The velocities that move both bodies [nv]."""
    carriers = find_carriers(model)
    return carriers[first] & carriers[second]
