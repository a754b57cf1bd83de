"""The leaves of a tree of arrays as stored in a checkpoint: by name, on the host, each with a digest."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from jaxpg.program.state import is_key
from jaxpg.types import PyTree


def recorded_shapes(recorded: Mapping[str, Any]) -> dict[str, jax.ShapeDtypeStruct]:
    """Shape and type of each leaf in a checkpoint's record."""
    return {name: jax.ShapeDtypeStruct(shape, dtype) for name, (shape, dtype, _) in recorded.items()}


def to_host(tree: PyTree) -> dict[str, np.ndarray]:
    """Every leaf of a tree by its name; random keys as their numbers."""
    paths, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {leaf_name(path): np.asarray(_to_storage(leaf)) for path, leaf in paths}


def leaf_name(path: tuple) -> str:
    """The name of a leaf, from its place in the tree, such as `train/params/actor`."""
    return jax.tree_util.keystr(path, simple=True, separator="/")


def _to_storage(leaf: Any) -> Any:
    return jax.random.key_data(leaf) if is_key(leaf) else leaf


def storage_shape(leaf: Any) -> jax.ShapeDtypeStruct:
    """Shape and type of a leaf in storage."""
    return jax.eval_shape(_to_storage, leaf)


def from_storage(array: Any, leaf: Any) -> jax.Array:
    """The leaf stored as this array; `leaf` is one of the same kind, or its shape and type."""
    array = jax.device_put(array)  # jax.numpy.asarray would compile a program for it
    return jax.random.wrap_key_data(array, impl=_key_impl(leaf)) if is_key(leaf) else array


def _key_impl(leaf: Any) -> str:
    """The implementation of random keys, also for shapes and types, which `jax.random.key_impl` does not take."""
    names = ("threefry2x32", "rbg", "unsafe_rbg")
    return next(
        name for name in names if jax.eval_shape(functools.partial(jax.random.key, 0, impl=name)).dtype == leaf.dtype
    )


def digest(record: Mapping[str, Any]) -> str:
    """SHA-256 of plain values."""
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def describe(leaf: np.ndarray) -> list[Any]:
    """Shape, type and SHA-256."""
    return [list(leaf.shape), str(leaf.dtype), hashlib.sha256(np.ascontiguousarray(leaf).tobytes()).hexdigest()]
