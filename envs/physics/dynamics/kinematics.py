"""Positions and velocities of bodies, geoms, sites and joints in the world, and Jacobians of points."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.dynamics.newton_euler import find_motions
from envs.physics.dynamics.numbers import SMALL, get_number, is_traced, module_of
from envs.physics.dynamics.rotations import (
    IDENTITY,
    contract,
    cross,
    cross_each,
    multiply,
    multiply_each,
    normalize,
    rotate,
    rotate_back,
    rotate_each,
    to_matrices,
    turn,
)
from envs.physics.dynamics.tree import BALL, FREE, HINGE, SLIDE, WORLD, Tree
from envs.physics.models import import_mjx

if TYPE_CHECKING:
    from mujoco import mjx


def place_bodies(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, tree: Tree, poses: list[tuple]) -> mjx.Data:
    """The data with the poses of bodies, their centres of mass, geoms, sites and joints in the world.

    Sets xpos, xquat, xmat, xipos, ximat, xanchor, xaxis, geom_xpos, geom_xmat, site_xpos, site_xmat and subtree_com.
    """
    get = functools.partial(get_number, model, mx)
    axes, points = _place_links(tree, poses)
    links = np.array([place.link + 1 for place in tree.places])
    rotation, point = (_stack([getattr(place, name) for place in tree.places]) for name in ("rotation", "point"))
    xmat = jnp.matmul(axes[links], rotation)
    xpos = points[links] + rotate_each(axes[links], point)
    d = d.replace(xpos=xpos, xmat=xmat, xquat=_turn_bodies(tree, d.qpos, get("qpos0")))
    xipos, ximat = _attach(xpos, xmat, get("body_ipos"), get("body_iquat"))
    d = d.replace(xipos=xipos, ximat=ximat, subtree_com=_find_centers(model, get("body_mass"), xipos))
    if model.ngeom:
        bodies = model.geom_bodyid
        pos, mat = _attach(xpos[bodies], xmat[bodies], get("geom_pos"), get("geom_quat"))
        d = d.replace(geom_xpos=pos, geom_xmat=mat)
    if model.nsite:
        bodies = model.site_bodyid
        pos, mat = _attach(xpos[bodies], xmat[bodies], get("site_pos"), get("site_quat"))
        d = d.replace(site_xpos=pos, site_xmat=mat)
    return _place_joints(model, d, tree, axes, points, get("qpos0"), get("jnt_pos")) if model.njnt else d


def _place_links(tree: Tree, poses: list[tuple]):
    """Axes [1 + links, 3, 3] and origins [1 + links, 3] of the world and the links in the world."""
    axes: list[Any] = [np.eye(3)]
    points: list[Any] = [np.zeros(3)]
    for link, (R, p) in zip(tree.links, poses, strict=True):
        before = link.parent + 1
        axes.append(contract(axes[before], R))
        points.append(points[before] + rotate(axes[before], p))
    return _stack(axes), _stack(points)


def _stack(arrays):
    return jnp.stack(arrays) if is_traced(*arrays) else np.stack(arrays)


def _attach(xpos, xmat, pos, quat):
    """Positions and axes of frames that are attached to bodies."""
    return xpos + rotate_each(xmat, pos), jnp.matmul(xmat, to_matrices(quat))


def _turn_bodies(tree: Tree, qpos, qpos0):
    """The orientations of the bodies as quaternions [nbody, 4]."""
    quats: list[Any] = [IDENTITY]
    for link in tree.links:
        if link.kind in (FREE, BALL):
            begin = link.qpos + 3 * (link.kind == FREE)
            own = normalize(qpos[begin : begin + 4])
        else:
            own = turn(link.axis, qpos[link.qpos] - qpos0[link.qpos]) if link.kind == HINGE else IDENTITY
        before = multiply(quats[link.parent + 1], link.quaternion)
        quats.append(multiply(before, own))
    links = _stack(quats)[np.array([place.link + 1 for place in tree.places])]
    return multiply_each(links, _stack([place.quaternion for place in tree.places]))


def _find_centers(model, mass, xipos):
    """Centres of mass of all that each body carries, or the body's own if that has no mass."""
    xp = module_of(mass)
    weight = find_carried(model) * mass
    total = weight.sum(-1)
    heavy = total >= SMALL
    share = weight / xp.where(heavy, total, 1.0)[:, None]
    return contract(xp.where(heavy[:, None], share, np.eye(model.nbody)), xipos)


def find_carried(model: mujoco.MjModel) -> np.ndarray:
    """Which bodies a body carries, itself included [nbody, nbody]."""
    carried = np.eye(model.nbody, dtype=bool)
    for body in reversed(range(1, model.nbody)):
        carried[model.body_parentid[body]] |= carried[body]
    return carried


def _place_joints(model, d, tree: Tree, axes, points, qpos0, pos):
    """The data with the joints' anchors and axes in the world; a ball's axis does not turn with it."""
    moved = np.arange(1, len(tree.links) + 1)
    local = _stack([link.axis for link in tree.links])
    axis = rotate_each(axes[moved], local)
    if (model.jnt_type == BALL).any():
        before = np.array([link.parent + 1 for link in tree.links])
        still = rotate_each(jnp.matmul(axes[before], _stack([link.rotation for link in tree.links])), local)
        axis = jnp.where((model.jnt_type == BALL)[:, None], still, axis)
    axis = jnp.where((model.jnt_type == FREE)[:, None], local, axis)
    anchor = points[moved]
    slides = model.jnt_type == SLIDE
    if slides.any():  # the anchor of a slide stays where it was before the slide moved
        shift = d.qpos[model.jnt_qposadr] - qpos0[model.jnt_qposadr]
        here = anchor + rotate_each(axes[moved], pos) - axis * shift[:, None]
        anchor = jnp.where(slides[:, None], here, anchor)
    return d.replace(xanchor=anchor, xaxis=axis)


# --- velocities and Jacobians -----------------------------------------------------------------------------------------


class JointAxes(NamedTuple):
    """How each velocity moves what it carries: a point x by qvel (direction + axis x (x - anchor)), turning by axis.

    Attributes:
      axis: [nv, 3].
      direction: [nv, 3].
      anchor: [nv, 3], m.
    """

    axis: Any
    direction: Any
    anchor: Any


def find_joint_axes(model: mujoco.MjModel, d: mjx.Data) -> JointAxes:
    """The axes of all velocities in the world, from the poses of bodies and joints in the data."""
    joint = model.dof_jntid
    kind, number = model.jnt_type[joint], np.arange(model.nv) - model.jnt_dofadr[joint]
    turns = (kind == BALL) | ((kind == FREE) & (number >= 3))
    axis = jnp.where((kind == HINGE)[:, None], d.xaxis[joint], 0.0)
    if turns.any():
        columns = d.xmat[model.dof_bodyid, :, number % 3]
        axis = jnp.where(turns[:, None], columns, axis)
    direction = jnp.where((kind == SLIDE)[:, None], d.xaxis[joint], 0.0)
    free = (kind == FREE) & (number < 3)
    direction = jnp.where(free[:, None], np.eye(3)[number % 3], direction)
    return JointAxes(axis, direction, d.xanchor[joint])


def find_carriers(model: mujoco.MjModel) -> np.ndarray:
    """Which velocities move which body [nbody, nv]."""
    carriers = np.zeros((model.nbody, model.nv), bool)
    for body in range(1, model.nbody):
        carriers[body] = carriers[model.body_parentid[body]]
        begin = model.body_dofadr[body]
        carriers[body, begin : begin + model.body_dofnum[body]] = begin >= 0
    return carriers


def find_jacobians(model: mujoco.MjModel, d: mjx.Data, points, bodies, axes: JointAxes | None = None):
    """Jacobians of points on bodies: velocity = J' qvel, angular velocity = J_r' qvel.

    Args:
      model: the model.
      d: with the poses of bodies and joints.
      points: in the world [n, 3], m.
      bodies: the bodies that they move with, numbers known when tracing [n].
      axes: of all velocities, if they are at hand.

    Returns:
      (J [n, nv, 3], J_r [n, nv, 3]).
    """
    axes = find_joint_axes(model, d) if axes is None else axes
    moved = find_carriers(model)[np.asarray(bodies)][:, :, None]
    arms = points[:, None, :] - axes.anchor
    jacobian = jnp.where(moved, axes.direction + cross_each(axes.axis, arms), 0.0)
    return jacobian, jnp.where(moved, axes.axis, 0.0)


def find_velocities(tree: Tree, poses: list[tuple], qvel) -> list[tuple]:
    """Angular velocity and velocity of the origin of each link, in its own axes."""
    velocities = []
    for link, (R, p) in zip(tree.links, poses, strict=True):
        own = qvel[link.dofs]
        if link.kind == FREE:
            velocities.append((own[3:], rotate_back(R, own[:3])))
            continue
        spin, velocity = (np.zeros(3), np.zeros(3)) if link.parent == WORLD else velocities[link.parent]
        spin, velocity = rotate_back(R, spin), rotate_back(R, velocity + cross(spin, p))
        if link.kind == SLIDE:
            velocity = velocity + link.axis * own
        else:
            spin = spin + (link.axis * own if link.kind == HINGE else own)
        velocities.append((spin, velocity))
    return velocities


def find_body_velocities(tree: Tree, poses: list[tuple], d: mjx.Data):
    """Angular velocities and velocities of the bodies' origins in the world, (omega [nbody, 3], v [nbody, 3])."""
    velocities = [(np.zeros(3), np.zeros(3)), *find_velocities(tree, poses, d.qvel)]
    links = np.array([place.link + 1 for place in tree.places])
    spin, velocity = (_stack(parts)[links] for parts in zip(*velocities, strict=True))
    rotation, point = (_stack([getattr(place, name) for place in tree.places]) for name in ("rotation", "point"))
    velocity = velocity + cross_each(spin, point)
    # into the body's axes and from there into the world's
    axes = jnp.matmul(d.xmat, rotation.swapaxes(-1, -2))
    return rotate_each(axes, spin), rotate_each(axes, velocity)


def add_axes(model: mujoco.MjModel, d: mjx.Data) -> mjx.Data:
    """The data with cdof, the velocities' axes about the centres of mass of the trees, which MJX's functions need."""
    axes, center = find_joint_axes(model, d), d.subtree_com[model.body_rootid[model.dof_bodyid]]
    moves = axes.direction + cross_each(axes.axis, center - axes.anchor)
    return d.replace(cdof=jnp.concatenate([axes.axis, moves], 1))


def add_fields(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, tree: Tree, poses: list[tuple], names) -> mjx.Data:
    """The data with those fields that are named and that no force needs: of cameras, velocities and Jacobians."""
    d = add_axes(model, d) if {"cdof", "cdof_dot"} & set(names) else d
    if "cvel" in names:
        center = d.subtree_com[model.body_rootid]
        spin, velocity = find_body_velocities(tree, poses, d)
        d = d.replace(cvel=jnp.concatenate([spin, velocity + cross_each(spin, center - d.xpos)], 1))
    if {"cam_xpos", "cam_xmat"} & set(names):
        other = import_mjx().camlight(mx, d)
        d = d.replace(cam_xpos=other.cam_xpos, cam_xmat=other.cam_xmat)
    if "cdof_dot" in names:
        d = d.replace(cdof_dot=import_mjx().com_vel(mx, d).cdof_dot)
    frames = {"site": (d.site_xpos, model.site_bodyid), "body": (d.xpos, np.arange(model.nbody))}
    for kind, (points, bodies) in frames.items():
        if {f"{kind}_jacp", f"{kind}_jacr"} & set(names):
            jacobians = (J.swapaxes(1, 2) for J in find_jacobians(model, d, points, bodies))
            d = d.replace(**dict(zip((f"{kind}_jacp", f"{kind}_jacr"), jacobians, strict=True)))
    return d


def find_accelerations(tree: Tree, poses: list[tuple], d: mjx.Data, gravity, qacc):
    """Angular accelerations, and accelerations of the bodies' origins less gravity, in the world.

    Args:
      tree: the links.
      poses: their poses relative to their parents.
      d: with xmat and qvel.
      gravity: [3], m/s^2.
      qacc: [nv], or None for 0.

    Returns:
      (angular [nbody, 3], linear [nbody, 3]).
    """
    motions = find_motions(tree, poses, d.qvel, gravity, qacc)
    links = np.array([place.link + 1 for place in tree.places])
    rotation, point = (_stack([getattr(place, name) for place in tree.places]) for name in ("rotation", "point"))
    spin_rate = _stack([np.zeros(3), *(x.spin_rate for x in motions)])[links]
    turning = _stack([np.zeros((3, 3)), *(x.turning for x in motions)])[links]
    acceleration = _stack([-gravity, *(x.acceleration for x in motions)])[links] + rotate_each(turning, point)
    axes = jnp.matmul(d.xmat, rotation.swapaxes(-1, -2))
    return rotate_each(axes, spin_rate), rotate_each(axes, acceleration)
