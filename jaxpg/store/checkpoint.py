"""Checkpoints: a tree of arrays and a JSON object, given back as they were saved or not at all.

Orbax casts types in silence and keeps no checksum over array data, so each leaf's shape, type and SHA-256 are written
with it, compared before anything is restored, and verified after.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxpg.store.checkpoint_errors import CheckpointError, reason
from jaxpg.store.leaves import describe, digest, from_storage, leaf_name, recorded_shapes, storage_shape, to_host
from jaxpg.store.orbax_folder import OrbaxFolder
from jaxpg.types import PyTree


class Checkpoints:
    """The checkpoints of one folder, by the number of updates made.

    Args:
      folder, keep, read_only: as in `OrbaxFolder`.

    Raises:
      CheckpointError: the folder cannot be made or read.
    """

    def __init__(self, folder: Path, keep: int = 3, read_only: bool = False):
        self.folder = folder
        self._saves = OrbaxFolder(folder, keep, read_only)

    def numbers(self) -> list[int]:
        """The numbers of all checkpoints, the newest first."""
        return self._saves.numbers()

    def latest(self) -> int | None:
        """The newest checkpoint's number, or None where there is none."""
        return max(self.numbers(), default=None)

    def newest_sound(self) -> tuple[int, list[str]]:
        """The newest checkpoint that is undamaged, and what is wrong with those after it, one line each.

        Raises:
          CheckpointError: there are checkpoints, and none is sound.
        """
        problems = []
        for step in self.numbers():
            try:
                self.read(step)
                return step, problems
            except CheckpointError as error:
                problems.append(str(error))
        raise CheckpointError(problems[0] if len(problems) == 1 else f"{problems[0]}; and none before it is sound")

    def save(self, step: int, tree: PyTree, meta: Mapping[str, Any]) -> None:
        """Writes `tree` and `meta` as checkpoint `step`.

        Raises:
          SaveError: it cannot be written; nothing is left of it. RuntimeError: orbax declines.
        """
        leaves = to_host(tree)
        record = {"step": step, "meta": dict(meta), "leaves": {name: describe(leaf) for name, leaf in leaves.items()}}
        record["sha256"] = digest(record)
        arrays = {name: leaf for name, leaf in leaves.items() if leaf.size}  # orbax refuses empty ones
        self._saves.save(step, arrays, record, verify=self.read)

    def replace(self, step: int, tree: PyTree, meta: Mapping[str, Any]) -> None:
        """Writes checkpoint `step` as the newest, also where one of the same or a later number is there already.

        Raises:
          SaveError, RuntimeError: as `save`.
        """
        self._saves.make_way(step)
        self.save(step, tree, meta)

    def record(self, step: int) -> dict[str, Any]:
        """What was written beside the arrays: `step`, `meta`, and `leaves`, name -> [shape, type, SHA-256].

        Raises:
          CheckpointError: it cannot be read.
        """
        record = self._saves.read_record(step)
        try:
            recorded_shapes(record["leaves"])
            content = {name: record[name] for name in ("step", "meta", "leaves")}
        except (TypeError, ValueError, KeyError, AttributeError) as error:  # JSON all the same, after a flipped bit
            problem = f"{self.folder / str(step)}: damaged, its record is not one of ours ({reason(error)})"
            raise CheckpointError(problem) from error
        if record.get("sha256", digest(content)) != digest(content):  # earlier versions have written none
            raise CheckpointError(f"{self.folder / str(step)}: damaged, its record differs from what was saved")
        return content

    def read(self, step: int) -> dict[str, np.ndarray]:
        """Every leaf of checkpoint `step` by its name, verified; random keys as the numbers that they are stored as.

        Raises:
          CheckpointError: it cannot be read, or its content is damaged.
        """
        record = self.record(step)
        if record["step"] != step:
            raise CheckpointError(f"{self.folder / str(step)}: damaged, it is what was saved as {record['step']}")
        recorded = record["leaves"]
        kinds = recorded_shapes(recorded)
        arrays = self._saves.read_arrays(step, {name: kind for name, kind in kinds.items() if kind.size})
        leaves = {name: np.asarray(arrays.get(name, np.zeros(kind.shape, kind.dtype))) for name, kind in kinds.items()}
        for name, leaf in leaves.items():
            if describe(leaf) != recorded[name]:
                raise CheckpointError(f"{self.folder / str(step)}: damaged, {name} differs from what was saved")
        return leaves

    def restore(self, step: int, template: PyTree, part: str = "") -> PyTree:
        """The tree of checkpoint `step`, or what of a part of it is asked for, every leaf verified.

        Args:
          step: its number.
          template: a tree of the same structure, of arrays or of shapes and types.
          part: such as "train": the template is of leaves below it, of which there may be more.

        Raises:
          CheckpointError: it cannot be read, was made by another program, or its content is damaged.
        """
        paths, structure = jax.tree_util.tree_flatten_with_path(template)
        expected = {f"{part}/{leaf_name(path)}".lstrip("/"): leaf for path, leaf in paths}
        recorded = self.record(step)["leaves"]
        wanted = {name: leaf for name, leaf in recorded.items() if name in expected or not part}
        self._check_same_program(step, wanted, expected)
        arrays = self.read(step)
        leaves = [from_storage(arrays[name], leaf) for name, leaf in expected.items()]
        return jax.tree_util.tree_unflatten(structure, leaves)

    def digest(self, step: int) -> str:
        """SHA-256 of the names, shapes, types and digests of all leaves: equal where the states are, bit for bit.

        Raises:
          CheckpointError: the record cannot be read.
        """
        return digest(self.record(step)["leaves"])

    def _check_same_program(self, step: int, recorded: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
        names = sorted(recorded.keys() ^ expected.keys())
        if names:
            raise CheckpointError(
                f"{self.folder / str(step)}: made by another program: {names[0]} is in only one of them"
            )
        for name, leaf in expected.items():
            ours, saved = storage_shape(leaf), recorded[name]
            if [list(ours.shape), str(ours.dtype)] != saved[:2]:
                raise CheckpointError(
                    f"{self.folder / str(step)}: made by another program: {name} is {saved[1]}{saved[0]} there, "
                    f"{ours.dtype}{list(ours.shape)} here"
                )
