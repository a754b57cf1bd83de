"""One owner for each run folder: the process that trains in it holds a lock on it.

The lock is the kernel's (flock), on a file that names its owner. It goes with the process, however that ends, so a
file that was left behind locks nothing.
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
LONGEST = 200  # bytes of an owner's name: what is in the file may be somebody else's words
ATTEMPTS, PAUSE = 5, 0.1  # seconds between them; who asks for the owner has the lock for a moment


@contextlib.contextmanager
def held(folder: Path, say: Callable[[str], None]) -> Iterator[int]:
    """This process owns the folder inside, where it has a descriptor of it, and removes the lock's file afterwards.

    Args:
      folder: an existing one.
      say: takes a note where the file system knows no locks; then there is none.

    Raises:
      UserError: another process owns it, or what has the lock's name is no file. OSError: it cannot be written.
    """
    with files.opened(folder) as directory:
        descriptor = _acquire(directory, folder, say)
        try:
            yield directory
        finally:
            _remove(directory, descriptor)
            os.close(descriptor)


def owner(folder: Path) -> str | None:
    """The process that owns the folder just now, such as "process 12 on atlas"; None where there is none."""
    try:
        with files.opened(folder) as directory, os.fdopen(files.open_in(directory, NAME, os.O_RDONLY), "rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return " ".join(file.read(LONGEST).decode(errors="replace").split()) or "another process"
    except OSError:  # no such file, or a file system without locks
        return None
    return None


def check_free(folder: Path) -> None:
    """Raises UserError, which names the owner, where a process owns the folder."""
    process = owner(folder)
    if process is not None:
        raise UserError(f"{folder} is in use by {process}, which is training in it")


def _acquire(directory: int, folder: Path, say: Callable[[str], None]) -> int:
    for _ in range(ATTEMPTS):
        descriptor = _open(directory, folder)
        # A file that is not there any more is the last owner's, who removed it between our opening and locking it.
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
        return files.open_in(directory, NAME, os.O_RDWR | os.O_CREAT)
    except OSError as error:
        if error.errno in files.NO_FILE:
            raise UserError(f"{folder / NAME}: cannot be a lock ({error.strerror}); remove it") from error
        raise


def _lock(descriptor: int, folder: Path, say: Callable[[str], None]) -> bool:
    """Whether nobody else has the lock."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        say(f"note: {folder} cannot be locked ({error.strerror}): nothing keeps a second run from writing there")
    return True


def _remove(directory: int, descriptor: int) -> None:
    with contextlib.suppress(OSError):  # the folder may have become read-only; the file is no lock
        if files.is_at(NAME, descriptor, directory):
            os.unlink(NAME, dir_fd=directory)
