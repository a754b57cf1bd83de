"""Forces of the constraints at the acceleration that was found: on bodies, joints and tendons, and of each contact.

A constraint pulls with -s'(u), u = J qacc - r (`envs.physics.dynamics.constraints`), which is known with qacc.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.physics.dynamics.constraints import make_rows
from envs.physics.dynamics.contacts import find_arms, find_origin
from envs.physics.dynamics.equalities import find_numbers, place_anchors, turn_as_wanted
from envs.physics.dynamics.numbers import get_number
from envs.physics.dynamics.rotations import (
    conjugate,
    contract,
    cross_each,
    length,
    multiply,
    normalize,
    to_rotation_vector,
)
from envs.physics.dynamics.smooth import Constraints, Smooth
from envs.physics.dynamics.solver import find_force
from envs.physics.dynamics.tree import BALL


class Push(NamedTuple):
    """A contact with its force.

    Attributes:
      geoms: the two geoms.
      bodies: their bodies.
      position: the point, `[3]`.
      frame: rows are the normal, from the first body to the second, and two tangents, `[3, 3]`.
      distance: of the surfaces, m.
      exists: whether it is a contact.
      force, torque: on the second body, in the frame, `[3]`; on the first one the opposite.
    """

    geoms: tuple[int, int]
    bodies: tuple[int, int]
    position: Any
    frame: Any
    distance: Any
    exists: Any
    force: Any
    torque: Any


class Limit(NamedTuple):
    """The limit of a joint or tendon: how far it is exceeded (negative, with its margin), its rate, and its force."""

    position: Any
    velocity: Any
    force: Any


class Reactions:
    """The forces, each computed when it is read for the first time.

    Args:
      model: the model.
      mx: its numbers.
      d: with everything that the constraints depend on, and qacc.
      smooth: what the forces are made from.
      constraints: those that the solver balanced.
    """

    def __init__(self, model, mx, d, smooth: Smooth, constraints: Constraints):
        self.model, self.mx, self.d, self.smooth, self.constraints = model, mx, d, smooth, constraints

    def number(self, name: str):
        return get_number(self.model, self.mx, name)

    @functools.cached_property
    def rows(self):
        """The force of each row of the constraints that are no contacts."""
        rows = self.constraints.rows
        if not rows.reference.size:
            return np.zeros(0)
        return find_force(rows, self.d.qacc)

    def section(self, name: str):
        """The forces of the rows of a kind."""
        return self.rows[self.constraints.sections.get(name, slice(0))]

    # --- bodies -------------------------------------------------------------------------------------------------------

    @functools.cached_property
    def wrenches(self):
        """Force and torque about the world's origin by contacts and equalities on each body, [nbody, 3] twice."""
        force = torque = np.zeros((self.model.nbody, 3))
        for (contact, _), forces in zip(self.constraints.contacts, self._contact_forces, strict=True):
            arms = find_arms(contact, find_origin(self.model, self.d), forces.shape[1])
            spatial = jnp.einsum("nki,nk->ni", arms, forces)
            bodies = np.arange(self.model.nbody)[:, None]
            total = contract((contact.second == bodies).astype(float) - (contact.first == bodies), spatial)
            force, torque = force + total[:, 3:], torque + total[:, :3]
        if self.constraints.contacts:
            torque = torque + cross_each(find_origin(self.model, self.d), force)
        for one, other in (self._pull_points("connect"), self._pull_points("weld")):
            force, torque = force + one, torque + other
        return force, torque

    @functools.cached_property
    def _contact_forces(self):
        return [find_force(rows, self.d.qacc) for _, rows in self.constraints.contacts]

    def _pull_points(self, kind: str):
        """Forces and torques of points that are held at points: [nbody, 3] twice."""
        model = self.model
        pulls = self.section(kind).reshape(-1, 3 if kind == "connect" else 6)
        force = torque = np.zeros((model.nbody, 3))
        if not len(pulls):
            return force, torque
        (*first, q), (*second, p) = (place_anchors(model, self.mx, self.d, kind, side) for side in (0, 1))
        spin = self._find_weld_torques(q, p, pulls[:, 3:]) if kind == "weld" else jnp.zeros((len(pulls), 3))
        for (bodies, points), sign in ((first, 1.0), (second, -1.0)):
            here = (np.arange(model.nbody)[:, None] == bodies) * sign
            force = force + contract(here, pulls[:, :3])
            torque = torque + contract(here, spin + cross_each(points, pulls[:, :3]))
        return force, torque

    def _find_weld_torques(self, q, p, pulls):
        """T' w for the rates T omega = vec(p* omega q) s / 2 of welds' errors: the torques vec(p w q*) s / 2."""
        scales = self.number("eq_data")[find_numbers(self.model, "weld"), 10]

        def turn(q, p, w, scale):
            pure = jnp.concatenate([jnp.zeros(1), w])
            return 0.5 * scale * multiply(multiply(p, pure), conjugate(q))[1:]

        return jax.vmap(turn)(turn_as_wanted(self.model, self.mx, q), p, pulls, scales)

    # --- tendons and limits -------------------------------------------------------------------------------------------

    @functools.cached_property
    def _tendon_shares(self):
        """How the rows pull along the tendons, `[n, ntendon]`: their Jacobian is this times that of the tendons."""
        T = jnp.asarray(self.smooth.tendon_jacobian)

        def first_column(column):
            smooth = dataclasses.replace(self.smooth, tendon_jacobian=T.at[:, 0].set(column))
            return make_rows(self.model, self.mx, self.d, smooth)[0].jacobian[:, 0]

        return jax.jacfwd(first_column)(T[:, 0])

    @functools.cached_property
    def tendons(self):
        """The forces along the tendons by which they would get longer [ntendon]."""
        return contract(self.rows, self._tendon_shares) if len(self.rows) else np.zeros(self.model.ntendon)

    def find_joint_limit(self, joint: int) -> Limit:
        """The limit of a hinge, slide or ball."""
        model, d = self.model, self.d
        here, dof = self.constraints.sections.get("joint limit", slice(0)), int(model.jnt_dofadr[joint])
        if model.jnt_type[joint] == BALL:
            return self._find_ball_limit(joint)
        ends = self.number("jnt_range")[joint], self.number("jnt_margin")[joint]
        shares = self.constraints.rows.jacobian[here, dof]
        return _find_limit(d.qpos[model.jnt_qposadr[joint]], d.qvel[dof], *ends, shares, self.rows[here])

    def find_tendon_limit(self, tendon: int) -> Limit:
        """The limit of a tendon."""
        here = self.constraints.sections.get("tendon limit", slice(0))
        ends = self.number("tendon_range")[tendon], self.number("tendon_margin")[tendon]
        velocity = self.smooth.tendon_velocity[tendon]
        return _find_limit(
            self.d.ten_length[tendon], velocity, *ends, self._tendon_shares[here, tendon], self.rows[here]
        )

    def _find_ball_limit(self, joint: int) -> Limit:
        model, d = self.model, self.d
        here = self.constraints.sections.get("ball limit", slice(0))
        row = int(np.flatnonzero(np.flatnonzero((model.jnt_type == BALL) & (model.jnt_limited > 0)) == joint)[0])
        angle = length(to_rotation_vector(normalize(d.qpos[model.jnt_qposadr[joint] + np.arange(4)])))
        excess = self.number("jnt_range")[joint].max() - angle - self.number("jnt_margin")[joint]
        rate = contract(self.constraints.rows.jacobian[here][row], d.qvel)
        return Limit(*(jnp.where(excess < 0, x, 0.0) for x in (excess, rate, self.rows[here][row])))

    # --- contacts -----------------------------------------------------------------------------------------------------

    @functools.cached_property
    def pushes(self) -> list[Push]:
        """The contacts one by one."""
        found = []
        for (contact, _), forces in zip(self.constraints.contacts, self._contact_forces, strict=True):
            wrenches = jnp.pad(forces, ((0, 0), (0, 6 - forces.shape[1])))
            for i, geoms in enumerate(contact.geoms.tolist()):
                found.append(
                    Push(
                        geoms=(geoms[0], geoms[1]),
                        bodies=(int(contact.first[i]), int(contact.second[i])),
                        position=contact.position[i],
                        frame=contact.frame[i],
                        distance=contact.distance[i],
                        exists=contact.distance[i] < contact.margin[i],
                        force=wrenches[i, :3],
                        torque=wrenches[i, 3:],
                    )
                )
        return found


def _find_limit(position, velocity, ends, margin, shares, forces) -> Limit:
    """The limit of low <= position <= high, of rows that push it up or down, as `shares` says; first of all the lower.

    Args:
      position, velocity: scalars.
      ends: low and high.
      margin: distance from an end at which it acts.
      shares: derivative of the rows' distances with respect to the position, `[n]`.
      forces: of the rows, `[n]`.
    """
    below, above = position - ends[0] - margin, ends[1] - position - margin
    up, down = (contract(jnp.maximum(sign * shares, 0.0), forces) for sign in (1.0, -1.0))
    lower, upper = (below, velocity, up), (above, -velocity, down)
    return Limit(*(jnp.where(below < 0, x, jnp.where(above < 0, y, 0.0)) for x, y in zip(lower, upper, strict=True)))
