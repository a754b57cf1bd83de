"""The solution of a step's constraints: their rows, their contacts, and Newton's method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import jax.numpy as jnp
import mujoco

from envs.physics.dynamics.constraints import make_rows
from envs.physics.dynamics.contacts import find_contacts, make_contact_rows
from envs.physics.dynamics.numbers import is_traced
from envs.physics.dynamics.smooth import Smooth
from envs.physics.dynamics.solver import Constraint, minimise

if TYPE_CHECKING:
    from mujoco import mjx

    from envs.physics.pairs import Pair


def make_solver(pairs: Sequence[Pair], differentiable: bool = False) -> Callable[..., tuple]:
    """The `solve` of `envs.physics.dynamics.forward` for these candidate pairs of geoms.

    It starts from `qacc_smooth`, or from `qacc_warmstart` where that is an argument of the traced function and better.
    """

    def solve_constraints(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, smooth: Smooth) -> tuple:
        groups: list[Constraint] = [make_rows(model, mx, d, smooth)]
        for condim, contact in find_contacts(model, mx, d, pairs).items():
            groups.append(make_contact_rows(model, mx, d, contact, condim))
        groups = [group for group in groups if group.reference.size]
        if not groups:
            return d.qacc_smooth, jnp.zeros(model.nv)
        guess = d.qacc_warmstart if is_traced(d.qacc_warmstart) else None
        return minimise(smooth.mass, d.qfrc_smooth, groups, d.qacc_smooth, guess, differentiable)

    return solve_constraints
