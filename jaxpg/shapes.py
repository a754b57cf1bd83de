"""One rule for shapes: scalars broadcast, any other shapes must be equal.

Without it `[N]` and `[N, 1]` would silently broadcast to `[N, N]`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp


def to_floating(x: jax.Array) -> jax.Array:
    """`x` as an array of floating-point numbers: integers would round discounts to 0."""
    return jnp.asarray(x, jnp.result_type(x, 0.0))


def broadcast_scalar(x: jax.Array | float, reference: jax.Array, name: str) -> jax.Array:
    """`x` with the shape and dtype of the reference.

    Args:
      x: a scalar, or an array of the reference's shape.
      reference: `[...]`.
      name: name of x in the error message.

    Raises:
      ValueError: x is neither a scalar nor of the reference's shape.

    >>> broadcast_scalar(0.5, jnp.ones(2), "discount").tolist()
    [0.5, 0.5]
    """
    x = jnp.asarray(x, reference.dtype)
    if x.shape not in ((), reference.shape):
        raise ValueError(f"{name} has shape {x.shape}, expected {reference.shape} or a scalar")
    return jnp.broadcast_to(x, reference.shape)


def expand_like(x: jax.Array, reference: jax.Array) -> jax.Array:
    """Reshapes `x`, `[N]`, to broadcast over the rows of the reference, `[N, ...]`.

    >>> expand_like(jnp.ones(3), jnp.ones((3, 2, 4))).shape
    (3, 1, 1)
    """
    return x.reshape(x.shape + (1,) * (reference.ndim - 1))


def select(mask: jax.Array, if_true: Any, if_false: Any) -> Any:
    """Selects rows of two trees, leaves `[N, ...]`: those of `if_true` where the mask, `[N, ...]`, is true.

    It does not multiply, so NaN and infinity in rows that are not selected do not matter.

    >>> select(jnp.array([True, False]), jnp.array([[1.0], [jnp.nan]]), jnp.zeros((2, 1))).tolist()
    [[1.0], [0.0]]
    """

    def rows(a, b):
        return jnp.where(mask.reshape(mask.shape + (1,) * (b.ndim - mask.ndim)), a, b)

    return jax.tree.map(rows, if_true, if_false)


def check_shape(x: jax.Array, reference: jax.Array, name: str) -> jax.Array:
    """Returns `x`; raises ValueError if its shape is not the reference's."""
    if x.shape != reference.shape:
        raise ValueError(f"{name} has shape {x.shape}, expected {reference.shape}")
    return x
