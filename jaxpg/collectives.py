"""What the parts of a mapped axis tell each other; with no axis there is one part, and nothing to tell.

The axis is that of `jax.shard_map` or `jax.vmap(..., axis_name=...)`. Parts are of equal size.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from jaxpg.types import PyTree


def mean(tree: PyTree, axis_name: str | None) -> PyTree:
    """The mean over all parts, leaf by leaf, as a single message: many small ones cost more than what they carry."""
    if axis_name is None:
        return tree
    numbers, tree_of = ravel_pytree(tree)
    return tree_of(jax.lax.pmean(numbers, axis_name))


def total(x: jax.Array, axis_name: str | None) -> jax.Array:
    """The sum over all parts."""
    return x if axis_name is None else jax.lax.psum(x, axis_name)


def largest(x: jax.Array, axis_name: str | None) -> jax.Array:
    """The maximum over all parts."""
    return x if axis_name is None else jax.lax.pmax(x, axis_name)


def first_place(where: jax.Array, axis_name: str | None) -> jax.Array:
    """The first index at which a part of `where`, `[N]` of bool, is true, counted through all parts; -1 if none is.

    >>> first_place(jnp.array([False, True, True]), None).item(), first_place(jnp.array([False]), None).item()
    (1, -1)
    """
    before = 0 if axis_name is None else len(where) * jax.lax.axis_index(axis_name)
    after_all = jnp.iinfo(jnp.int32).max
    place = jnp.where(jnp.any(where), before + jnp.argmax(where), after_all).astype(jnp.int32)
    place = -largest(-place, axis_name)
    return jnp.where(place == after_all, -1, place)


def fold_in_index(key: jax.Array, axis_name: str | None) -> jax.Array:
    """A random key of this part's own, from one that all parts have."""
    return key if axis_name is None else jax.random.fold_in(key, jax.lax.axis_index(axis_name))
