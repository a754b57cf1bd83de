"""Files that are put into a folder of the user's, and are known again there.

Each holds a seal, `jaxpg:` and a digest of everything else in the file: in a comment, or among what a format keeps
about itself. A file whose seal is right is as an export left it, and another export may replace it.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Sequence
from pathlib import Path

from jaxpg.run.errors import UserError
from jaxpg.run.files import opened

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
    theirs = [name for name in names if os.path.lexists(out / name) and not _is_ours(out / name)]
    if theirs:
        raise UserError(
            f"out={out}: {', '.join(theirs)} there: not written by an export, or changed since; "
            f"take another out=DIR, or overwrite=true"
        )


def _is_ours(path: Path) -> bool:
    try:
        return stat.S_ISREG(path.lstat().st_mode) and is_sealed(path.read_bytes())
    except OSError:
        return False


def move(paths: Sequence[Path], out: Path) -> None:
    """Puts the files into the folder, made where there is none, in the place of files or links of the same names.

    They are renamed once all of them are there whole. A link is replaced, not followed; one in the place of the folder
    is refused in a run folder.

    Raises:
      UserError: it cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        with opened(out), tempfile.TemporaryDirectory(dir=out, prefix=".export-") as place:
            for path in paths:
                shutil.copyfile(path, Path(place) / path.name)
            for path in paths:
                (Path(place) / path.name).replace(out / path.name)
    except OSError as error:
        where = error.filename2 or error.filename or out
        raise UserError(f"{where}: cannot be written ({error.strerror})") from error
