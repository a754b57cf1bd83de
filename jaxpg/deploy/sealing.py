"""Exported files carry a seal, so that a later export can recognise and replace them.

A seal is `jaxpg:` and a digest of the rest of the file, in a comment or in the format's metadata. A file with a correct
seal is unchanged since it was exported, so another export may replace it.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from jaxpg.errors import UserError
from jaxpg.store.files import descriptor_path, open_folder, read

NO_SEAL = "jaxpg:" + 16 * "0"
SEAL = re.compile(rb"jaxpg:[0-9a-f]{16}")


def add_seal(content: bytes) -> bytes:
    """The content of a file with `NO_SEAL` replaced by its seal.

    >>> is_sealed(add_seal(f"/* {NO_SEAL} */".encode()))
    True
    """
    return content.replace(NO_SEAL.encode(), _make_seal(content))


def is_sealed(content: bytes) -> bool:
    """Whether the content is exactly what `add_seal` returned."""
    return set(SEAL.findall(content)) == {_make_seal(SEAL.sub(NO_SEAL.encode(), content))}


def _make_seal(content: bytes) -> bytes:
    return b"jaxpg:" + hashlib.sha256(content).hexdigest()[:16].encode()


def check_replaceable(names: Sequence[str], out: Path) -> None:
    """Checks that an export would overwrite no file of the user's.

    Args:
      names: names of the files.
      out: the folder, which need not exist.

    Raises:
      UserError: one of the names belongs to anything but a sealed file: a file of the user's, a changed file, a link or
        a folder.
    """
    occupied = [name for name in names if not _is_free(out / name)]
    if occupied:
        raise UserError(
            f"out={out} holds {', '.join(occupied)}, not written by an export or changed since: nothing is written; "
            f"choose another out=DIR, or overwrite=true"
        )


def _is_free(path: Path) -> bool:
    try:
        return is_sealed(read(path))
    except FileNotFoundError:
        return not os.path.lexists(path)
    except OSError:  # unreadable, or not a regular file
        return False


def check_folder(out: Path) -> None:
    """Raises UserError if the folder cannot be used: a file has its name, or it is a link in a run folder."""
    if out.exists() and not out.is_dir():
        raise UserError(f"out={out}: a file has that name")
    with _report_errors(out), contextlib.suppress(FileNotFoundError), open_folder(out):
        pass


def move_into(paths: Sequence[Path], out: Path) -> None:
    """Moves the files into the folder, which is created if needed, replacing files or links of the same names.

    The files are renamed only once all of them are complete. Links are replaced, not followed. Inside a run folder, a
    link in place of the folder is refused.

    Raises:
      UserError: the folder cannot be written, or one of the names belongs to a folder.
    """
    folders = [path.name for path in paths if (out / path.name).is_dir() and not (out / path.name).is_symlink()]
    if folders:
        raise UserError(f"out={out}: {', '.join(folders)} is a folder there")
    with _report_errors(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        with open_folder(out, make=True) as folder, _make_folder(folder, out) as place:
            for path in paths:
                shutil.copyfile(path, place / path.name)
            for path in paths:
                os.replace(place / path.name, path.name, dst_dir_fd=folder)


@contextlib.contextmanager
def _make_folder(folder: int, out: Path) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir=descriptor_path(folder, out), prefix=".export-") as place:
        yield Path(place)


@contextlib.contextmanager
def _report_errors(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise UserError(f"out={out}: cannot be written ({error.strerror})") from error
