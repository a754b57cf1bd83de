"""Checkpoints with orbax: the one file that knows it.

A checkpoint is a pytree of arrays and a JSON object. Orbax casts types in silence and keeps no checksum over array
data, so each leaf's shape, type and SHA-256 are written with it, compared before anything is restored, and verified
after. Saves are synchronous (an asynchronous one is lost, with status 0, if the process ends first).
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from orbax import checkpoint as ocp

from jaxpg.run.errors import UserError
from jaxpg.types import PyTree


class CheckpointError(UserError):
    """A checkpoint that is missing, damaged, or of another program."""


class Checkpoints:
    """The checkpoints of one folder, by the number of updates made.

    Args:
      folder: where they are or will be.
      keep: how many of the newest are kept.
    """

    def __init__(self, folder: Path, keep: int = 3):
        self.folder = folder.resolve()
        self._manager = ocp.CheckpointManager(
            self.folder,
            item_names=("state", "meta"),
            options=ocp.CheckpointManagerOptions(
                max_to_keep=keep, enable_async_checkpointing=False, cleanup_tmp_directories=True
            ),
        )

    def latest(self) -> int | None:
        """The newest checkpoint's number, or None where there is none."""
        return self._manager.latest_step()

    def save(self, step: int, tree: PyTree, meta: Mapping[str, Any]) -> None:
        """Writes `tree` and `meta` as checkpoint `step`; raises RuntimeError if orbax declines."""
        leaves = _host_leaves(tree)
        content = {name: leaf for name, leaf in leaves.items() if leaf.size}  # orbax refuses empty arrays
        record = {"meta": dict(meta), "leaves": {name: _describe(leaf) for name, leaf in leaves.items()}}
        saved = self._manager.save(
            step, args=ocp.args.Composite(state=ocp.args.StandardSave(content), meta=ocp.args.JsonSave(record))
        )
        if not saved:
            raise RuntimeError(f"orbax declined to save step {step} after step {self.latest()}")

    def replace(self, step: int, tree: PyTree, meta: Mapping[str, Any]) -> None:
        """Writes checkpoint `step` as the newest, also where one of the same or a later number is there already."""
        for later in [number for number in self._manager.all_steps() if number >= step]:
            self._manager.delete(later)
        self.save(step, tree, meta)

    def record(self, step: int) -> dict[str, Any]:
        """What was written beside the arrays: `meta`, and `leaves`, name -> [shape, type, SHA-256].

        Raises:
          CheckpointError: it cannot be read.
        """
        return self._read(step, meta=ocp.args.JsonRestore())["meta"]

    def restore(self, step: int, template: PyTree) -> PyTree:
        """The tree of checkpoint `step`, every leaf verified.

        Args:
          step: its number.
          template: a tree of the same structure, of arrays or of shapes and types.

        Raises:
          CheckpointError: it cannot be read, was made by another program, or its content is damaged.
        """
        recorded = self.record(step)["leaves"]
        paths, structure = jax.tree_util.tree_flatten_with_path(template)
        expected = {_name(path): leaf for path, leaf in paths}
        self._check_same_program(step, recorded, expected)
        targets = {name: _storage(leaf) for name, leaf in expected.items()}
        targets = {name: target for name, target in targets.items() if target.size}
        restored = self._read(step, state=ocp.args.StandardRestore(targets))["state"]
        leaves = []
        for name, leaf in expected.items():
            array = restored.get(name, np.zeros(_storage(leaf).shape, _storage(leaf).dtype))
            if _describe(np.asarray(array)) != recorded[name]:
                raise CheckpointError(f"{self.folder / str(step)}: damaged, {name} differs from what was saved")
            leaves.append(_from_storage(array, leaf))
        return jax.tree_util.tree_unflatten(structure, leaves)

    def _check_same_program(self, step: int, recorded: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
        names = sorted(recorded.keys() ^ expected.keys())
        if names:
            raise CheckpointError(
                f"{self.folder / str(step)}: made by another program: {names[0]} is in only one of them"
            )
        for name, leaf in expected.items():
            ours, saved = _storage(leaf), recorded[name]
            if [list(ours.shape), str(ours.dtype)] != saved[:2]:
                raise CheckpointError(
                    f"{self.folder / str(step)}: made by another program: {name} is {saved[1]}{saved[0]} there, "
                    f"{ours.dtype}{list(ours.shape)} here"
                )

    def _read(self, step: int, **items: Any) -> Any:
        try:
            return self._manager.restore(step, args=ocp.args.Composite(**items))
        except Exception as error:  # a damaged file surfaces as any of a dozen types
            first_line = (str(error).splitlines() or [type(error).__name__])[0]
            raise CheckpointError(f"{self.folder / str(step)}: cannot be read ({first_line})") from error


def _host_leaves(tree: PyTree) -> dict[str, np.ndarray]:
    paths, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {_name(path): np.asarray(_to_storage(leaf)) for path, leaf in paths}


def _name(path: tuple) -> str:
    return jax.tree_util.keystr(path, simple=True, separator="/")


def _is_key(leaf: Any) -> bool:
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _to_storage(leaf: Any) -> Any:
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _storage(leaf: Any) -> jax.ShapeDtypeStruct:
    return jax.eval_shape(_to_storage, leaf)


def _from_storage(array: Any, leaf: Any) -> jax.Array:
    array = jax.device_put(array)  # jax.numpy.asarray would compile a program for it
    return jax.random.wrap_key_data(array, impl=jax.random.key_impl(leaf)) if _is_key(leaf) else array


def _describe(leaf: np.ndarray) -> list[Any]:
    return [list(leaf.shape), str(leaf.dtype), hashlib.sha256(np.ascontiguousarray(leaf).tobytes()).hexdigest()]
