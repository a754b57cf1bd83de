"""Contacts as constraints: Jacobians by spatial vectors, and the convex functions of the friction cones.

A contact of dimension k acts on u = J a - r with k components: the relative acceleration of the two bodies at the
contact along the normal, along two tangents (k >= 3), and their relative angular acceleration about the normal (k >= 4)
and about the tangents (k = 6).

The acceleration of a body, as a spatial vector, is the sum of what the degrees of freedom on its path to the world
contribute, and a force on the body acts on the same degrees of freedom. So products with J and J' need one pass over
the tree of bodies each, and contacts with fixed bodies enter the Hessian in the way in which inertia enters the mass
matrix: as spatial matrices `[6, 6]`, summed up the tree.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.dynamics.cones import Cone, Ellipse, Pyramid
from envs.physics.dynamics.constraints import find_impedance, find_regularization
from envs.physics.dynamics.kinematics import find_joint_axes
from envs.physics.dynamics.numbers import get_number
from envs.physics.dynamics.rotations import cross_each
from envs.physics.dynamics.shapes import PAIRS, Shape
from envs.physics.dynamics.sums import BodySums
from envs.physics.pairs import Pair, get_shapes

if TYPE_CHECKING:
    from mujoco import mjx


class Contact(NamedTuple):
    """n possible contacts of the same dimension.

    Attributes:
      first, second: the bodies, as numbers known when tracing, `[n]`.
      distance: of the surfaces, negative inside, `[n]`.
      position: the point halfway between the surfaces, `[n, 3]`.
      frame: rows are the normal, from the first body to the second, and two tangents, `[n, 3, 3]`.
      margin: distance below which the contact acts, `[n]`.
      friction: sliding along two tangents, torsion, rolling about two tangents, `[n, 5]`.
      solref, solreffriction, solimp: MuJoCo's parameters, `[n, 2]`, `[n, 2]`, `[n, 5]`.
    """

    first: np.ndarray
    second: np.ndarray
    distance: jax.Array
    position: jax.Array
    frame: jax.Array
    margin: jax.Array
    friction: jax.Array
    solref: jax.Array
    solreffriction: jax.Array
    solimp: jax.Array


# --- finding contacts -------------------------------------------------------------------------------------------------


def find_contacts(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, pairs: Sequence[Pair]) -> dict[int, Contact]:
    """The possible contacts of the candidate pairs, by dimension."""
    groups: dict[tuple, list[Pair]] = {}
    for pair in pairs:
        groups.setdefault((pair.condim, *get_shapes(model, pair)), []).append(pair)
    found: dict[int, list[Contact]] = {}
    for (condim, *shapes), group in groups.items():
        found.setdefault(condim, []).append(_collide(model, mx, d, tuple(shapes), group))
    return {condim: _concatenate(parts) for condim, parts in sorted(found.items())}


def _collide(model, mx, d, shapes: tuple[str, str], pairs: list[Pair]) -> Contact:
    """The contacts of pairs of the same shapes; a pair may touch at several points."""
    ids = np.array([(pair.geom1, pair.geom2) for pair in pairs]).T
    parts = [_mix_parameters(model, mx, pair) for pair in pairs]
    margin, gap, *parameters = (jnp.stack(column) for column in zip(*parts, strict=True))
    one, other = (Shape(d.geom_xpos[i], d.geom_xmat[i], get_number(model, mx, "geom_size")[i]) for i in ids)
    distance, position, frame = jax.vmap(PAIRS[shapes])(one, other, margin)
    number = distance.shape[1]
    first, second = (np.repeat(model.geom_bodyid[i], number) for i in ids)
    flat = (x.reshape(-1, *x.shape[2:]) for x in (distance, position, frame))
    return Contact(first, second, *flat, *(jnp.repeat(x, number, axis=0) for x in (margin - gap, *parameters)))


def _concatenate(parts: list[Contact]) -> Contact:
    first, second, *others = zip(*parts, strict=True)
    return Contact(np.concatenate(first), np.concatenate(second), *map(jnp.concatenate, others))


def _mix_parameters(model: mujoco.MjModel, mx: mjx.Model, pair: Pair) -> tuple:
    """(margin, gap, friction, solref, solreffriction, solimp) of a pair: its own, or mixed from those of the geoms."""
    if pair.index >= 0:
        names = ("margin", "gap", "friction", "solref", "solreffriction", "solimp")
        margin, gap, friction, *others = (get_number(model, mx, f"pair_{name}")[pair.index] for name in names)
        return margin, gap, jnp.maximum(friction, mujoco.mjMINMU), *others
    geoms = np.array([pair.geom1, pair.geom2])
    priority = model.geom_priority[geoms]
    if priority[0] != priority[1]:
        geoms = np.repeat(geoms[np.argmax(priority)], 2)
    share = _find_share(*get_number(model, mx, "geom_solmix")[geoms])
    friction = jnp.max(get_number(model, mx, "geom_friction")[geoms], axis=0)
    solref, solimp = get_number(model, mx, "geom_solref")[geoms], get_number(model, mx, "geom_solimp")[geoms]
    is_standard = (solref[:, 0] > 0).all()
    mixed = share * solref[0] + (1 - share) * solref[1]
    ids = np.array([pair.geom1, pair.geom2])
    return (
        jnp.sum(get_number(model, mx, "geom_margin")[ids]),
        jnp.sum(get_number(model, mx, "geom_gap")[ids]),
        jnp.maximum(friction[np.array([0, 0, 1, 2, 2])], mujoco.mjMINMU),
        jnp.where(is_standard, mixed, jnp.min(solref, axis=0)),
        jnp.zeros(2),
        share * solimp[0] + (1 - share) * solimp[1],
    )


def _find_share(first: jax.Array, second: jax.Array) -> jax.Array:
    """The share of the first geom in mixed parameters, by the weights of both."""
    low = mujoco.mjMINVAL
    share = first / jnp.maximum(first + second, low)
    share = jnp.where((first < low) & (second < low), 0.5, share)
    return jnp.where((first < low) & (second >= low), 0.0, jnp.where((first >= low) & (second < low), 1.0, share))


# --- contacts as constraints ------------------------------------------------------------------------------------------


class ContactRows(NamedTuple):
    """Contacts of the same dimension k, n of them, as a group of constraints.

    Attributes:
      tree: the tree of bodies.
      motion: spatial velocity (angular, linear) per velocity of each degree of freedom, `[nv, 6]`.
      first, second: the bodies, `[n]`.
      arms: components of u per relative spatial acceleration of the second body, `[n, k, 6]`.
      reference: r, `[n, k]`.
      cone: the convex function s of each contact.
    """

    tree: BodySums
    motion: jax.Array
    first: np.ndarray
    second: np.ndarray
    arms: jax.Array
    reference: jax.Array
    cone: Cone

    def apply(self, velocity: jax.Array) -> jax.Array:
        """J v, `[n, k]`."""
        return _find_relative(self.tree, self.motion, self.first, self.second, self.arms, velocity)

    def pull(self, forces: jax.Array) -> jax.Array:
        """J' w, `[nv]`."""
        wrenches = jnp.einsum("nki,nk->ni", self.arms, forces)
        bodies = np.arange(len(self.tree.parent))[:, None]
        incidence = (self.second == bodies).astype(float) - (self.first == bodies)
        total = self.tree.sum_subtrees(incidence @ wrenches)
        return jnp.sum(self.motion * (self.tree.has.T @ total), axis=1)

    def value(self, u: jax.Array) -> jax.Array:
        """s(u), summed over all contacts."""
        return jnp.sum(jax.vmap(type(self.cone).value)(self.cone, u))

    def slope(self, u: jax.Array) -> jax.Array:
        """s'(u), `[n, k]`."""
        return jax.vmap(type(self.cone).slope)(self.cone, u)

    def slope_along(self, u: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
        """First and second derivative of s(u + t v) at t = 0, summed over all contacts."""
        first, second = jax.vmap(type(self.cone).slope_along)(self.cone, u, v)
        return jnp.sum(first), jnp.sum(second)

    def stiffen(self, u: jax.Array) -> jax.Array:
        """J' s''(u) J, `[nv, nv]`.

        A contact's stiffness as a spatial matrix is summed over all contacts of the same two bodies.
        """
        curvature = jax.vmap(type(self.cone).curvature)(self.cone, u)
        turned = jnp.einsum("nkl,nlj->nkj", curvature, self.arms)
        spatial = _mirror(jnp.einsum("nki,nkj->nij", self.arms, turned))
        pairs, members = np.unique(np.stack([self.first, self.second]), axis=1, return_inverse=True)
        stiffness = jnp.tensordot((members == np.arange(pairs.shape[1])[:, None]).astype(float), spatial, 1)
        moves = self.tree.moves[pairs[1]] - self.tree.moves[pairs[0]]
        is_alone = ~self.tree.moves[pairs].any(axis=2).all(axis=0)  # the other body is fixed
        hessian = self._stiffen_trees(stiffness[is_alone], pairs.max(axis=0)[is_alone])
        for one, own in zip(stiffness[~is_alone], moves[~is_alone], strict=True):
            hessian = hessian + self._stiffen_pair(one, own)
        return hessian

    def _stiffen_trees(self, stiffness: jax.Array, bodies: np.ndarray) -> jax.Array:
        """The part of contacts with fixed bodies, whose stiffness adds up like inertia: `[n, 6, 6]` -> `[nv, nv]`."""
        members = (bodies == np.arange(len(self.tree.parent))[:, None]).astype(float)
        total = self.tree.sum_subtrees(jnp.tensordot(members, stiffness, 1))
        carried = jnp.einsum("vij,vj->vi", jnp.tensordot(self.tree.has.T, total, 1), self.motion)
        below = np.tril(self.tree.has.T @ self.tree.moves > 0)  # the first moves the body of the second
        lower = jnp.where(below, carried @ self.motion.T, 0.0)
        return _mirror(lower.T)

    def _stiffen_pair(self, stiffness: jax.Array, moves: np.ndarray) -> jax.Array:
        """The part of two bodies that both move, relative to each other by `moves` of 1, 0 and -1: `[nv, nv]`."""
        motion = self.motion * moves[:, None]
        return _mirror(motion @ (motion @ stiffness).T)


def _find_relative(tree: BodySums, motion, first: np.ndarray, second: np.ndarray, arms, velocity) -> jax.Array:
    """Components of the relative velocity at each contact, `[n, k]`; the arguments are those of `ContactRows`."""
    spatial = tree.sum_paths(jnp.matmul(tree.has, motion * velocity[:, None]))
    return jnp.einsum("nki,ni->nk", arms, spatial[second] - spatial[first])


def _mirror(matrix: jax.Array) -> jax.Array:
    """The symmetric matrix with the same upper triangle."""
    return jnp.triu(matrix) + jnp.triu(matrix, 1).swapaxes(-1, -2)


def find_spatial_axes(model: mujoco.MjModel, d: mjx.Data) -> jax.Array:
    """Spatial velocity (angular, linear) of what a degree of freedom moves, per velocity, `[nv, 6]`.

    The linear part is that of a point at `find_origin`.
    """
    axes = find_joint_axes(model, d)
    levers = find_origin(model, d) - axes.anchor
    return jnp.concatenate([axes.axis, axes.direction + cross_each(axes.axis, levers)], axis=1)


def find_origin(model: mujoco.MjModel, d: mjx.Data) -> jax.Array:
    """The point at which all spatial vectors are taken: where the first body that moves has its root, `[3]`."""
    return d.xpos[model.body_rootid[model.dof_bodyid[0]]]


def make_contact_rows(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, contact: Contact, condim: int) -> ContactRows:
    """The contacts of one dimension as a group of constraints."""
    arms = _find_arms(contact, find_origin(model, d), condim)
    parts = BodySums(model), find_spatial_axes(model, d), contact.first, contact.second, arms
    position = contact.distance - contact.margin
    stiffness, damping, impedance = find_impedance(model, mx, contact.solref, contact.solimp, position)
    dampings = jnp.repeat(damping[:, None], condim, axis=1)
    is_elliptic = model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC and condim > 1
    if is_elliptic:
        is_positive = contact.solreffriction > 0  # numbers of different signs count as none
        own = jnp.any(contact.solreffriction != 0, axis=1) & (is_positive[:, 0] == is_positive[:, 1])
        solref = jnp.where(own[:, None], contact.solreffriction, contact.solref)
        _, sliding_damping, _ = find_impedance(model, mx, solref, contact.solimp, position)
        dampings = jnp.where(np.arange(condim) > 0, sliding_damping[:, None], dampings)
    spring = (stiffness * impedance * position)[:, None] * np.eye(condim)[0]
    weights = get_number(model, mx, "body_invweight0")[:, 0]
    regularization = find_regularization(impedance, weights[contact.first] + weights[contact.second])
    cone = jax.vmap((Ellipse if is_elliptic else Pyramid).make, (0, 0, 0, None))(
        regularization, contact.friction[:, : condim - 1], position < 0, get_number(model, mx, "opt.impratio")
    )
    return ContactRows(*parts, -dampings * _find_relative(*parts, d.qvel) - spring, cone)


def _find_arms(contact: Contact, origin: jax.Array, condim: int) -> jax.Array:
    """Components of the acceleration at a contact per spatial acceleration (angular, linear), `[n, k, 6]`."""
    lever = (contact.position - origin)[:, None]
    axes, spins = contact.frame[:, : min(condim, 3)], contact.frame[:, : max(condim - 3, 0)]
    sliding = jnp.concatenate([cross_each(lever, axes), axes], axis=2)
    return jnp.concatenate([sliding, jnp.concatenate([spins, jnp.zeros_like(spins)], axis=2)], axis=1)
