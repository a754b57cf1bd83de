"""The constraints of a state: what the solver needs to know of equalities, friction loss, limits and contacts.

A constraint of dimension k acts on k numbers u, linear in the acceleration a of the degrees of freedom:

    u = J a - r

J is the constraint's Jacobian, and r the reference acceleration, which would take the constraint's violation and its
velocity to zero like a damped spring. The constraint pulls u to 0 with the force -s'(u), where s is a convex function;
`envs.physics.dynamics.solver` finds the acceleration at which all forces balance.

Source: Todorov, "Convex and analytically-invertible dynamics with contacts and constraints" (ICRA 2014), and MuJoCo's
documentation, chapter Computation, section Constraint model.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco

from envs.physics.dynamics.codes import DISABLED
from envs.physics.dynamics.equalities import find_equalities
from envs.physics.dynamics.forces import is_disabled
from envs.physics.dynamics.limits import find_friction_loss, find_limits
from envs.physics.dynamics.rows import Raw, Rows, join_rows
from envs.physics.dynamics.smooth import Smooth

if TYPE_CHECKING:
    from mujoco import mjx


def make_rows(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, smooth: Smooth) -> tuple[Rows, dict[str, slice]]:
    """The constraints of dimension 1 (all but contacts), and where those of each kind are.

    Args:
      model: the model.
      mx: its numbers.
      d: with the poses of all bodies, and tendons.
      smooth: the quantities between the state and the forces.
    """
    parts: dict[str, Raw] = {}
    if not is_disabled(model, DISABLED.CONSTRAINT):
        parts = find_equalities(model, mx, d, smooth) | find_friction_loss(model, mx, smooth)
        parts |= find_limits(model, mx, d, smooth)
    return join_rows(model, mx, d.qvel, parts)
