"""Mass matrix and bias force, by recursions over the links in the links' own frames.

There most of what connects two links is constant, and many of the products are with 0 or 1. With the first and second
moments h = integral of r dm and S = integral of r r' dm, a link whose origin accelerates by a and whose points r by
a + U r, U = [alpha x] + [omega x]^2, needs the force m a + U h and the torque h x a + integral of r x U r dm, which is
linear in U and in S.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from envs.physics.dynamics.numbers import is_zero
from envs.physics.dynamics.rotations import (
    LEVI_CIVITA,
    contract,
    cross,
    normalize,
    outer,
    rotate,
    rotate_back,
    skew,
    to_matrix,
)
from envs.physics.dynamics.tree import BALL, DOFS, FREE, HINGE, SLIDE, WORLD, Link, Tree


def find_poses(tree: Tree, qpos, qpos0) -> list[tuple]:
    """Axes and origin of each link in the frame of its parent, (R [3, 3], p [3])."""
    poses = []
    for link in tree.links:
        q = qpos[link.qpos]
        if link.kind == FREE:
            pose = to_matrix(normalize(qpos[link.qpos + 3 : link.qpos + 7])), qpos[link.qpos : link.qpos + 3]
        elif link.kind == BALL:
            pose = contract(link.rotation, to_matrix(normalize(qpos[link.qpos : link.qpos + 4]))), link.point
        elif link.kind == SLIDE:
            pose = link.rotation, link.point + rotate(link.rotation, link.axis) * (q - qpos0[link.qpos])
        else:
            pose = _turn(link, q - qpos0[link.qpos]), link.point
        poses.append(pose)
    return poses


def _turn(link: Link, angle):
    """R_0 R(angle), R(angle) = a a' + cos(angle) (1 - a a') + sin(angle) [a x]."""
    along = outer(link.axis, link.axis)
    still, cosine, sine = (contract(link.rotation, part) for part in (along, np.eye(3) - along, skew(link.axis)))
    return still + jnp.cos(angle) * cosine + jnp.sin(angle) * sine


# --- bias force -------------------------------------------------------------------------------------------------------


def find_bias(tree: Tree, poses: list[tuple], qvel, gravity, compensated: bool = False, qacc=None):
    """The force that makes an acceleration, without armature: the recursive Newton-Euler method.

    Args:
      tree: the links.
      poses: their poses relative to their parents.
      qvel: velocities [nv].
      gravity: acceleration [3], m/s^2.
      compensated: whether the bodies' gravity compensation is taken off.
      qacc: the acceleration [nv]; None for 0.

    Returns:
      M qacc + qfrc_bias [nv].
    """
    motions = find_motions(tree, poses, qvel, np.zeros(3) if compensated else gravity, qacc)
    forces = [find_force(link, x.turning, x.acceleration) for link, x in zip(tree.links, motions, strict=True)]
    if compensated:
        forces = _add_weights(tree, poses, forces, gravity)
    bias = {}
    for i, link in reversed(list(enumerate(tree.links))):
        (R, p), (force, torque) = poses[i], forces[i]
        bias[link.dof] = _project(link, R, force, torque)
        if link.parent != WORLD:
            force = rotate(R, force)
            torque = rotate(R, torque) + cross(p, force)
            forces[link.parent] = forces[link.parent][0] + force, forces[link.parent][1] + torque
    return jnp.concatenate([jnp.atleast_1d(bias[dof]) for dof in sorted(bias)])


def _add_weights(tree: Tree, poses: list[tuple], forces, gravity):
    """The forces with those against the weight that is not compensated."""
    downs, result = [], []
    for link, (R, _), (force, torque) in zip(tree.links, poses, forces, strict=True):
        downs.append(rotate_back(R, gravity if link.parent == WORLD else downs[link.parent]))
        result.append((force - link.weight * downs[-1], torque - cross(link.weight_moment, downs[-1])))
    return result


class Motion(NamedTuple):
    """How a link moves, in its own axes.

    Attributes:
      spin: angular velocity [3], rad/s.
      spin_rate: angular acceleration [3], rad/s^2.
      turning: U = [spin_rate x] + [spin x]^2: a point r of the link accelerates by U r relative to the origin [3, 3].
      acceleration: of the origin, less gravity [3], m/s^2.
    """

    spin: Any
    spin_rate: Any
    turning: Any
    acceleration: Any


def find_motions(tree: Tree, poses: list[tuple], qvel, gravity, qacc=None) -> list[Motion]:
    """The velocities and accelerations of the links for these velocities and accelerations [nv] (qacc = 0 if None)."""
    still = Motion(np.zeros(3), np.zeros(3), np.zeros((3, 3)), -gravity)
    motions = []
    for link, pose in zip(tree.links, poses, strict=True):
        before = still if link.parent == WORLD else motions[link.parent]
        own = np.zeros(DOFS[link.kind]) if qacc is None else qacc[link.dofs]
        motions.append(_move(link, pose, before, qvel[link.dofs], own))
    return motions


def _move(link: Link, pose, before: Motion, qvel, qacc) -> Motion:
    R, p = pose
    if link.kind == FREE:
        spin, spin_rate, acceleration = qvel[3:], qacc[3:], rotate_back(R, before.acceleration + qacc[:3])
    else:
        spin, spin_rate = rotate_back(R, before.spin), rotate_back(R, before.spin_rate)
        acceleration = rotate_back(R, before.acceleration + rotate(before.turning, p))
    if link.kind == HINGE:
        spin_rate = spin_rate - cross(link.axis, spin) * qvel + link.axis * qacc
        spin = spin + link.axis * qvel
    elif link.kind == SLIDE:
        acceleration = acceleration - 2.0 * cross(link.axis, spin) * qvel + link.axis * qacc
    elif link.kind == BALL:
        spin_rate = spin_rate + cross(spin, qvel) + qacc
        spin = spin + qvel
    turn = skew(spin)
    return Motion(spin, spin_rate, skew(spin_rate) + contract(turn, turn), acceleration)


def find_force(link: Link, turning, acceleration):
    """Force and torque that a link needs for a motion: m a + U h, h x a + integral of r x U r dm."""
    # (integral of r x U r dm)_i = sum_jkl e_ijk U_kl S_lj
    table = contract(LEVI_CIVITA.transpose(0, 2, 1), link.second).reshape(3, 9)
    force = link.mass * acceleration + rotate(turning, link.moment)
    return force, cross(link.moment, acceleration) + contract(table, turning.reshape(9))


def _project(link: Link, R, force, torque):
    """The part of forces and torques on a link that acts on its joint, [dofs, ...]."""
    if link.kind == HINGE:
        return contract(link.axis[None], torque)
    if link.kind == SLIDE:
        return contract(link.axis[None], force)
    return torque if link.kind == BALL else jnp.concatenate([rotate(R, force), torque])


# --- mass matrix ------------------------------------------------------------------------------------------------------


def find_mass_matrix(tree: Tree, poses: list[tuple], nv: int):
    """The mass matrix without armature, by the inertia of each link with all that it carries.

    Args:
      tree: the links.
      poses: their poses relative to their parents.
      nv: number of velocities.

    Returns:
      M [nv, nv].
    """
    carried = [(link.mass, link.moment, link.second) for link in tree.links]
    columns = [[] for _ in tree.links]  # for each link: (dofs, force, torque) of all that it carries
    places = np.full((nv, nv), -1)
    blocks, size = [], 0
    for i, link in reversed(list(enumerate(tree.links))):
        (R, p), (mass, moment, second) = poses[i], carried[i]
        own, force, torque = _find_own(link, R, mass, moment, second)
        rest = _join(columns[i])
        block = own
        dofs = np.arange(link.dofs.start, link.dofs.stop)
        if rest:
            block = jnp.concatenate([own, _project(link, R, *rest[1:])], 1)
        which = np.concatenate([dofs, rest[0]]) if rest else dofs
        number = size + np.arange(len(dofs) * len(which)).reshape(len(dofs), len(which))
        places[np.ix_(dofs, which)], places[np.ix_(which, dofs)] = number, number.T
        blocks.append(block.reshape(-1))
        size += number.size
        if link.parent == WORLD:
            continue
        carried[link.parent] = _carry(carried[link.parent], mass, moment, second, R, p)
        if rest:
            force, torque = jnp.concatenate([force, rest[1]], 1), jnp.concatenate([torque, rest[2]], 1)
        force = contract(R, force)
        torque = contract(R, torque) + contract(skew(p), force)
        columns[link.parent].append((which, force, torque))
    return jnp.concatenate([*blocks, jnp.zeros(1)])[places]


def _join(columns):
    """One (dofs, force, torque) of several."""
    if not columns:
        return ()
    dofs, forces, torques = zip(*columns, strict=True)
    if len(dofs) == 1:
        return columns[0]
    return np.concatenate(dofs), jnp.concatenate(forces, 1), jnp.concatenate(torques, 1)


def _find_own(link: Link, R, mass, moment, second):
    """M of the joint's own velocities, and the forces and torques for unit accelerations [3, dofs]."""
    axes = np.eye(3) if link.kind in (BALL, FREE) else link.axis[:, None]
    if link.kind == SLIDE:
        force, torque = mass * axes, -contract(skew(link.axis), moment)[:, None]
        return contract(link.axis[None], force), force, torque
    # the inertia tr(S) 1 - S times the axes, with the upper triangle of S only
    force = -contract(skew(moment), axes)
    torque = contract(_inertia_table(axes), second.reshape(9)).reshape(axes.shape)
    if link.kind != FREE:
        return contract(axes.T, torque), force, torque
    mixed = contract(R, force)
    mass = jnp.broadcast_to(mass, 3) * np.eye(3)
    return jnp.block([[mass, mixed], [mixed.T, torque]]), force, torque


def _inertia_table(axes):
    """T with ((tr(S) 1 - S) axes)_ic = sum_kl T_ickl S_kl for k <= l, as a matrix [3 c, 9]."""
    unit = np.eye(3)
    table = np.einsum("kl,ij->ijkl", unit, unit) - np.einsum("ik,jl->ijkl", unit, unit)
    table = np.triu(table + np.triu(table.swapaxes(-1, -2), 1) * 1.0)
    table = np.moveaxis(table, 1, -1).reshape(-1, 3)  # [i k l, j]
    return contract(table, axes).reshape(3, 3, 3, -1).transpose(0, 3, 1, 2).reshape(-1, 9)


def _carry(carrier, mass, moment, second, R, p):
    """The moments of a link together with those of one that it carries."""
    moment, mixed = rotate(R, moment), 0.0
    if not is_zero(p):
        mixed = outer(p, moment)
        mixed = mixed + mixed.T + mass * outer(p, p)
    turned = contract(contract(R, second), R.T)
    return carrier[0] + mass, carrier[1] + moment + mass * p, carrier[2] + turned + mixed
