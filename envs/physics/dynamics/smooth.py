"""What the parts of a step share."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

from envs.physics.dynamics.tree import Tree


class Constraints(NamedTuple):
    """What a solver balances.

    Attributes:
      rows: all but contacts, as of `constraints.make_rows`.
      sections: where the rows of each kind are.
      contacts: for each dimension (contacts, their constraints), as of `contacts.make_contact_rows`.
    """

    rows: Any
    sections: dict[str, slice]
    contacts: list[tuple[Any, Any]]


@dataclasses.dataclass
class Smooth:
    """Quantities between the state and the forces.

    Attributes:
      tree: the links.
      poses: their poses relative to their parents.
      mass: mass matrix with armatures [nv, nv].
      tendon_jacobian: derivatives of the tendons' lengths [ntendon, nv].
      tendon_velocity: [ntendon].
      moment: derivatives of the actuators' lengths [nu, nv].
      actuator_velocity: [nu].
      constraints: what the solver balanced; None without a solver.
      flag: 1.0 if the solver says that its solution is void, else 0.0.
    """

    tree: Tree
    poses: list[tuple]
    mass: Any
    tendon_jacobian: Any
    tendon_velocity: Any
    moment: Any
    actuator_velocity: Any
    constraints: Constraints | None = None
    flag: Any = 0.0
