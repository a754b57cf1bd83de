"""Rules of the primitives of linear algebra, written out."""

from __future__ import annotations

import functools

import numpy as np

from envs.physics.algebra import add, mul, sub
from envs.physics.arrays import as_objects, is_numeric, pack
from envs.physics.expressions import Scalar
from envs.physics.folding import snap
from envs.physics.primitives import apply
from envs.physics.rules.reductions import reduce_pairwise


def _dot_general(aval, x, y, *, dimension_numbers, **_):
    (contract_x, contract_y), (batch_x, batch_y) = dimension_numbers
    free_x = [d for d in range(x.ndim) if d not in (*contract_x, *batch_x)]
    free_y = [d for d in range(y.ndim) if d not in (*contract_y, *batch_y)]
    shape = [x.shape[d] for d in batch_x], [x.shape[d] for d in free_x], [y.shape[d] for d in free_y]
    inner = int(np.prod([x.shape[d] for d in contract_x], dtype=int))
    batch, rows, columns = (int(np.prod(sizes, dtype=int)) for sizes in shape)
    x = x.transpose([*batch_x, *free_x, *contract_x]).reshape(batch, rows, inner)
    y = y.transpose([*batch_y, *free_y, *contract_y]).reshape(batch, columns, inner)
    if is_numeric(x, y):
        result = np.einsum("brk,bck->brc", x, y).astype(aval.dtype)
        if aval.dtype.kind == "f":
            result = snap(result, np.einsum("brk,bck->brc", np.abs(x), np.abs(y)))
        return result.reshape(aval.shape)
    x, y = as_objects(x), as_objects(y)
    zero = aval.dtype.type(0).item()
    elements = [
        reduce_pairwise(add, list(map(mul, x[b, r], y[b, c]))) if inner else zero
        for b in range(batch)
        for r in range(rows)
        for c in range(columns)
    ]
    return pack(elements, aval.shape)


def _cholesky(aval, x, **_):
    """L with L L' = x, row by row: L_ij = (x_ij - sum_k L_ik L_jk) / L_jj, L_ii = sqrt(x_ii - sum_k L_ik^2)."""
    result = np.full(x.shape, 0.0, object)
    x, size = as_objects(x), x.shape[-1]
    for batch in np.ndindex(*x.shape[:-2]):
        lower = result[batch]
        for i, j in zip(*np.tril_indices(size), strict=True):
            rest = _subtract_products(x[batch][i, j], lower[i, :j], lower[j, :j])
            lower[i, j] = (
                apply("sqrt", rest, dtype=aval.dtype) if i == j else apply("div", rest, lower[j, j], dtype=aval.dtype)
            )
    return result


def _triangular_solve(aval, a, b, *, left_side, lower, transpose_a, unit_diagonal, **_):
    """x with a x = b (or x a = b), by forward or backward substitution."""
    a, b = as_objects(a), as_objects(b)
    if transpose_a:
        a, lower = a.swapaxes(-1, -2), not lower
    if not left_side:
        a, b, lower = a.swapaxes(-1, -2), b.swapaxes(-1, -2), not lower
    result = np.empty(b.shape, object)
    size = a.shape[-1]
    for *batch, column in np.ndindex(*b.shape[:-2], b.shape[-1]):
        matrix, x = a[tuple(batch)], result[(*batch, slice(None), column)]
        for i in range(size) if lower else reversed(range(size)):
            solved = slice(0, i) if lower else slice(i + 1, size)
            rest = _subtract_products(b[(*batch, i, column)], matrix[i, solved], x[solved])
            x[i] = rest if unit_diagonal else apply("div", rest, matrix[i, i], dtype=aval.dtype)
    return result if left_side else result.swapaxes(-1, -2)


def _subtract_products(c: Scalar, xs: np.ndarray, ys: np.ndarray) -> Scalar:
    """c - sum_k x_k y_k."""
    products = list(map(mul, xs, ys))  # before any sum, as equations keep the order in which they are made
    return sub(c, functools.reduce(add, products, 0))


RULES = {"dot_general": _dot_general, "cholesky": _cholesky, "triangular_solve": _triangular_solve}
