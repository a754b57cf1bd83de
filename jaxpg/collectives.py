"""Collective operations over a mapped axis; without an axis they return their argument.

The axis is that of `jax.shard_map` or `jax.vmap(..., axis_name=...)`. All its parts have the same size.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from jaxpg.types import PyTree


def mean(tree: PyTree, axis_name: str | None) -> PyTree:
    """The mean of each leaf over all parts; all leaves travel in one message, as many small ones are slow."""
    if axis_name is None:
        return tree
    vector, unravel = ravel_pytree(tree)
    return unravel(jax.lax.pmean(vector, axis_name))


def total(x: jax.Array, axis_name: str | None) -> jax.Array:
    """The sum over all parts."""
    return x if axis_name is None else jax.lax.psum(x, axis_name)


def maximum(x: jax.Array, axis_name: str | None) -> jax.Array:
    """The maximum over all parts."""
    return x if axis_name is None else jax.lax.pmax(x, axis_name)


def find_first(where: jax.Array, axis_name: str | None) -> jax.Array:
    """The first index at which `where`, `[N]` of bool, is true, counted over all parts; -1 if there is none.

    >>> find_first(jnp.array([False, True, True]), None).item(), find_first(jnp.array([False]), None).item()
    (1, -1)
    """
    offset = 0 if axis_name is None else len(where) * jax.lax.axis_index(axis_name)
    none = jnp.iinfo(jnp.int32).max
    index = jnp.where(jnp.any(where), offset + jnp.argmax(where), none).astype(jnp.int32)
    index = -maximum(-index, axis_name)
    return jnp.where(index == none, -1, index)


def fold_in_index(key: jax.Array, axis_name: str | None) -> jax.Array:
    """A different random key for each part, from a key that all share."""
    return key if axis_name is None else jax.random.fold_in(key, jax.lax.axis_index(axis_name))
