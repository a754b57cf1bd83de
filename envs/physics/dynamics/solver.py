"""The acceleration of a constrained system, as the minimum of a convex function.

By Gauss's principle, the acceleration a is as near as possible to what the forces alone would give, at the price of the
constraints:

    minimise  c(a) = (a - a_f)' M (a - a_f) / 2 + sum_i s_i(J_i a - r_i),    a_f = M^-1 f

with the mass matrix M, the smooth forces f, and a convex function s_i for every constraint
(`envs.physics.dynamics.constraints`). Its gradient and Hessian are

    g(a) = M a - f + sum_i J_i' s_i'(u_i),    H(a) = M + sum_i J_i' s_i''(u_i) J_i,    u_i = J_i a - r_i

Newton's method takes the direction p = -H^-1 g, and along it the step that minimises c, found by Newton's method in one
dimension. Where all s_i are quadratic in pieces, it is exact as soon as the pieces are known.

Source: Todorov, "Convex and analytically-invertible dynamics with contacts and constraints" (ICRA 2014).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax import lax

from envs.physics.dynamics.linear_algebra import factorize, solve_factorized

MAX_ROUNDS = 50  # of Newton's method; most states need one to three
MAX_SEARCH_ROUNDS = 20  # of the search along a direction
FLATNESS = 0.01
# The distance to the minimum is small if it is this many units of rounding of the forces.
TOLERANCE = 100
# Stiff constraints round more. Steps of fewer than so many units of rounding that get no smaller are not made any more.
STALLING = 1000


class Constraint(Protocol):
    """A group of constraints: a linear map J to some array u, a reference r, and a convex function s."""

    @property
    def reference(self) -> jax.Array: ...
    def apply(self, velocity: jax.Array, /) -> jax.Array: ...
    def pull(self, forces: jax.Array, /) -> jax.Array: ...
    def value(self, u: jax.Array, /) -> jax.Array: ...
    def slope(self, u: jax.Array, /) -> jax.Array: ...
    def slope_along(self, u: jax.Array, v: jax.Array, /) -> tuple[jax.Array, jax.Array]: ...
    def stiffen(self, u: jax.Array, /) -> jax.Array: ...


def find_force(constraint: Constraint, acceleration: jax.Array) -> jax.Array:
    """-s'(J a - r), in the constraint's own components."""
    return -constraint.slope(constraint.apply(acceleration) - constraint.reference)


class _Point(NamedTuple):
    """An acceleration a with what is linear in it: M a - f, and u of every group of constraints."""

    acceleration: jax.Array
    imbalance: jax.Array
    residuals: list[jax.Array]


def minimise(
    mass: jax.Array,
    force: jax.Array,
    constraints: Sequence[Constraint],
    free: jax.Array,
    guess: jax.Array | None = None,
    differentiable: bool = False,
) -> tuple[jax.Array, jax.Array]:
    """The acceleration that minimises c, and the force of the constraints on the degrees of freedom.

    Newton's method ends where the distance to the minimum, sqrt(g' H^-1 g), is within the rounding of the forces, or
    small and no longer shrinking, or after `MAX_ROUNDS` rounds. Forces are measured in the same way, by their sum of
    f_j^2 / M_jj. It has no derivative.
    With `differentiable`, one more round starts from its result as from a constant, and so has the derivative of the
    minimum by the implicit function theorem: da = -H^-1 dg.

    Args:
      mass: M, positive definite, `[nv, nv]`.
      force: f, `[nv]`.
      constraints: groups of constraints.
      free: a_f, from which the method starts, `[nv]`.
      guess: another acceleration, `[nv]`; the method starts from it where c is smaller there than at a_f.
      differentiable: make the last round.

    Returns:
      (a, -sum_i J_i' s_i'(u_i)), both `[nv]`.
    """

    def place(a: jax.Array) -> _Point:
        return _Point(a, mass @ a - force, [c.apply(a) - c.reference for c in constraints])

    def gradient(point: _Point) -> jax.Array:
        pulls = (c.pull(c.slope(u)) for c, u in zip(constraints, point.residuals, strict=True))
        return sum(pulls, point.imbalance)

    def hessian(point: _Point) -> jax.Array:
        return sum((c.stiffen(u) for c, u in zip(constraints, point.residuals, strict=True)), mass)

    inverse = 1 / jnp.diag(mass)
    rounding = float(jnp.finfo(mass.dtype).eps)

    def is_far(squared_distance: jax.Array, last: jax.Array, point: _Point) -> jax.Array:
        """Whether another round is worthwhile; not where anything is NaN, which no round would change."""
        size = rounding**2 * jnp.sum((force**2 + point.imbalance**2) * inverse)
        stalls = (squared_distance > last / 4) & (squared_distance <= STALLING**2 * size)
        return (squared_distance > TOLERANCE**2 * size) & ~stalls

    def improve(state: tuple) -> tuple:
        point, slope, _, last, count = state
        factor = factorize(hessian(point))
        p = -solve_factorized(factor, slope)
        line = _Point(p, mass @ p, [c.apply(p) for c in constraints])
        size = _minimise_along(constraints, point, line, slope)
        point = jax.tree.map(lambda x, dx: x + size * dx, point, line)
        slope = gradient(point)
        # the factor of the last point serves for the distance: where the steps are small, it hardly changes
        squared_distance = jnp.dot(slope, solve_factorized(factor, slope))
        return point, slope, is_far(squared_distance, last, point), squared_distance, count + 1

    first = place(free)
    if guess is not None:
        first = _choose(constraints, free, first, place(guess))
    slope = gradient(first)
    infinite = jnp.full((), jnp.inf, mass.dtype)
    state = (first, slope, is_far(jnp.sum(slope**2 * inverse), infinite, first), infinite, jnp.zeros((), int))
    state = lax.while_loop(lambda state: state[2] & (state[4] < MAX_ROUNDS), improve, lax.stop_gradient(state))
    a, imbalance = state[0].acceleration, state[0].imbalance
    if differentiable:
        last = place(lax.stop_gradient(a))
        factor = factorize(lax.stop_gradient(hessian(last)))
        a = last.acceleration - solve_factorized(factor, gradient(last))
        imbalance = mass @ a - force
    return a, imbalance


def _choose(constraints: Sequence[Constraint], free: jax.Array, one: _Point, other: _Point) -> _Point:
    """The point with the smaller c."""

    def evaluate(point: _Point) -> jax.Array:
        values = (c.value(u) for c, u in zip(constraints, point.residuals, strict=True))
        return sum(values, jnp.dot(point.acceleration - free, point.imbalance) / 2)

    is_smaller = evaluate(other) < evaluate(one)
    return jax.tree.map(lambda x, y: jnp.where(is_smaller, y, x), one, other)


def _minimise_along(constraints: Sequence[Constraint], point: _Point, line: _Point, slope: jax.Array) -> jax.Array:
    """The t at which c along the line from a point is nearly smallest: |c'(t)| <= `FLATNESS` |c'(0)|.

    Newton's method for c'(t) = 0 from t = 1, which is the solution if c is quadratic between 0 and 1. A step that would
    leave the interval in which the solution lies is replaced by one that halves it, or doubles t.

    Args:
      constraints: groups of constraints.
      point: where the line begins.
      line: its direction.
      slope: the gradient at the point, `[nv]`.
    """

    def differentiate(t: jax.Array) -> tuple[jax.Array, jax.Array]:
        first = jnp.dot(line.acceleration, point.imbalance + t * line.imbalance)
        second = jnp.dot(line.acceleration, line.imbalance)
        for constraint, u, v in zip(constraints, point.residuals, line.residuals, strict=True):
            part = constraint.slope_along(u + t * v, v)
            first, second = first + part[0], second + part[1]
        return first, second

    def improve(state: tuple) -> tuple:
        t, low, high, first, second, count = state
        low, high = jnp.where(first < 0, t, low), jnp.where(first < 0, high, t)
        step = t - first / jnp.where(second > 0, second, 1.0)
        middle = jnp.where(high < jnp.inf, (low + high) / 2, 2 * low)
        t = jnp.where((step > low) & (step < high), step, middle)
        return t, low, high, *differentiate(t), count + 1

    limit = FLATNESS * jnp.abs(jnp.dot(line.acceleration, slope))
    one = jnp.ones((), slope.dtype)
    state = (one, jnp.zeros_like(one), jnp.full_like(one, jnp.inf), *differentiate(one), jnp.zeros((), int))
    return lax.while_loop(lambda s: (jnp.abs(s[3]) > limit) & (s[5] < MAX_SEARCH_ROUNDS), improve, state)[0]
