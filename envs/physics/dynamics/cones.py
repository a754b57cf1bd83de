"""Friction cones as convex functions s of a contact's u: its relative acceleration less the reference acceleration.

The force of the contact is -s'(u). Without friction, s(u) = D min(u_0, 0)^2 / 2 for the normal component u_0.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import mujoco


class Cone(Protocol):
    """A convex function of k numbers."""

    def value(self, u: jax.Array, /) -> jax.Array: ...
    def slope(self, u: jax.Array, /) -> jax.Array: ...
    def slope_along(self, u: jax.Array, v: jax.Array, /) -> tuple[jax.Array, jax.Array]: ...
    def curvature(self, u: jax.Array, /) -> jax.Array: ...


class Pyramid(NamedTuple):
    """The pyramid inside the cone, of forces along 2 (k - 1) edges.

    s(u) = D / 2 sum_j min(u_0 + m_j u_j, 0)^2 + min(u_0 - m_j u_j, 0)^2,    j = 1 ... k - 1

    Attributes:
      stiffness: D, scalar; 0 if the contact is not active.
      friction: coefficients m, `[k - 1]`; none for a contact without friction.
    """

    stiffness: jax.Array
    friction: jax.Array

    @classmethod
    def make(cls, regularization: jax.Array, friction: jax.Array, active: jax.Array, impratio: jax.Array) -> Pyramid:
        """The pyramid of a contact: 1 / D = 2 m_1^2 (1 + m_1^2) R / i.

        Args:
          regularization: R, of the normal force alone, scalar.
          friction: m, `[k - 1]`.
          active: whether the contact acts, scalar.
          impratio: i, ratio of the impedances of friction and normal force, scalar.
        """
        if friction.size:
            regularization = regularization * (1 + friction[0] ** 2) * 2 * friction[0] ** 2 / impratio
        return cls(jnp.where(active, 1 / regularization, 0.0), friction)

    def _edges(self, u: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Components of u along the edges, `[k - 1]` in each direction; the normal itself without friction."""
        if not self.friction.size:
            return u[:1], u[:0]
        return u[0] + self.friction * u[1:], u[0] - self.friction * u[1:]

    def value(self, u: jax.Array) -> jax.Array:
        """s(u), scalar."""
        return self.stiffness / 2 * sum(jnp.sum(jnp.minimum(edge, 0.0) ** 2) for edge in self._edges(u))

    def slope(self, u: jax.Array) -> jax.Array:
        """s'(u), `[k]`."""
        one, other = (self.stiffness * jnp.minimum(edge, 0.0) for edge in self._edges(u))
        normal = jnp.sum(one) + jnp.sum(other)
        return jnp.concatenate([normal[None], self.friction * (one[: u.size - 1] - other)])

    def slope_along(self, u: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
        """First and second derivative of s(u + t v) at t = 0."""
        first, second = jnp.zeros(()), jnp.zeros(())
        for edge, change in zip(self._edges(u), self._edges(v), strict=True):
            pushed = jnp.where(edge < 0, self.stiffness * change, 0.0)
            first, second = first + jnp.sum(pushed * edge), second + jnp.sum(pushed * change)
        return first, second

    def curvature(self, u: jax.Array) -> jax.Array:
        """s''(u), `[k, k]`."""
        one, other = (jnp.where(edge < 0, self.stiffness, 0.0) for edge in self._edges(u))
        normal = jnp.sum(one) + jnp.sum(other)
        if not self.friction.size:
            return normal[None, None]
        mixed = self.friction * (one - other)
        sliding = jnp.diag(self.friction**2 * (one + other))
        return jnp.block([[normal[None, None], mixed[None]], [mixed[:, None], sliding]])


class Ellipse(NamedTuple):
    """The elliptic cone: the friction force, each component divided by its m_j, is at most as large as the normal one.

    With N = m u_0, T = |(m_1 u_1, ..., m_k-1 u_k-1)| and m = m_1 sqrt(R_1 / R_0):

        N >= m T:      s = 0                                    (the bodies separate)
        m N + T <= 0:  s = sum_j D_j u_j^2 / 2                  (they stick)
        else:          s = D_0 / (m^2 (1 + m^2)) (N - m T)^2 / 2   (they slide)

    Attributes:
      stiffness: D, `[k]`; 0 if the contact is not active.
      friction: coefficients m_j, `[k - 1]`.
      ratio: m, scalar.
    """

    stiffness: jax.Array
    friction: jax.Array
    ratio: jax.Array

    @classmethod
    def make(cls, regularization: jax.Array, friction: jax.Array, active: jax.Array, impratio: jax.Array) -> Ellipse:
        """The cone of a contact: R_1 = R_0 / i and R_j = R_1 m_1^2 / m_j^2; arguments as of `Pyramid.make`."""
        first = regularization / impratio
        others = first * friction[0] ** 2 / friction**2
        stiffness = 1 / jnp.concatenate([regularization[None], others])
        return cls(jnp.where(active, stiffness, 0.0), friction, friction[0] * jnp.sqrt(first / regularization))

    def _scaled(self, u: jax.Array) -> tuple[jax.Array, jax.Array]:
        return self.ratio * u[0], self.friction * u[1:]

    def _zones(self, u: jax.Array):
        """(N, the scaled sliding components, T or 1 if that is 0, whether the bodies slide, whether they stick)."""
        normal, sliding = self._scaled(u)
        squared = jnp.sum(sliding**2)
        moves = squared > mujoco.mjMINVAL**2
        speed = jnp.sqrt(jnp.where(moves, squared, 1.0))
        length = jnp.where(moves, speed, 0.0)
        sticks = self.ratio * normal + length <= 0
        slides = ~sticks & (normal < self.ratio * length)
        return normal, sliding, speed, slides & moves, jnp.where(moves, sticks, normal < 0)

    @property
    def _sliding_stiffness(self) -> jax.Array:
        return self.stiffness[0] / (self.ratio**2 * (1 + self.ratio**2))

    def value(self, u: jax.Array) -> jax.Array:
        """s(u), scalar."""
        normal, _, speed, slides, sticks = self._zones(u)
        slip = self._sliding_stiffness * (normal - self.ratio * speed) ** 2
        return jnp.where(sticks, jnp.sum(self.stiffness * u**2), jnp.where(slides, slip, 0.0)) / 2

    def slope(self, u: jax.Array) -> jax.Array:
        """s'(u), `[k]`."""
        normal, sliding, speed, slides, sticks = self._zones(u)
        push = self._sliding_stiffness * (normal - self.ratio * speed) * self.ratio
        slip = jnp.concatenate([push[None], -push * sliding * self.friction / speed])
        return jnp.where(sticks, self.stiffness * u, jnp.where(slides, slip, 0.0))

    def slope_along(self, u: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
        """First and second derivative of s(u + t v) at t = 0."""
        normal, sliding, speed, slides, sticks = self._zones(u)
        normal_rate, sliding_rate = self._scaled(v)
        rate = jnp.dot(sliding, sliding_rate) / speed
        bend = (jnp.dot(sliding_rate, sliding_rate) - rate**2) / speed
        gap, gap_rate = normal - self.ratio * speed, normal_rate - self.ratio * rate
        slip = self._sliding_stiffness * gap * gap_rate
        slip_rate = self._sliding_stiffness * (gap_rate**2 - gap * self.ratio * bend)
        pushed = self.stiffness * v
        first = jnp.where(sticks, jnp.dot(pushed, u), jnp.where(slides, slip, 0.0))
        return first, jnp.where(sticks, jnp.dot(pushed, v), jnp.where(slides, slip_rate, 0.0))

    def curvature(self, u: jax.Array) -> jax.Array:
        """s''(u), `[k, k]`.

        For bodies that slide, with t_j = m_j u_j / T, it is that of (N - m T)^2 / 2 with respect to N and the m_j u_j,
        which is (1, -m t'; -m t, m (m - N / T) + m N / T t t'), times the scales of these and the stiffness.
        """
        normal, sliding, speed, slides, sticks = self._zones(u)
        unit = sliding / speed
        spread = self.ratio * normal / speed
        inner = (self.ratio**2 - spread) * jnp.eye(unit.size) + spread * unit[:, None] * unit
        slip = jnp.block([[jnp.ones((1, 1)), -self.ratio * unit[None]], [-self.ratio * unit[:, None], inner]])
        scale = jnp.concatenate([self.ratio[None], self.friction])
        slip = self._sliding_stiffness * scale[:, None] * slip * scale
        return jnp.where(sticks, jnp.diag(self.stiffness), jnp.where(slides, slip, 0.0))
