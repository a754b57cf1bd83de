"""Files that are put into a folder of the user's, and are known again there.

Each holds a seal, `jaxpg:` and a digest of everything else in the file: in a comment, or among what a format keeps
about itself. A file whose seal is right is as an export left it, and another export may replace it.
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
from jaxpg.store.files import opened, read, through

NO_SEAL = "jaxpg:" + 16 * "0"
SEAL = re.compile(rb"jaxpg:[0-9a-f]{16}")


def sealed(content: bytes) -> bytes:
    """The content of a file with its seal where `NO_SEAL` stood.

    >>> is_sealed(sealed(f"/* {NO_SEAL} */".encode()))
    True
    """
    return content.replace(NO_SEAL.encode(), _seal(content))


def is_sealed(content: bytes) -> bool:
    """Whether the content is what `sealed` gave, in every byte."""
    return set(SEAL.findall(content)) == {_seal(SEAL.sub(NO_SEAL.encode(), content))}


def _seal(content: bytes) -> bytes:
    return b"jaxpg:" + hashlib.sha256(content).hexdigest()[:16].encode()


def check_replaceable(names: Sequence[str], out: Path) -> None:
    """Looks for files of the user's where others are to be written.

    Args:
      names: of files.
      out: the folder, which need not be there.

    Raises:
      UserError: under one of the names there is something else than a sealed file: the user's own or changed file, a
        link, a folder.
    """
    theirs = [name for name in names if not _is_free(out / name)]
    if theirs:
        raise UserError(
            f"out={out} holds {', '.join(theirs)}, not written by an export, or changed since: nothing is written; "
            f"take another out=DIR, or overwrite=true"
        )


def _is_free(path: Path) -> bool:
    try:
        return is_sealed(read(path))
    except FileNotFoundError:
        return not os.path.lexists(path)
    except OSError:  # it cannot be read, or is no file of its own
        return False


def check_folder(out: Path) -> None:
    """Raises UserError where there can be no such folder to write into: a file is there, or a link in a run folder."""
    if out.exists() and not out.is_dir():
        raise UserError(f"out={out}: there is a file of that name")
    with _reported(out), contextlib.suppress(FileNotFoundError), opened(out):
        pass


def move(paths: Sequence[Path], out: Path) -> None:
    """Puts the files into the folder, made where there is none, in the place of files or links of the same names.

    They are renamed once all of them are there whole. A link is replaced, not followed; one in the place of the folder
    is refused in a run folder.

    Raises:
      UserError: it cannot be written, or one of the names is a folder's.
    """
    folders = [path.name for path in paths if (out / path.name).is_dir() and not (out / path.name).is_symlink()]
    if folders:
        raise UserError(f"out={out}: {', '.join(folders)} there is a folder")
    with _reported(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        with opened(out, make=True) as folder, _folder_in(folder, out) as place:
            for path in paths:
                shutil.copyfile(path, place / path.name)
            for path in paths:
                os.replace(place / path.name, path.name, dst_dir_fd=folder)


@contextlib.contextmanager
def _folder_in(folder: int, out: Path) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir=through(folder, out), prefix=".export-") as place:
        yield Path(place)


@contextlib.contextmanager
def _reported(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise UserError(f"out={out}: cannot be written ({error.strerror})") from error
