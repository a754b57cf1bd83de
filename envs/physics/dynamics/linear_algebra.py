"""Symmetric and general linear systems, eliminated from the last unknown to the first.

A velocity is coupled only with those of the joints that carry it and that it carries. Eliminated from the leaves to the
root, the mass matrix gets no new entries, and what is 0 costs nothing when it is written out as scalars.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp


class Factor(NamedTuple):
    """A = L' D L with a unit lower triangular L and a diagonal D.

    Attributes:
      lower: L [n, n], of which only what is below the diagonal is meant.
      inverse: 1 / diag(D) [n].
    """

    lower: jnp.ndarray
    inverse: jnp.ndarray


def factorize(matrix) -> Factor:
    """A = L' D L, row by row from the last: d_k = A_kk, L_kj = A_kj / d_k, A_ij -= L_ki d_k L_kj for i, j < k.

    Args:
      matrix: A, symmetric and positive definite [n, n].

    Returns:
      The factors, for `solve_factorized`. Nothing is checked: where A is not positive definite they are not finite or
      not accurate.
    """
    size = matrix.shape[-1]
    rows, inverses = [], []
    for k in reversed(range(size)):
        row, inverse = matrix[k, :k], 1.0 / matrix[k, k]
        scaled = row * inverse
        rows.append(jnp.pad(scaled, (0, size - k)))
        inverses.append(inverse)
        if k:
            matrix = matrix[:k, :k] - scaled[:, None] * row[None, :]
    return Factor(jnp.stack(rows[::-1]), jnp.stack(inverses[::-1]))


def solve_factorized(factor: Factor, b):
    """X with A x = b for A = L' D L: by x = L^-1 D^-1 L'^-1 b.

    Args:
      factor: of A [n, n].
      b: right-hand sides [n] or [n, m].

    Returns:
      x, with the shape of b.
    """
    lower, inverse = factor
    vector = b.ndim == 1
    b = b[:, None] if vector else b
    parts = []
    for k in reversed(range(b.shape[0])):
        parts.append(b[k])
        if k:
            b = b[:k] - lower[k, :k, None] * b[k]
    x = jnp.stack(parts[::-1]) * inverse[:, None]
    solved = x[:1]
    for k in range(1, x.shape[0]):
        solved = jnp.concatenate([solved, x[k : k + 1] - (lower[k, :k, None] * solved).sum(0, keepdims=True)])
    return solved[:, 0] if vector else solved


def solve(matrix, b):
    """X with A x = b for a symmetric positive definite A [n, n]; b is [n] or [n, m]."""
    return solve_factorized(factorize(matrix), b)


def solve_general(matrix, b):
    """X with A x = b for a general A [n, n] that needs no pivots, such as a mass matrix less a small one; b is [n].

    Elimination from the last unknown: A_ij -= A_ik A_kj / A_kk and b_i -= A_ik b_k / A_kk for i, j < k.
    """
    rows, rest, inverses = [], [], []
    for k in reversed(range(matrix.shape[-1])):
        inverse = 1.0 / matrix[k, k]
        rows.append(matrix[k, :k])
        rest.append(b[k])
        inverses.append(inverse)
        if k:
            column = matrix[:k, k] * inverse
            matrix, b = matrix[:k, :k] - column[:, None] * matrix[k, None, :k], b[:k] - column * b[k]
    x = []
    for row, value, inverse in zip(reversed(rows), reversed(rest), reversed(inverses), strict=True):
        x.append((value - (row * jnp.stack(x)).sum() if x else value) * inverse)
    return jnp.stack(x)
