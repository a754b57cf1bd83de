"""Texts in the user's cache folder, by name."""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path

from jaxpg.store import cache_folder
from jaxpg.store.cache_folder import STAGING, CacheError, digest, make_private


class Texts:
    """Texts by name, each in a file with its digest in its name; a damaged one is as if it were not there.

    Args:
      root: the cache folder.
      kind: the folder in it.

    Raises:
      CacheError: the folder is not the user's alone. OSError: there can be none.
    """

    def __init__(self, root: Path, kind: str):
        self.folder = root / kind
        make_private(root, self.folder)

    def read(self, name: str) -> str | None:
        """The text; None where there is none."""
        for path in self.folder.glob(f"{name}.*"):
            with contextlib.suppress(OSError):
                content = path.read_bytes()
                if path.name == f"{name}.{digest(content)}":
                    return content.decode()
        return None

    def write(self, name: str, text: str) -> None:
        """Writes the text instead of any other under its name; without a word where that is not possible."""
        content = text.encode()
        with (
            contextlib.suppress(OSError),
            tempfile.TemporaryDirectory(prefix=STAGING, dir=self.folder.parent) as folder,
        ):
            path = Path(folder) / f"{name}.{digest(content)}"
            path.write_bytes(content)
            for damaged in self.folder.glob(f"{name}.*"):
                damaged.unlink(missing_ok=True)
            path.replace(self.folder / path.name)


def find(kind: str) -> Texts | None:
    """The user's texts of a kind; None where there can be none, which is said where programs are compiled."""
    try:
        return Texts(cache_folder.locate(), kind)
    except (CacheError, OSError):
        return None
