"""Vectors, rotation matrices and unit quaternions (w, x, y, z)."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax

from envs.physics.dynamics.numbers import SMALL, is_traced, module_of, snap

# [u x]_ij = sum_k LEVI_CIVITA_ikj u_k
LEVI_CIVITA = np.zeros((3, 3, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    LEVI_CIVITA[_i, _j, _k], LEVI_CIVITA[_i, _k, _j] = 1.0, -1.0
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


def _quaternion_products() -> np.ndarray:
    """T with (p q)_i = sum_jk T_ijk p_j q_k."""
    table = np.zeros((4, 4, 4))
    table[0, 0, 0] = 1.0
    for i in range(3):
        table[0, i + 1, i + 1] = -1.0
        table[i + 1, 0, i + 1] = table[i + 1, i + 1, 0] = 1.0
    table[1:, 1:, 1:] = LEVI_CIVITA
    return table


def _matrix_of_products() -> np.ndarray:
    """T with R_ij = delta_ij + sum_kl T_ijkl q_k q_l for a unit quaternion q."""
    table = np.zeros((3, 3, 4, 4))
    for i in range(3):
        for j in range(3):
            table[i, j, i + 1, j + 1] += 2.0
            for k in range(3):
                table[i, j, 0, k + 1] += 2.0 * LEVI_CIVITA[i, k, j]
        for k in range(3):
            table[i, i, k + 1, k + 1] -= 2.0
    return table


QUATERNION_PRODUCTS = _quaternion_products()
MATRIX_OF_PRODUCTS = _matrix_of_products().reshape(9, 16)


def contract(a: Any, b: Any) -> Any:
    """sum_k a_...k b_k...: the last axis of a with the first of b."""
    if not is_traced(a, b):
        return np.tensordot(a, b, 1)
    a, b = _match(a, b)
    return lax.dot_general(a, b, (((a.ndim - 1,), (0,)), ((), ())))


def _match(a, b):
    """Both with the dtype of the traced ones, as constants are float64."""
    dtype = jnp.result_type(*(x for x in (a, b) if is_traced(x)))
    return lax.convert_element_type(a, dtype), lax.convert_element_type(b, dtype)


def skew(u):
    """[u x], the matrix of the cross product with u."""
    return contract(LEVI_CIVITA.transpose(0, 2, 1), u)


def cross(u, v):
    """U x v; the first of the two may better be the constant one."""
    return contract(skew(u), v)


def outer(u, v):
    """U v'."""
    return u[:, None] * v[None, :]


def rotate(R, v):
    """R v."""
    return contract(R, v)


def rotate_back(R, v):
    """R' v."""
    return contract(R.T, v)


def to_matrix(q):
    """The rotation matrix of a unit quaternion."""
    xp = module_of(q)
    return np.eye(3) + contract(MATRIX_OF_PRODUCTS, xp.reshape(outer(q, q), 16)).reshape(3, 3)


def multiply(p: Any, q: Any) -> Any:
    """The product p q of two quaternions."""
    xp = module_of(p, q)
    return contract(QUATERNION_PRODUCTS.reshape(4, 16), xp.reshape(outer(p, q), 16))


def conjugate(q):
    """The conjugate of a quaternion, which is a unit quaternion's inverse."""
    return q * CONJUGATE


def normalize(q):
    """q / |q|, or the identity if |q| is 0."""
    xp = module_of(q)
    square = (q * q).sum()
    fine = square > SMALL**2
    return xp.where(fine, q / xp.sqrt(xp.where(fine, square, 1.0)), IDENTITY)


def length(v):
    """|v|, with the gradient 0 where it is 0."""
    square = (v * v).sum(-1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def turn(axis, angle):
    """The unit quaternion of a rotation about a unit vector."""
    half = 0.5 * angle
    return jnp.concatenate([jnp.cos(half)[None], axis * jnp.sin(half)])


def to_rotation_vector(q):
    """The rotation vector (axis times angle in (-pi, pi]) of a unit quaternion."""
    sine = length(q[1:])
    angle = 2.0 * jnp.arctan2(sine, q[0])
    angle = jnp.where(angle > np.pi, angle - 2.0 * np.pi, angle)
    turned = sine >= SMALL
    return q[1:] * jnp.where(turned, angle / jnp.where(turned, sine, 1.0), jnp.where(q[0] < 0, -2.0, 2.0))


def subtract(p, q):
    """The rotation vector that turns the orientation q into p, in the frame of q."""
    return to_rotation_vector(multiply(conjugate(q), p))


def from_rotation_vector(v):
    """The unit quaternion of a rotation vector: cos(|v| / 2), v sin(|v| / 2) / |v|."""
    angle = length(v)
    turned = angle > 0
    share = jnp.where(turned, jnp.sin(0.5 * angle) / jnp.where(turned, angle, 1.0), 0.5)
    return jnp.concatenate([jnp.cos(0.5 * angle)[None], v * share])


# --- many at once -----------------------------------------------------------------------------------------------------


def multiply_each(p, q):
    """The products p_i q_i of quaternions [n, 4]."""
    return contract((p[:, :, None] * q[:, None, :]).reshape(-1, 16), QUATERNION_PRODUCTS.reshape(4, 16).T)


def cross_each(u, v):
    """u x v along the last axis, of arrays that broadcast."""
    products = u[..., :, None] * v[..., None, :]
    return contract(products.reshape(*products.shape[:-2], 9), LEVI_CIVITA.reshape(3, 9).T)


def to_matrices(quat):
    """The rotation matrices of unit quaternions [n, 4]."""
    products = (quat[:, :, None] * quat[:, None, :]).reshape(-1, 16)
    return snap(np.eye(3) + contract(products, MATRIX_OF_PRODUCTS.T).reshape(-1, 3, 3))


def rotate_each(axes, points):
    """R_i p_i."""
    return (axes * points[:, None, :]).sum(-1)
