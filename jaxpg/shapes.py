"""One rule for shapes: a scalar is spread over the other array, any other shape must be the same.

Without it `[N]` against `[N, 1]` would be spread in silence to `[N, N]`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp


def floating(x: jax.Array) -> jax.Array:
    """`x` as an array of floating-point numbers: integers would round discounts to 0."""
    return jnp.asarray(x, jnp.result_type(x, 0.0))


def broadcast_scalar(x: jax.Array | float, reference: jax.Array, name: str) -> jax.Array:
    """`x` in the reference's shape and type.

    Args:
      x: a scalar, or an array of the reference's shape.
      reference: `[...]`.
      name: what x is called in the message.

    Raises:
      ValueError: x has another shape.

    >>> broadcast_scalar(0.5, jnp.ones(2), "discount").tolist()
    [0.5, 0.5]
    """
    x = jnp.asarray(x, reference.dtype)
    if x.shape not in ((), reference.shape):
        raise ValueError(f"{name} has shape {x.shape}, expected {reference.shape} or a scalar")
    return jnp.broadcast_to(x, reference.shape)


def expand_like(x: jax.Array, reference: jax.Array) -> jax.Array:
    """`x`, `[N]`, with as many axes as the reference, `[N, ...]`: one number for each of its rows.

    >>> expand_like(jnp.ones(3), jnp.ones((3, 2, 4))).shape
    (3, 1, 1)
    """
    return x.reshape(x.shape + (1,) * (reference.ndim - 1))


def select(mask: jax.Array, if_true: Any, if_false: Any) -> Any:
    """Leaf by leaf of two trees `[N, ...]`: the rows of `if_true` where the mask holds, `[N]` or with further axes.

    It selects and does not multiply: what is not finite in a row that is left out stays out.

    >>> select(jnp.array([True, False]), jnp.array([[1.0], [jnp.nan]]), jnp.zeros((2, 1))).tolist()
    [[1.0], [0.0]]
    """

    def rows(a, b):
        return jnp.where(mask.reshape(mask.shape + (1,) * (b.ndim - mask.ndim)), a, b)

    return jax.tree.map(rows, if_true, if_false)


def check_shape(x: jax.Array, reference: jax.Array, name: str) -> jax.Array:
    """`x`, which must have the reference's shape; raises ValueError where it has another."""
    if x.shape != reference.shape:
        raise ValueError(f"{name} has shape {x.shape}, expected {reference.shape}")
    return x
