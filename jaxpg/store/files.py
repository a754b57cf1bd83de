"""Files in folders whose content may be somebody else's: read and written where they are meant, and nowhere else.

A folder that is owned is held by a descriptor: what is read or written in it goes there, wherever it has been moved
and whatever has taken its name since. Links inside a run folder are never followed: it may have come from anywhere.
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import stat
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

UNFINISHED = ".unfinished"  # ends the name of a file that is renamed once it is complete
FOLDER = os.O_RDONLY | getattr(os, "O_DIRECTORY", 0)  # Windows, where no run is, has none
A_LINK = "it is a link, and what is in a run folder must be its own"
DESCRIPTORS = "/proc/self/fd"  # on Linux a path to each that is open
NO_FILE = (errno.EINVAL, errno.ELOOP)  # of what is found where a file was expected

_owned: dict[Path, int] = {}  # the folders that this process owns, by the names that they were given


def replace(path: Path, content: bytes) -> None:
    """Writes a file that others, and who comes after a kill or a power failure, see as it was or whole.

    A link of that name is replaced, and what it leads to stays as it is. Raises OSError.
    """
    with opened(path.parent) as folder:
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
    """The content of a file; raises OSError, also where that is a link in a run folder, a folder or a device."""
    with opened_in(path, os.O_RDONLY) as file:
        return file.read()


@contextlib.contextmanager
def opened_in(path: Path, flags: int) -> Iterator[BinaryIO]:
    """A file, open for what the flags of `os.open` say, inside; raises OSError as `read`."""
    mode = {os.O_RDONLY: "rb", os.O_WRONLY: "wb", os.O_RDWR: "r+b"}[flags & os.O_ACCMODE]
    with opened(path.parent) as folder, os.fdopen(open_in(folder, path.name, flags), mode) as file:
        yield file


def open_in(folder: int, name: str, flags: int) -> int:
    """A descriptor of the file of this name in an open folder; raises OSError for what is no file of its own."""
    try:
        descriptor = _open(name, flags | os.O_NONBLOCK, folder)  # or a pipe would wait for somebody to write
    except IsADirectoryError:
        raise OSError(errno.EINVAL, "it is no file") from None
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "it is no file")
    return descriptor


@contextlib.contextmanager
def opened(folder: Path, make: bool = False) -> Iterator[int]:
    """A descriptor of a folder, inside.

    Args:
      folder: any; links that lead to it are followed, but none inside a run folder.
      make: where there is none; not those above it.

    Raises:
      OSError: there is none, or there is a link on the way to it inside a run folder.
    """
    descriptor = open_folder(folder, make)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def open_folder(folder: Path, make: bool = False) -> int:
    """As `opened`; to be closed."""
    name = Path(os.path.abspath(folder))
    for root, owner in tuple(_owned.items()):  # other threads may begin and end runs meanwhile
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
    """A folder below that of a run, by way of folders that are no links; the last one is made if need be."""
    descriptor = os.dup(root)
    for place, name in enumerate(names, 1):
        try:
            if make and place == len(names):
                with contextlib.suppress(FileExistsError):
                    os.mkdir(name, dir_fd=descriptor)
            below = _open(name, FOLDER, descriptor)
        finally:
            os.close(descriptor)
        descriptor = below
    return descriptor


def _open(name: str, flags: int, parent: int | None) -> int:
    try:
        return os.open(name, flags | os.O_NOFOLLOW, 0o666, dir_fd=parent)
    except OSError:
        if is_link(name, parent):
            raise OSError(errno.ELOOP, A_LINK) from None
        raise


def is_link(name: str, parent: int | None) -> bool:
    """Whether there is a link of this name."""
    try:
        return stat.S_ISLNK(os.stat(name, dir_fd=parent, follow_symlinks=False).st_mode)
    except OSError:
        return False


def check_no_links(folder: int) -> None:
    """Raises OSError, which names it, where there is a link in an open folder."""
    for name in sorted(os.listdir(folder)):
        if is_link(name, folder):
            raise OSError(errno.ELOOP, f"{name}: {A_LINK}")


@contextlib.contextmanager
def owned(path: Path, descriptor: int) -> Iterator[None]:
    """Whatever is read or written below `path` inside is in the open folder `descriptor`."""
    name = Path(os.path.abspath(path))
    _owned[name] = descriptor
    try:
        yield
    finally:
        del _owned[name]


def whereabouts(path: Path) -> Path:
    """The name that an owned folder has now, for it may have been moved; of any other the given one."""
    descriptor = _owned.get(Path(os.path.abspath(path)))
    if descriptor is None or is_at(path, descriptor):
        return path
    name = _name(descriptor)
    return name if is_at(name, descriptor) else path


def is_at(path: str | Path, descriptor: int, parent: int | None = None) -> bool:
    """Whether the open file or folder has this path."""
    try:
        return os.path.samestat(os.stat(path, dir_fd=parent), os.fstat(descriptor))
    except OSError:
        return False


def through(descriptor: int, path: Path) -> Path:
    """A path to an open folder for libraries that take nothing else.

    On Linux it leads there whatever the folder's name is or becomes. Elsewhere it is the name that it has now.

    Args:
      descriptor: of the folder.
      path: where it was opened.

    Raises:
      OSError: it has been moved to where the system does not tell, or removed.
    """
    for name in (_by_number(descriptor), path, _name(descriptor)):
        if is_at(name, descriptor):
            return name
    raise OSError(errno.ENOENT, "the folder was moved or removed")


def hides_names() -> bool:
    """Whether `through` hides the names of folders, in which some libraries take some letters for patterns."""
    with opened(Path("/")) as folder:
        return is_at(_by_number(folder), folder)


def _by_number(descriptor: int) -> Path:
    return Path(DESCRIPTORS, str(descriptor))


def _name(descriptor: int) -> Path:
    """The name that an open folder has now, as far as the system tells."""
    try:
        from jaxpg.posix import fcntl  # at its use: options are read and --help is printed without it

        if hasattr(fcntl, "F_GETPATH"):
            return Path(os.fsdecode(fcntl.fcntl(descriptor, fcntl.F_GETPATH, bytes(1024)).rstrip(b"\0")))
        return _by_number(descriptor).readlink()
    except OSError:
        return Path(os.devnull)
