"""The kinematic tree as links, each of which moves by one joint relative to the link before it.

A body with several joints is a chain of links, bodies welded to another are part of its link, and the frame of a link
lies at its joint, with the axes of its body. So what connects two links is constant but for the joint's own motion.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.dynamics.codes import JOINT
from envs.physics.dynamics.numbers import get_number, is_traced, snap
from envs.physics.dynamics.rotations import IDENTITY, multiply, normalize, outer, rotate, to_matrix

if TYPE_CHECKING:
    from mujoco import mjx

FREE, BALL, SLIDE, HINGE = JOINT.FREE, JOINT.BALL, JOINT.SLIDE, JOINT.HINGE
DOFS = {FREE: 6, BALL: 3, SLIDE: 1, HINGE: 1}
WORLD = -1


@dataclasses.dataclass
class Link:
    """A link: the joint that moves it, and its inertia.

    Attributes:
      joint: the joint's number.
      kind: its type, one of FREE, BALL, SLIDE and HINGE.
      parent: the link before it, or WORLD.
      dof, qpos: addresses of the joint's first velocity and position.
      axis: axis of a slide or hinge in the link's frame.
      rotation: the link's axes in the parent's, at the reference position [3, 3].
      quaternion: the same as a quaternion, with the sign that products of the model's quaternions have [4].
      point: the link's origin in the parent's frame, at the reference position [3], m.
      mass: kg.
      moment: first moment of mass, integral of r dm, in the link's frame [3], kg m.
      second: second moment of mass, integral of r r' dm, in the link's frame [3, 3], kg m^2.
      weight, weight_moment: mass and first moment of what gravity compensation leaves for gravity.
    """

    joint: int
    kind: int
    parent: int
    dof: int
    qpos: int
    axis: Any
    rotation: Any
    quaternion: Any
    point: Any
    mass: Any = 0.0
    moment: Any = dataclasses.field(default_factory=lambda: np.zeros(3))
    second: Any = dataclasses.field(default_factory=lambda: np.zeros((3, 3)))
    weight: Any = 0.0
    weight_moment: Any = dataclasses.field(default_factory=lambda: np.zeros(3))

    @property
    def dofs(self) -> slice:
        """Where the joint's velocities are in qvel."""
        return slice(self.dof, self.dof + DOFS[self.kind])

    def add_mass(self, mass, moment, second, rotation, point):
        """Adds a mass with these moments in a frame that lies in this one: r -> R r + p."""
        moment = rotate(rotation, moment)
        mixed = outer(point, moment)
        self.mass = self.mass + mass
        self.moment = self.moment + moment + mass * point
        second = rotation @ second @ rotation.T + mixed + mixed.T + mass * outer(point, point)
        self.second = self.second + _mirror(second)

    def add_weight(self, mass, moment, rotation, point):
        """The same for the mass that gravity acts on."""
        self.weight = self.weight + mass
        self.weight_moment = self.weight_moment + rotate(rotation, moment) + mass * point


@dataclasses.dataclass
class Place:
    """Where a body's frame lies: in which link (or WORLD), its axes (matrix and quaternion), its origin there."""

    link: int
    rotation: Any
    quaternion: Any
    point: Any


@dataclasses.dataclass
class Tree:
    """The links, parents first, and the places of the bodies."""

    links: list[Link]
    places: list[Place]


def make_tree(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data) -> Tree:
    """The links of a model with their inertia; the poses of mocap bodies come from the data."""
    get = functools.partial(get_number, model, mx)
    pos, quat = get("body_pos"), get("body_quat")
    joint_pos, joint_axis = get("jnt_pos"), get("jnt_axis")
    tree = Tree([], [Place(WORLD, np.eye(3), IDENTITY, np.zeros(3))])
    for body in range(1, model.nbody):
        place = tree.places[model.body_parentid[body]]
        mocap = model.body_mocapid[body]
        here = (pos[body], quat[body]) if mocap < 0 else (d.mocap_pos[mocap], normalize(d.mocap_quat[mocap]))
        place = _move(place, *here)
        for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            place = _add_link(model, tree, place, joint, joint_pos[joint], joint_axis[joint])
        tree.places.append(place)
    _add_masses(tree, get)
    _regroup(tree.links)
    return tree


def _move(place: Place, pos, quat) -> Place:
    """The place of a frame with this position and orientation in another."""
    point = place.point + rotate(place.rotation, pos)
    rotation = snap(place.rotation @ to_matrix(quat))
    return Place(place.link, rotation, multiply(place.quaternion, quat), snap(point))


def _add_link(model, tree: Tree, place: Place, joint: int, pos, axis) -> Place:
    """Appends the link that a joint moves; the place of the body in it."""
    kind = int(model.jnt_type[joint])
    if kind == FREE:  # what qpos says does not depend on where the body is in the model
        place = Place(WORLD, np.eye(3), IDENTITY, np.zeros(3))
    link = Link(
        joint, kind, place.link, int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint]), snap(axis),
        place.rotation, place.quaternion, place.point,
    )  # fmt: skip
    tree.links.append(link)
    if kind in (FREE, SLIDE):
        return Place(len(tree.links) - 1, np.eye(3), IDENTITY, np.zeros(3))
    link.point = snap(place.point + rotate(place.rotation, pos))
    return Place(len(tree.links) - 1, np.eye(3), IDENTITY, -pos)


def _add_masses(tree: Tree, get):
    """Adds the masses of the bodies to their links."""
    mass, inertia, ipos, iquat = (get(f"body_{name}") for name in ("mass", "inertia", "ipos", "iquat"))
    share = get("body_gravcomp")
    for body, place in enumerate(tree.places):
        if place.link == WORLD:
            continue
        R = to_matrix(iquat[body])
        # the second moment of mass about the centre is tr(I) / 2 - I, of which I is the inertia
        diagonal = 0.5 * inertia[body].sum() - inertia[body]
        second = (R * diagonal) @ R.T
        link = tree.links[place.link]
        center = place.point + rotate(place.rotation, ipos[body])
        link.add_mass(mass[body], np.zeros(3), second, place.rotation, center)
        link.add_weight(mass[body] * (1.0 - share[body]), np.zeros(3), place.rotation, center)


def _regroup(links: list[Link]):
    """Hands to the link before it what of a link's mass moves with both, so that its own has many zeros.

    A mass on the axis of a hinge moves with either link: the mass, the first and the second moment along the axis can
    be the parent's. At a ball it is the mass, at a slide, which does not turn, the second moment. The forces between
    the links change by this, the motion does not.
    """
    for link in reversed(links):
        if link.kind == FREE:
            continue
        along = outer(link.axis, link.axis) * (link.kind == HINGE)
        turning = link.kind != SLIDE
        mass, weight = link.mass * turning, link.weight * turning
        moment, weight_moment = along @ link.moment, along @ link.weight_moment
        second = along @ link.second @ along if turning else link.second
        link.mass, link.moment, link.second = (
            link.mass - mass,
            _subtract(link.moment, moment),
            _subtract(link.second, second),
        )
        link.weight, link.weight_moment = link.weight - weight, _subtract(link.weight_moment, weight_moment)
        if link.parent != WORLD:
            links[link.parent].add_mass(mass, moment, second, link.rotation, link.point)
            links[link.parent].add_weight(weight, weight_moment, link.rotation, link.point)


def _mirror(matrix: Any) -> Any:
    """A symmetric matrix from its upper triangle, so that equations exist once."""
    if not is_traced(matrix):
        return matrix
    return jnp.triu(matrix) + jnp.triu(matrix, 1).T


def _subtract(whole: Any, part: Any) -> Any:
    """The difference, without the rounding errors of terms that are really 0."""
    rest = whole - part
    if is_traced(rest):
        return rest
    return np.where(np.abs(rest) < 4 * np.finfo(float).eps * np.abs(whole).max(initial=0.0), 0.0, rest)
