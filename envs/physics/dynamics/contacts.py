"""Contacts as constraints: Jacobians by spatial vectors, and the convex functions of the friction cones.

A contact of dimension k acts on u = J a - r with k components: the relative acceleration of the two bodies at the
contact along the normal, along two tangents (k >= 3), and their relative angular acceleration about the normal (k >= 4)
and about the tangents (k = 6).

The acceleration of a body, as a spatial vector, is the sum of what the degrees of freedom on its path to the world
contribute, and a force on the body acts on the same degrees of freedom. So for contacts with fixed bodies, products
with J and J' need one pass over the tree of bodies each, and these contacts enter the Hessian in the way in which
inertia enters the mass matrix: as spatial matrices `[6, 6]`, summed up the tree. Contacts of two bodies that move
depend on the few degrees of freedom that move one of them and not the other: there J is written out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.dynamics.cones import Cone, Ellipse, Pyramid
from envs.physics.dynamics.impedance import find_impedance, find_regularization
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
      geoms: the two geoms, as numbers known when tracing, `[n, 2]`.
      first, second: the bodies, likewise, `[n]`.
      distance: of the surfaces, negative inside, `[n]`.
      position: the point halfway between the surfaces, `[n, 3]`.
      frame: rows are the normal, from the first body to the second, and two tangents, `[n, 3, 3]`.
      margin: distance below which the contact acts, `[n]`.
      friction: sliding along two tangents, torsion, rolling about two tangents, `[n, 5]`.
      solref, solreffriction, solimp: MuJoCo's parameters, `[n, 2]`, `[n, 2]`, `[n, 5]`.
    """

    geoms: np.ndarray
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
    margin, *parameters = (jnp.stack(column) for column in zip(*parts, strict=True))
    one, other = (Shape(d.geom_xpos[i], d.geom_xmat[i], get_number(model, mx, "geom_size")[i]) for i in ids)
    distance, position, frame = jax.vmap(PAIRS[shapes])(one, other, margin)
    number = distance.shape[1]
    geoms = np.repeat(ids.T, number, axis=0)
    first, second = model.geom_bodyid[geoms].T
    flat = (x.reshape(-1, *x.shape[2:]) for x in (distance, position, frame))
    return Contact(geoms, first, second, *flat, *(jnp.repeat(x, number, axis=0) for x in (margin, *parameters)))


def _concatenate(parts: list[Contact]) -> Contact:
    geoms, first, second, *others = zip(*parts, strict=True)
    bodies = np.concatenate(first), np.concatenate(second)
    return Contact(np.concatenate(geoms), *bodies, *map(jnp.concatenate, others))


def _mix_parameters(model: mujoco.MjModel, mx: mjx.Model, pair: Pair) -> tuple:
    """(margin, friction, solref, solreffriction, solimp) of a pair: its own, or mixed from those of the geoms.

    The gap, by which C MuJoCo finds contacts before they act, has no influence on the motion. With the flag `override`,
    all contacts have the parameters of the options.
    """
    margin, friction, solref, solreffriction, solimp = _find_own(model, mx, pair)
    if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE:
        option = model.opt
        margin, friction, solref, solimp = option.o_margin, option.o_friction, option.o_solref, option.o_solimp
    return margin, jnp.maximum(friction, mujoco.mjMINMU), solref, solreffriction, solimp


def _find_own(model: mujoco.MjModel, mx: mjx.Model, pair: Pair) -> tuple:
    if pair.index >= 0:
        names = ("margin", "friction", "solref", "solreffriction", "solimp")
        return tuple(get_number(model, mx, f"pair_{name}")[pair.index] for name in names)
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
        friction[np.array([0, 0, 1, 2, 2])],
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


@dataclass(frozen=True)
class ContactRows:
    """Contacts of the same dimension k, n of them, as a group of constraints.

    Attributes:
      reference: r, `[n, k]`.
      cone: the convex function s of each contact.
    """

    reference: jax.Array
    cone: Cone

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

    def _curvature(self, u: jax.Array) -> jax.Array:
        """s''(u), `[n, k, k]`."""
        return jax.vmap(type(self.cone).curvature)(self.cone, u)


@dataclass(frozen=True)
class GroundRows(ContactRows):
    """Contacts of bodies with fixed ones, whose stiffness adds up like inertia.

    Attributes:
      tree: the tree of bodies.
      motion: spatial velocity (angular, linear) per velocity of each degree of freedom, `[nv, 6]`.
      bodies: those that move, `[n]`.
      arms: components of u per spatial acceleration of the body, `[n, k, 6]`.
    """

    tree: BodySums
    motion: jax.Array
    bodies: np.ndarray
    arms: jax.Array

    def apply(self, velocity: jax.Array) -> jax.Array:
        """J v, `[n, k]`."""
        return _apply_arms(self.tree, self.motion, self.bodies, self.arms, velocity)

    def pull(self, forces: jax.Array) -> jax.Array:
        """J' w, `[nv]`."""
        wrenches = jnp.einsum("nki,nk->ni", self.arms, forces)
        total = self.tree.sum_subtrees(jnp.matmul(self._incidence, wrenches))
        return jnp.sum(self.motion * (self.tree.has.T @ total), axis=1)

    def stiffen(self, u: jax.Array) -> jax.Array:
        """J' s''(u) J, `[nv, nv]`: spatial matrices, summed up the tree."""
        turned = jnp.einsum("nkl,nlj->nkj", self._curvature(u), self.arms)
        spatial = _mirror(jnp.einsum("nki,nkj->nij", self.arms, turned))
        total = self.tree.sum_subtrees(jnp.tensordot(self._incidence, spatial, 1))
        carried = jnp.einsum("vij,vj->vi", jnp.tensordot(self.tree.has.T, total, 1), self.motion)
        below = np.tril(self.tree.has.T @ self.tree.moves > 0)  # the first moves the body of the second
        return _mirror(jnp.where(below, carried @ self.motion.T, 0.0).T)

    @property
    def _incidence(self) -> np.ndarray:
        """1 for a body and its contacts, else 0, `[nbody, n]`."""
        return (self.bodies == np.arange(len(self.tree.parent))[:, None]).astype(float)


@dataclass(frozen=True)
class CouplingRows(ContactRows):
    """Contacts of bodies that both move, by the Jacobian, most of which is structural zeros.

    Attributes:
      jacobian: J, `[n, k, nv]`.
    """

    jacobian: jax.Array

    def apply(self, velocity: jax.Array) -> jax.Array:
        """J v, `[n, k]`."""
        return self.jacobian @ velocity

    def pull(self, forces: jax.Array) -> jax.Array:
        """J' w, `[nv]`."""
        return jnp.einsum("nkv,nk->v", self.jacobian, forces)

    def stiffen(self, u: jax.Array) -> jax.Array:
        """J' s''(u) J, `[nv, nv]`."""
        turned = jnp.einsum("nkl,nlv->nkv", self._curvature(u), self.jacobian)
        return _mirror(jnp.einsum("nkv,nkw->vw", self.jacobian, turned))


def _apply_arms(tree: BodySums, motion, bodies: np.ndarray, arms, velocity) -> jax.Array:
    """Components of the bodies' acceleration at each contact, `[n, k]`; the arguments are those of `GroundRows`."""
    spatial = tree.sum_paths(jnp.matmul(tree.has, motion * velocity[:, None]))
    return jnp.einsum("nki,ni->nk", arms, spatial[bodies])


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


def make_contact_rows(
    model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, contact: Contact, condim: int
) -> list[tuple[Contact, GroundRows | CouplingRows]]:
    """The contacts of one dimension as groups of constraints: those with fixed bodies, and the others."""
    tree = BodySums(model)
    is_ground = ~tree.moves[np.stack([contact.first, contact.second])].any(axis=2).all(axis=0)
    groups = []
    for maker, members in ((_make_ground_rows, is_ground), (_make_coupling_rows, ~is_ground)):
        if members.any():
            part = contact._make(x[members] for x in contact)
            groups.append((part, maker(model, mx, d, part, condim, tree)))
    return groups


def _make_ground_rows(model, mx, d, contact: Contact, condim: int, tree: BodySums) -> GroundRows:
    is_second = tree.moves[contact.second].any(axis=1)
    bodies, sign = np.where(is_second, contact.second, contact.first), np.where(is_second, 1.0, -1.0)
    arms = jnp.asarray(sign)[:, None, None] * find_arms(contact, find_origin(model, d), condim)
    parts = tree, find_spatial_axes(model, d), bodies, arms
    return GroundRows(*_find_spring(model, mx, contact, condim, _apply_arms(*parts, d.qvel)), *parts)


def _make_coupling_rows(model, mx, d, contact: Contact, condim: int, tree: BodySums) -> CouplingRows:
    moves = tree.moves[contact.second] - tree.moves[contact.first]
    arms = find_arms(contact, find_origin(model, d), condim)
    jacobian = jnp.einsum("nki,vi->nkv", arms, find_spatial_axes(model, d)) * moves[:, None]
    return CouplingRows(*_find_spring(model, mx, contact, condim, jacobian @ d.qvel), jacobian)


def _find_spring(model, mx, contact: Contact, condim: int, velocity: jax.Array) -> tuple[jax.Array, Cone]:
    """(r, s) of contacts whose bodies have this relative velocity, `[n, k]`."""
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
    return -dampings * velocity - spring, cone


def find_arms(contact: Contact, origin: jax.Array, condim: int) -> jax.Array:
    """Components of the acceleration at a contact per spatial acceleration (angular, linear), `[n, k, 6]`."""
    lever = (contact.position - origin)[:, None]
    axes, spins = contact.frame[:, : min(condim, 3)], contact.frame[:, : max(condim - 3, 0)]
    sliding = jnp.concatenate([cross_each(lever, axes), axes], axis=2)
    return jnp.concatenate([sliding, jnp.concatenate([spins, jnp.zeros_like(spins)], axis=2)], axis=1)
