"""Constraints of dimension 1, all but contacts, as one group of constraints of the solver."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.dynamics.impedance import find_impedance, find_regularization

if TYPE_CHECKING:
    from mujoco import mjx

Array = jax.Array | np.ndarray


class Rows(NamedTuple):
    """Constraints of dimension 1, whose force is that of a spring, between two bounds: s'(u) = clip(D u, low, high).

    An equality has no bounds, a limit only pushes (s' <= 0), and friction loss has both.

    Attributes:
      jacobian: J, `[n, nv]`.
      reference: r, `[n]`.
      stiffness: D, `[n]`; 0 if the constraint is not active.
      low, high: bounds of s', `[n]`, possibly infinite.
    """

    jacobian: jax.Array
    reference: jax.Array
    stiffness: jax.Array
    low: Array
    high: Array

    def apply(self, velocity: jax.Array) -> jax.Array:
        """J v, `[n]`."""
        return self.jacobian @ velocity

    def pull(self, forces: jax.Array) -> jax.Array:
        """J' w, `[nv]`."""
        return self.jacobian.T @ forces

    def value(self, u: jax.Array) -> jax.Array:
        """s(u) = s'(u) (u - s'(u) / (2 D)), summed over all rows; 0 where D = 0."""
        force = self.slope(u)
        safe = jnp.where(self.stiffness > 0, self.stiffness, 1.0)
        return jnp.sum(force * (u - force / (2 * safe)))

    def slope(self, u: jax.Array) -> jax.Array:
        """s'(u), `[n]`."""
        return jnp.clip(self.stiffness * u, self.low, self.high)

    def _curvature(self, u: jax.Array) -> jax.Array:
        force = self.stiffness * u
        return jnp.where((force > self.low) & (force < self.high), self.stiffness, 0.0)

    def slope_along(self, u: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
        """First and second derivative of s(u + t v) at t = 0, summed over all rows."""
        return jnp.sum(v * self.slope(u)), jnp.sum(v * v * self._curvature(u))

    def stiffen(self, u: jax.Array) -> jax.Array:
        """J' s''(u) J, `[nv, nv]`."""
        return (self.jacobian.T * self._curvature(u)) @ self.jacobian


class Raw(NamedTuple):
    """Rows before their reference acceleration and stiffness are known.

    Attributes:
      jacobian: `[n, nv]`.
      position: violation of the constraint, beyond which it acts, `[n]`.
      impedance_position: the violation that decides the impedance, `[n]`.
      active: whether the constraint acts at all, `[n]`.
      weight: inverse inertia that the constraint sees at the initial position, `[n]`.
      solref, solimp: MuJoCo's parameters, `[n, 2]` and `[n, 5]`.
      low, high: bounds of s', `[n]`.
      bias: acceleration that belongs to the velocity alone, dJ/dt v, `[n]`.
    """

    jacobian: jax.Array
    position: jax.Array
    impedance_position: jax.Array
    active: Array
    weight: jax.Array
    solref: jax.Array
    solimp: jax.Array
    low: Array
    high: Array
    bias: jax.Array


def join_rows(
    model: mujoco.MjModel, mx: mjx.Model, qvel: jax.Array, parts: dict[str, Raw]
) -> tuple[Rows, dict[str, slice]]:
    """The parts as one group, with their reference acceleration and stiffness, and where each of them is in it."""
    if not parts:
        empty = jnp.zeros(0)
        return Rows(jnp.zeros((0, model.nv)), empty, empty, empty, empty), {}
    raw = jax.tree.map(lambda *x: jnp.concatenate(x), *parts.values())
    stiffness, damping, impedance = find_impedance(model, mx, raw.solref, raw.solimp, raw.impedance_position)
    reference = -damping * (raw.jacobian @ qvel) - stiffness * impedance * raw.position - raw.bias
    active_stiffness = jnp.where(raw.active, 1 / find_regularization(impedance, raw.weight), 0.0)
    ends = np.cumsum([0, *(len(part.position) for part in parts.values())]).tolist()
    sections = {kind: slice(*ends[i : i + 2]) for i, kind in enumerate(parts)}
    return Rows(raw.jacobian, reference, active_stiffness, raw.low, raw.high), sections
