"""The user's cache folder: where it is, whose it must be, and what is removed from it.

It is `jaxpg` in XDG_CACHE_HOME, else in ~/.cache. Compiled programs have one folder in it for each kind of machine
(`jaxpg.store.executables`), texts one for each kind of text (`jaxpg.store.texts`).
"""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import time
from pathlib import Path

MAX_AGE = 30 * 24 * 3600.0  # seconds; an older entry is removed, and made anew when it is needed
MAX_BYTES = 64 * 2**20  # of all entries together: every start reads those of its folder. A training takes half a MB.
MAX_STAGING_AGE = 24 * 3600.0  # of the temporary folder of a process that was killed
STAGING = "staging-"
PHYSICS = "physics"
TIMES = "times"


class CacheError(Exception):
    """A folder that nothing can be kept in between runs; its text says why."""


def locate() -> Path:
    """The cache folder's path; raises CacheError where the user has none."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    try:
        return (Path(given) if os.path.isabs(given) else Path.home() / ".cache") / "jaxpg"
    except RuntimeError as error:
        raise CacheError("the user has no home folder") from error


def make_private(root: Path, folder: Path) -> None:
    """Makes the cache folder and one in it, if need be; raises CacheError unless both are the user's alone."""
    root.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    for path in (root, folder):
        path.mkdir(mode=0o700, exist_ok=True)
        _check_private(path)


def _check_private(folder: Path) -> None:
    """Raises CacheError unless `folder` is a real folder that belongs to this user and that no other can write to."""
    status = folder.lstat()
    if stat.S_ISLNK(status.st_mode) or not stat.S_ISDIR(status.st_mode):
        raise CacheError(f"{folder} is not a folder of its own")
    if status.st_uid != os.getuid():
        raise CacheError(f"{folder} belongs to another user")
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise CacheError(f"{folder} can be written to by others")


def remove_old(root: Path, now: float | None = None) -> None:
    """Leaves the newest entries of all machines, up to `MAX_AGE` and `MAX_BYTES`; removes left temporary folders."""
    now, total = now or time.time(), 0
    files = [path for kind in ("jaxlib-*", PHYSICS, TIMES) for path in root.glob(f"{kind}/*")]
    for age, path in sorted((_age(path, now), path) for path in files):
        total += path.lstat().st_size
        if total > MAX_BYTES or age > MAX_AGE:
            path.unlink(missing_ok=True)
    for path in root.glob(f"{STAGING}*"):
        if _age(path, now) > MAX_STAGING_AGE:
            shutil.rmtree(path, ignore_errors=True)


def _age(path: Path, now: float) -> float:
    """How long ago it was written, in seconds; by a clock that has been set back since, how far ahead it is.

    Else what was written while the clock was wrong would be the newest for years, and leave no room for the rest.
    """
    return abs(now - path.lstat().st_mtime)


def digest(content: bytes) -> str:
    """What ends the name of a file with this content."""
    return hashlib.blake2b(content, digest_size=16).hexdigest()
