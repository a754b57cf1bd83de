"""One owner for each run folder: the process that trains in it holds a lock on it.

The lock is the kernel's (flock), on a file that names its owner. It goes with the process, however that ends, so a
file that was left behind locks nothing.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import platform
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from jaxpg.run.errors import UserError

NAME = "lock"
ATTEMPTS, PAUSE = 5, 0.1  # seconds between them; who asks for the owner has the lock for a moment


@contextlib.contextmanager
def held(folder: Path, say: Callable[[str], None]) -> Iterator[None]:
    """This process owns the folder inside, and removes the lock's file afterwards.

    Args:
      folder: an existing one.
      say: takes a note where the file system knows no locks; then there is none.

    Raises:
      UserError: another process owns it; OSError: the file cannot be written.
    """
    descriptor = _acquire(folder, say)
    try:
        yield
    finally:
        _remove(folder / NAME, descriptor)
        os.close(descriptor)


def owner(folder: Path) -> str | None:
    """The process that owns the folder just now, such as "process 12 on atlas"; None where there is none."""
    try:
        with (folder / NAME).open(encoding="utf-8") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return file.read().strip() or "another process"
    except OSError:  # no such file, or a file system without locks
        return None
    return None


def check_free(folder: Path) -> None:
    """Raises UserError, which names the owner, where a process owns the folder."""
    process = owner(folder)
    if process is not None:
        raise UserError(f"{folder} is in use by {process}, which is training in it")


def _acquire(folder: Path, say: Callable[[str], None]) -> int:
    path = folder / NAME
    for _ in range(ATTEMPTS):
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        # A file that is not there any more is the last owner's, who removed it between our opening and locking it.
        if _lock(descriptor, folder, say) and _is_at(path, descriptor):
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"process {os.getpid()} on {platform.node()}\n".encode(), 0)
            return descriptor
        os.close(descriptor)
        time.sleep(PAUSE)
    check_free(folder)
    raise UserError(f"{folder} is in use by another process")


def _lock(descriptor: int, folder: Path, say: Callable[[str], None]) -> bool:
    """Whether nobody else has the lock."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        say(f"note: {folder} cannot be locked ({error.strerror}): nothing keeps a second run from writing there")
    return True


def _is_at(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except OSError:
        return False


def _remove(path: Path, descriptor: int) -> None:
    with contextlib.suppress(OSError):  # the folder may have become read-only; the file is no lock
        if _is_at(path, descriptor):
            path.unlink()
