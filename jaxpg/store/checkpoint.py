"""Checkpoints with orbax: the one file that knows it.

A checkpoint is a pytree of arrays and a JSON object. Orbax casts types in silence and keeps no checksum over array
data, so each leaf's shape, type and SHA-256 are written with it, compared before anything is restored, and verified
after. Saves are synchronous (an asynchronous one is lost, with status 0, if the process ends first).
"""

from __future__ import annotations

import contextlib
import errno
import functools
import logging
import os
import re
import shutil
import stat
import sys
import weakref
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from orbax import checkpoint as ocp

from jaxpg.errors import UserError
from jaxpg.store import files
from jaxpg.store.leaves import describe, digest, from_storage, leaf_name, recorded_shapes, storage_shape, to_host
from jaxpg.types import PyTree


class CheckpointError(UserError):
    """A checkpoint that is missing, damaged, or of another program."""

    word = "damaged"  # in a list of checkpoints


class OtherRunError(CheckpointError):
    """A sound checkpoint, of another run."""

    word = "of another run"


class SaveError(Exception):
    """A checkpoint that could not be written: where and why."""


class Checkpoints:
    """The checkpoints of one folder, by the number of updates made.

    Args:
      folder: where they are or will be.
      keep: how many of the newest are kept.
      read_only: for whoever only looks: what is left of an unfinished save stays, as the run may be saving just now.

    Raises:
      CheckpointError: the folder cannot be made or read.
    """

    def __init__(self, folder: Path, keep: int = 3, read_only: bool = False):
        self.folder = folder
        self._read_only = read_only
        self._options = ocp.CheckpointManagerOptions(
            max_to_keep=keep,
            enable_async_checkpointing=False,
            cleanup_tmp_directories=not read_only,
            create=False,
        )
        self._failed = False
        self._proven = False  # whether what this object has saved could be read
        self._manager: ocp.CheckpointManager | None = None
        self._place = folder
        try:
            self._open()
        except Exception as error:  # of a dozen types
            if read_only and not os.path.lexists(folder):
                return  # it has none yet
            raise CheckpointError(f"{folder}: not a folder for checkpoints ({_reason(error)})") from error

    def _open(self) -> None:
        """Holds the folder by a descriptor, as orbax then does: its name may change, or be one that orbax cannot read.

        Raises:
          OSError: it cannot be made or opened, or has links in it, through which orbax would write and delete.
        """
        _silence_what_is_left_behind()
        descriptor = files.open_folder_descriptor(self.folder, make=not self._read_only)
        self._closing = weakref.finalize(self, os.close, descriptor)
        self._descriptor, self._place = descriptor, files.descriptor_path(descriptor, self.folder)
        if not self._read_only:
            files.check_no_links(descriptor)
        self._manager = self._managed()

    def _managed(self) -> ocp.CheckpointManager:
        return ocp.CheckpointManager(self._place, item_names=("state", "meta"), options=self._options)

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

    def numbers(self) -> list[int]:
        """The numbers of all checkpoints, the newest first."""
        return sorted(self._manager.all_steps(), reverse=True) if self._manager else []

    def save(self, step: int, tree: PyTree, meta: Mapping[str, Any]) -> None:
        """Writes `tree` and `meta` as checkpoint `step`.

        Raises:
          SaveError: it cannot be written; nothing is left of it. RuntimeError: orbax declines.
        """
        leaves = to_host(tree)
        content = {name: leaf for name, leaf in leaves.items() if leaf.size}  # orbax refuses empty arrays
        record = {"step": step, "meta": dict(meta), "leaves": {name: describe(leaf) for name, leaf in leaves.items()}}
        record["sha256"] = digest(record)
        arguments = ocp.args.Composite(state=ocp.args.StandardSave(content), meta=ocp.args.JsonSave(record))
        with self._writing(step):
            saved = self._manager.save(step, args=arguments)
            if saved:
                _to_disk(self._place / str(step))
            if saved and not self._proven:  # what still wrote for a failed save may have written into this one
                self.read(step)
        if not saved:
            raise RuntimeError(f"orbax declined to save step {step} after step {self.latest()}")
        self._failed, self._proven = False, True

    def replace(self, step: int, tree: PyTree, meta: Mapping[str, Any]) -> None:
        """Writes checkpoint `step` as the newest, also where one of the same or a later number is there already.

        Raises:
          SaveError, RuntimeError: as `save`.
        """
        with self._writing(step):
            for later in [number for number in self.numbers() if number >= step]:
                self._manager.delete(later)
            self._make_way(step)
        self.save(step, tree, meta)

    def _make_way(self, step: int) -> None:
        """Removes what has the number's name and is no folder: orbax does not see it, and could not save there."""
        place = self._place / str(step)
        if os.path.lexists(place) and (place.is_symlink() or not place.is_dir()):
            place.unlink()

    @contextlib.contextmanager
    def _writing(self, step: int) -> Iterator[None]:
        """Whatever orbax raises inside is a SaveError, and is forgotten before the next save."""
        _silence_what_is_left_behind()
        try:
            self._follow()
            yield
        except Exception as error:  # a full disk surfaces as any of a dozen types
            self._failed, self._proven = True, False
            self._remove_unfinished()
            raise SaveError(f"{self.folder / str(step)}: cannot be written ({_reason(error)})") from error

    def _follow(self) -> None:
        """Starts anew where a save has failed, or where there is another folder now: what orbax remembers is not so.

        A run folder that is gone is not made again.
        """
        if self._failed:
            self._remove_unfinished()
        if not self._is_there():
            self._closing.detach()  # what still writes for a failed save must not get another folder by this number
            self._open()
        elif self._failed:
            self._manager = self._managed()

    def _is_there(self) -> bool:
        """Whether the open folder is the one that has the name now, which is made where there is none."""
        with files.open_folder(self.folder, make=True) as now:
            same = os.path.sameopenfile(now, self._descriptor)
        return same and self._place == files.descriptor_path(self._descriptor, self.folder)

    def _remove_unfinished(self) -> None:
        """What a failed save has left: it takes space."""
        for unfinished in self._place.glob("*.orbax-checkpoint-tmp*"):
            shutil.rmtree(unfinished, ignore_errors=True)

    def record(self, step: int) -> dict[str, Any]:
        """What was written beside the arrays: `step`, `meta`, and `leaves`, name -> [shape, type, SHA-256].

        Raises:
          CheckpointError: it cannot be read.
        """
        record = self._read(step, meta=ocp.args.JsonRestore())["meta"]
        try:
            recorded_shapes(record["leaves"])
            found = {name: record[name] for name in ("step", "meta", "leaves")}
        except (TypeError, ValueError, KeyError, AttributeError) as error:  # JSON all the same, after a flipped bit
            problem = f"{self.folder / str(step)}: damaged, its record is not one of ours ({_reason(error)})"
            raise CheckpointError(problem) from error
        if record.get("sha256", digest(found)) != digest(found):  # earlier versions have written none
            raise CheckpointError(f"{self.folder / str(step)}: damaged, its record differs from what was saved")
        return found

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
        stored = {name: kind for name, kind in kinds.items() if kind.size}
        restored = self._read(step, state=ocp.args.StandardRestore(stored))["state"]
        leaves = {
            name: np.asarray(restored.get(name, np.zeros(kind.shape, kind.dtype))) for name, kind in kinds.items()
        }
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

    def _read(self, step: int, **items: Any) -> Any:
        _silence_what_is_left_behind()
        try:
            _check_own(self._place / str(step))
            return self._manager.restore(step, args=ocp.args.Composite(**items))
        except Exception as error:  # a damaged file surfaces as any of a dozen types
            reason = _reason(error).replace(str(self._place), str(self.folder))
            raise CheckpointError(f"{self.folder / str(step)}: cannot be read ({reason})") from error


def _check_own(folder: Path) -> None:
    """Raises OSError where there is anything but files and folders: a link may lead anywhere, a pipe never ends."""
    for path in (folder, *folder.rglob("*")):
        mode = path.lstat().st_mode
        if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
            raise OSError(errno.ELOOP, f"{path.name}: {files.LINK_REFUSED if stat.S_ISLNK(mode) else 'it is no file'}")


def _to_disk(folder: Path) -> None:
    """A checkpoint is where a power failure leaves it: orbax leaves all but the arrays to the operating system."""
    for path in (*folder.rglob("*"), folder, folder.parent):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _reason(error: BaseException) -> str:
    """The operating system's words, if it has refused something, and else the first line of the message."""
    cause: BaseException | None = error
    while cause is not None:
        code = re.search(r"os_error_code='(\d+)'", str(cause))  # tensorstore's, in a ValueError
        if code or (isinstance(cause, OSError) and cause.errno):
            return os.strerror(int(code[1])) if code else cause.strerror
        cause = cause.__cause__ or cause.__context__
    return (str(error).splitlines() or [type(error).__name__])[0]


@functools.cache
def _silence_what_is_left_behind() -> None:
    """What orbax leaves behind at a failure, which it raises too, ends with a traceback of its own."""
    report = sys.unraisablehook

    def hook(unraisable: Any) -> None:
        if str(unraisable.exc_value) != "Event loop is closed":
            report(unraisable)

    sys.unraisablehook = hook
    silenced = (
        ("absl", "_SignalingThread.run() raised"),
        ("absl", "Waiting for previous save"),  # by the time of day: after a second, if the clock was set forward
        ("absl", "etadata file"),  # of a checkpoint that a kill has half removed: it is read, or named, all the same
        ("asyncio", "exception was never retrieved"),
    )
    for name, words in silenced:
        logging.getLogger(name).addFilter(lambda record, words=words: words not in record.getMessage())
