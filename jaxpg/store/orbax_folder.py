"""A folder of numbered saves by orbax: the one file that knows it.

Saves are synchronous (an asynchronous one is lost, with status 0, if the process ends first), and the folder is held by
a descriptor. Whatever orbax raises, of a dozen types, is one of two errors; after a failed save it starts anew.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import logging
import os
import shutil
import stat
import sys
import weakref
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from orbax import checkpoint as ocp

from jaxpg.store import files
from jaxpg.store.checkpoint_errors import CheckpointError, SaveError, reason


class OrbaxFolder:
    """Arrays by name and a JSON object, saved under numbers.

    Args:
      folder: where they are or will be.
      keep: how many of the newest are kept.
      read_only: for whoever only looks: what is left of an unfinished save stays, as the run may be saving just now.

    Raises:
      CheckpointError: the folder cannot be made or read.
    """

    def __init__(self, folder: Path, keep: int, read_only: bool):
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
        except Exception as error:
            if read_only and not os.path.lexists(folder):
                return  # it has none yet
            raise CheckpointError(f"{folder}: not a folder for checkpoints ({reason(error)})") from error

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
        self._manager = self._make_manager()

    def _make_manager(self) -> ocp.CheckpointManager:
        return ocp.CheckpointManager(self._place, item_names=("state", "meta"), options=self._options)

    @property
    def _opened(self) -> ocp.CheckpointManager:
        """Orbax's manager; there is none where whoever only looks has found no folder."""
        assert self._manager is not None
        return self._manager

    def numbers(self) -> list[int]:
        """The numbers of all saves, the newest first."""
        return sorted(self._manager.all_steps(), reverse=True) if self._manager else []

    # --- writing ------------------------------------------------------------------------------------------------------

    def save(
        self, step: int, arrays: Mapping[str, np.ndarray], record: Mapping[str, Any], verify: Callable[[int], Any]
    ) -> None:
        """Saves arrays, none of them empty, and a JSON object as number `step`.

        Args:
          step, arrays, record: what is saved.
          verify: reads number `step`, or raises. It is called at the first save and at the next one after a failure:
            what still wrote for the failed save may have written into that one.

        Raises:
          SaveError: it cannot be written; nothing is left of it. RuntimeError: orbax declines.
        """
        arguments = ocp.args.Composite(state=ocp.args.StandardSave(arrays), meta=ocp.args.JsonSave(record))
        with self._writing(step):
            saved = self._opened.save(step, args=arguments)
            if saved:
                _synchronize(self._place / str(step))
            if saved and not self._proven:
                verify(step)
        if not saved:
            raise RuntimeError(f"orbax declined to save step {step} after step {max(self.numbers(), default=None)}")
        self._failed, self._proven = False, True

    def make_way(self, step: int) -> None:
        """Removes what is there under the number or a later one: orbax would decline, or fail, to save there.

        Raises:
          SaveError: it cannot be removed.
        """
        with self._writing(step):
            for later in [number for number in self.numbers() if number >= step]:
                self._opened.delete(later)
            place = self._place / str(step)
            if os.path.lexists(place) and (place.is_symlink() or not place.is_dir()):  # which orbax does not see
                place.unlink()

    @contextlib.contextmanager
    def _writing(self, step: int) -> Iterator[None]:
        """Whatever orbax raises inside is a SaveError, and is forgotten before the next save."""
        _silence_what_is_left_behind()
        try:
            self._follow()
            yield
        except Exception as error:
            self._failed, self._proven = True, False
            self._remove_unfinished()
            raise SaveError(f"{self.folder / str(step)}: cannot be written ({reason(error)})") from error

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
            self._manager = self._make_manager()

    def _is_there(self) -> bool:
        """Whether the open folder is the one that has the name now, which is made where there is none."""
        with files.open_folder(self.folder, make=True) as now:
            same = os.path.sameopenfile(now, self._descriptor)
        return same and self._place == files.descriptor_path(self._descriptor, self.folder)

    def _remove_unfinished(self) -> None:
        """What a failed save has left: it takes space."""
        for unfinished in self._place.glob("*.orbax-checkpoint-tmp*"):
            shutil.rmtree(unfinished, ignore_errors=True)

    # --- reading ------------------------------------------------------------------------------------------------------

    def read_record(self, step: int) -> dict[str, Any]:
        """The JSON object; raises CheckpointError where it cannot be read."""
        return self._read(step, meta=ocp.args.JsonRestore())["meta"]

    def read_arrays(self, step: int, kinds: Mapping[str, jax.ShapeDtypeStruct]) -> dict[str, Any]:
        """The arrays, of these shapes and types; raises CheckpointError where they cannot be read."""
        return self._read(step, state=ocp.args.StandardRestore(kinds))["state"]

    def _read(self, step: int, **items: Any) -> Any:
        _silence_what_is_left_behind()
        try:
            _check_own(self._place / str(step))
            return self._opened.restore(step, args=ocp.args.Composite(**items))
        except Exception as error:
            why = reason(error).replace(str(self._place), str(self.folder))
            raise CheckpointError(f"{self.folder / str(step)}: cannot be read ({why})") from error


def _check_own(folder: Path) -> None:
    """Raises OSError where there is anything but files and folders: a link may lead anywhere, a pipe never ends."""
    for path in (folder, *folder.rglob("*")):
        mode = path.lstat().st_mode
        if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
            raise OSError(errno.ELOOP, f"{path.name}: {files.LINK_REFUSED if stat.S_ISLNK(mode) else 'it is no file'}")


def _synchronize(folder: Path) -> None:
    """A save is where a power failure leaves it: orbax leaves all but the arrays to the operating system."""
    for path in (*folder.rglob("*"), folder, folder.parent):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


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
