"""Files of a run, read and replaced; what the operating system refuses is a `UserError` of one line."""

from __future__ import annotations

from pathlib import Path

from jaxpg.errors import UserError
from jaxpg.store import files


def replace(path: str | Path, content: str | bytes) -> None:
    """Replaces a file atomically, see `files.replace`.

    Args:
      path: the file, in an existing folder.
      content: text is written as UTF-8, with lone surrogates, which file names may contain, as escapes.

    Raises:
      UserError: the file cannot be written.
    """
    data = content.encode("utf-8", "backslashreplace") if isinstance(content, str) else content
    try:
        files.replace(Path(path), data)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror})") from error


def read(path: Path) -> str:
    """The text of a file.

    Raises:
      UserError: it is missing, not a file, not text, or a link in a run folder.
    """
    try:
        return files.read(path).decode()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: cannot be read (it is not UTF-8 text)") from error
