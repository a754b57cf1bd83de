"""What the parts of a step share."""

from __future__ import annotations

import dataclasses
from typing import Any

from envs.physics.dynamics.tree import Tree


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
      flag: 1.0 if the solver says that its solution is void, else 0.0.
    """

    tree: Tree
    poses: list[tuple]
    mass: Any
    tendon_jacobian: Any
    tendon_velocity: Any
    moment: Any
    actuator_velocity: Any
    flag: Any = 0.0
