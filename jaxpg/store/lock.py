"""One owner for each run folder: the process that trains in it holds a lock on it.

The lock is the kernel's (flock), on a file that names its owner. The kernel releases it when the process ends, however
that happens, so a file left behind locks nothing.
"""

from __future__ import annotations

import contextlib
import os
import platform
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from jaxpg.errors import UserError
from jaxpg.posix import fcntl
from jaxpg.store import files

NAME = "lock"
MAX_BYTES = 200  # of the owner's name, as anybody may have written the file
ATTEMPTS, PAUSE = 5, 0.1  # seconds between them; `find_owner` takes the lock for a moment


@contextlib.contextmanager
def hold(folder: Path, say: Callable[[str], None]) -> Iterator[int]:
    """Locks the folder inside the block, and removes the lock file afterwards; yields a descriptor of the folder.

    Args:
      folder: an existing folder.
      say: takes a note if the file system has no locks; the folder is not locked then.

    Raises:
      UserError: another process owns the folder, or the lock's name belongs to something other than a file.
      OSError: the lock file cannot be written.
    """
    with files.open_folder(folder) as directory:
        descriptor = _acquire(directory, folder, say)
        try:
            yield directory
        finally:
            _remove(directory, descriptor)
            os.close(descriptor)


def find_owner(folder: Path) -> str | None:
    """The process that owns the folder now, such as "process 12 on atlas"; None if no process does."""
    try:
        with (
            files.open_folder(folder) as directory,
            os.fdopen(files.open_at(directory, NAME, os.O_RDONLY), "rb") as file,
        ):
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return " ".join(file.read(MAX_BYTES).decode(errors="replace").split()) or "another process"
    except OSError:  # no such file, or the file system has no locks
        return None
    return None


def check_free(folder: Path) -> None:
    """Raises UserError, naming the owner, if a process owns the folder."""
    process = find_owner(folder)
    if process is not None:
        raise UserError(f"{folder} is in use by {process}, which is training in it")


def _acquire(directory: int, folder: Path, say: Callable[[str], None]) -> int:
    for _ in range(ATTEMPTS):
        descriptor = _open(directory, folder)
        # The last owner may have removed the file between our opening and locking it.
        if _lock(descriptor, folder, say) and files.is_at(NAME, descriptor, directory):
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"process {os.getpid()} on {platform.node()}\n".encode(), 0)
            return descriptor
        os.close(descriptor)
        time.sleep(PAUSE)
    check_free(folder)
    raise UserError(f"{folder} is in use by another process")


def _open(directory: int, folder: Path) -> int:
    try:
        return files.open_at(directory, NAME, os.O_RDWR | os.O_CREAT)
    except OSError as error:
        if error.errno in files.NOT_A_FILE:
            raise UserError(f"{folder / NAME}: cannot be locked ({error.strerror}); remove it") from error
        raise


def _lock(descriptor: int, folder: Path, say: Callable[[str], None]) -> bool:
    """Tries to lock the file; returns whether no other process has the lock."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        say(f"note: {folder} cannot be locked ({error.strerror}): a second run could write there too")
    return True


def _remove(directory: int, descriptor: int) -> None:
    with contextlib.suppress(OSError):  # the folder may be read-only now; the file alone locks nothing
        if files.is_at(NAME, descriptor, directory):
            os.unlink(NAME, dir_fd=directory)
