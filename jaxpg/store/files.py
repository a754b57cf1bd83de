"""Reads and writes files in folders that others may have changed, without being led elsewhere.

A locked run folder is kept open: files are read and written there even if it has been moved or its name now belongs to
another folder. Links inside a run folder are never followed, as the folder may have come from anywhere.
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import stat
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

UNFINISHED = ".unfinished"  # ending of a file that is renamed once it is complete
FOLDER = os.O_RDONLY | getattr(os, "O_DIRECTORY", 0)  # missing on Windows, where nothing is trained
LINK_REFUSED = "it is a link, and a run folder must not contain links"
DESCRIPTORS = "/proc/self/fd"  # on Linux, has a path to each open descriptor
NOT_A_FILE = (errno.EINVAL, errno.ELOOP)  # errors for anything else where a file was expected

_locked_folders: dict[Path, int] = {}  # folders locked by this process, by their original paths


def replace(path: Path, content: bytes) -> None:
    """Replaces a file atomically: readers, also after a kill or a power failure, see it either old or complete.

    A link of that name is replaced, and its target left alone. Raises OSError.
    """
    with open_folder(path.parent) as folder:
        _replace(folder, path.name, content)


def _replace(folder: int, name: str, content: bytes) -> None:
    unfinished = f".{secrets.token_hex(8)}{UNFINISHED}"
    descriptor = os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666, dir_fd=folder)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, name, src_dir_fd=folder, dst_dir_fd=folder)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(unfinished, dir_fd=folder)
        raise


def read(path: Path) -> bytes:
    """The content of a file; raises OSError, also for a folder, a device, or a link in a run folder."""
    with open_file(path, os.O_RDONLY) as file:
        return file.read()


@contextlib.contextmanager
def open_file(path: Path, flags: int) -> Iterator[IO[bytes]]:
    """Opens a file in the block, with flags as for `os.open`; raises OSError as `read` does."""
    mode = {os.O_RDONLY: "rb", os.O_WRONLY: "wb", os.O_RDWR: "r+b"}[flags & os.O_ACCMODE]
    with open_folder(path.parent) as folder, os.fdopen(open_at(folder, path.name, flags), mode) as file:
        yield file


def open_at(folder: int, name: str, flags: int) -> int:
    """A descriptor of the file of this name in an open folder; raises OSError unless it is a regular file."""
    try:
        descriptor = _open(name, flags | os.O_NONBLOCK, folder)  # or opening a pipe would wait for a writer
    except IsADirectoryError:
        raise OSError(errno.EINVAL, "it is not a file") from None
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "it is not a file")
    return descriptor


@contextlib.contextmanager
def open_folder(folder: Path, make: bool = False) -> Iterator[int]:
    """Opens a folder in the block; yields its descriptor.

    Args:
      folder: any folder; links on the way to it are followed, except inside a run folder.
      make: create the folder, but not its parents, if it does not exist.

    Raises:
      OSError: there is no such folder, or a link on the way to it inside a run folder.
    """
    descriptor = open_folder_descriptor(folder, make)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def open_folder_descriptor(folder: Path, make: bool = False) -> int:
    """As `open_folder`; the caller closes the descriptor."""
    name = Path(os.path.abspath(folder))
    for root, owner in tuple(_locked_folders.items()):  # other threads may begin and end runs at the same time
        if name.is_relative_to(root):
            return _open_below(owner, name.relative_to(root).parts, make)
    run = next((above for above in name.parents if _is_run(above)), None)
    if run:
        root = os.open(run, FOLDER)
        try:
            return _open_below(root, name.relative_to(run).parts, make)
        finally:
            os.close(root)
    if make:
        folder.mkdir(exist_ok=True)
    return os.open(folder, FOLDER)


def _is_run(folder: Path) -> bool:
    return all(os.path.lexists(folder / name) for name in ("config.yaml", "best"))


def _open_below(root: int, names: Sequence[str], make: bool) -> int:
    """Opens a folder below a run folder without following links; creates the last one if `make`."""
    descriptor = os.dup(root)
    for place, name in enumerate(names, 1):
        try:
            if make and place == len(names):
                with contextlib.suppress(FileExistsError):
                    os.mkdir(name, dir_fd=descriptor)
            child = _open(name, FOLDER, descriptor)
        finally:
            os.close(descriptor)
        descriptor = child
    return descriptor


def _open(name: str, flags: int, parent: int | None) -> int:
    try:
        return os.open(name, flags | os.O_NOFOLLOW, 0o666, dir_fd=parent)
    except OSError:
        if is_link(name, parent):
            raise OSError(errno.ELOOP, LINK_REFUSED) from None
        raise


def is_link(name: str, parent: int | None) -> bool:
    """Whether the name belongs to a link."""
    try:
        return stat.S_ISLNK(os.stat(name, dir_fd=parent, follow_symlinks=False).st_mode)
    except OSError:
        return False


def check_no_links(folder: int) -> None:
    """Raises OSError, naming the link, if there is one in an open folder."""
    for name in sorted(os.listdir(folder)):
        if is_link(name, folder):
            raise OSError(errno.ELOOP, f"{name}: {LINK_REFUSED}")


@contextlib.contextmanager
def redirect(path: Path, descriptor: int) -> Iterator[None]:
    """In the block, everything below `path` is read and written in the open folder `descriptor`."""
    name = Path(os.path.abspath(path))
    _locked_folders[name] = descriptor
    try:
        yield
    finally:
        del _locked_folders[name]


def find_path(path: Path) -> Path:
    """The present path of a locked folder, which may have been moved; of any other folder, `path` itself."""
    descriptor = _locked_folders.get(Path(os.path.abspath(path)))
    if descriptor is None or is_at(path, descriptor):
        return path
    name = _find_name(descriptor)
    return name if is_at(name, descriptor) else path


def is_at(path: str | Path, descriptor: int, parent: int | None = None) -> bool:
    """Whether the open file or folder has this path."""
    try:
        return os.path.samestat(os.stat(path, dir_fd=parent), os.fstat(descriptor))
    except OSError:
        return False


def descriptor_path(descriptor: int, path: Path) -> Path:
    """A path to an open folder, for libraries that need one.

    On Linux it stays valid whatever happens to the folder's name. Elsewhere it is the folder's present path.

    Args:
      descriptor: descriptor of the folder.
      path: where it was opened.

    Raises:
      OSError: the folder was removed, or moved and the system does not tell where.
    """
    for name in (_number_path(descriptor), path, _find_name(descriptor)):
        if is_at(name, descriptor):
            return name
    raise OSError(errno.ENOENT, "the folder was moved or removed")


def has_descriptor_paths() -> bool:
    """Whether `descriptor_path` hides folder names, whose characters some libraries take for patterns."""
    with open_folder(Path("/")) as folder:
        return is_at(_number_path(folder), folder)


def _number_path(descriptor: int) -> Path:
    return Path(DESCRIPTORS, str(descriptor))


def _find_name(descriptor: int) -> Path:
    """The present path of an open folder, if the system tells it."""
    try:
        from jaxpg.posix import fcntl  # here, as options and --help do not need it

        if hasattr(fcntl, "F_GETPATH"):
            return Path(os.fsdecode(fcntl.fcntl(descriptor, fcntl.F_GETPATH, bytes(1024)).rstrip(b"\0")))
        return _number_path(descriptor).readlink()
    except OSError:
        return Path(os.devnull)
