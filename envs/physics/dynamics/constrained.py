"""The solution of a step's constraints: their rows, their contacts, and Newton's method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import jax.numpy as jnp
import mujoco

from envs.physics.dynamics.constraints import make_rows
from envs.physics.dynamics.contacts import find_contacts, make_contact_rows
from envs.physics.dynamics.numbers import is_traced
from envs.physics.dynamics.smooth import Constraints, Smooth
from envs.physics.dynamics.solver import Constraint, find_force, minimise

if TYPE_CHECKING:
    from mujoco import mjx

    from envs.physics.pairs import Pair


def make_solver(pairs: Sequence[Pair], differentiable: bool = False) -> Callable[..., tuple]:
    """The `solve` of `envs.physics.dynamics.forward` for these candidate pairs of geoms.

    It starts from `qacc_smooth`, or from `qacc_warmstart` where that is an argument of the traced function and better.
    """

    def solve_constraints(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, smooth: Smooth) -> tuple:
        groups = _find_groups(model, mx, d, smooth, pairs)
        if not groups:
            return d.qacc_smooth, jnp.zeros(model.nv)
        guess = d.qacc_warmstart if is_traced(d.qacc_warmstart) else None
        return minimise(smooth.mass, d.qfrc_smooth, groups, d.qacc_smooth, guess, differentiable)

    return solve_constraints


def make_inverse_solver(pairs: Sequence[Pair], _: bool = False) -> Callable[..., tuple]:
    """The same for a given qacc: that, and the forces -sum_i J_i' s_i'(J_i qacc - r_i) that belong to it."""

    def find_forces(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, smooth: Smooth) -> tuple:
        groups = _find_groups(model, mx, d, smooth, pairs)
        pulls = (group.pull(find_force(group, d.qacc)) for group in groups)
        return d.qacc, sum(pulls, jnp.zeros(model.nv))

    return find_forces


def _find_groups(model, mx, d, smooth: Smooth, pairs: Sequence[Pair]) -> list[Constraint]:
    """All constraints of the state, which sensors read too."""
    rows, sections = make_rows(model, mx, d, smooth)
    found = find_contacts(model, mx, d, pairs).items()
    contacts = [group for condim, contact in found for group in make_contact_rows(model, mx, d, contact, condim)]
    smooth.constraints = Constraints(rows, sections, contacts)
    return [group for group in (rows, *(group for _, group in contacts)) if group.reference.size]
