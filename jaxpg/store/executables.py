"""Compiled programs on the disk, each with its digest in its name.

They are in one folder for each jaxlib, CPU, XLA_FLAGS and number of threads: jax's own keys leave out the last one, and
trust the CPU to be the same. What is there is machine code that will be executed, so it is verified first.
"""

from __future__ import annotations

import contextlib
import os
import platform
import tempfile
from pathlib import Path

import jaxlib.version

from jaxpg.program.backend import count_threads
from jaxpg.store.cache_folder import STAGING, CacheError, digest, make_private, remove_old

REJECTED = "rejected"  # a file where the entries belong, on a machine that cannot load what it has compiled


class Executables:
    """The entries that belong to this jaxlib, CPU, XLA_FLAGS and number of threads.

    Args:
      root: the cache folder.

    Attributes:
      folder: where they are.
      loaded: names of the entries that `stage` found intact.
      notes: what was wrong, one line each.

    Raises:
      CacheError: the folder is not the user's alone.
    """

    def __init__(self, root: Path):
        self.root, self.folder = root, root / machine()
        self.loaded: set[str] = set()
        self.notes: list[str] = []
        make_private(root, self.folder)

    def stage(self) -> tempfile.TemporaryDirectory:
        """A temporary folder with every entry that is intact; those that are not are removed."""
        remove_old(self.root)
        if (self.folder / REJECTED).exists():
            raise CacheError("XLA cannot load on this machine what it has compiled here")
        staging = tempfile.TemporaryDirectory(prefix=STAGING, dir=self.root)
        try:
            self._load_into(Path(staging.name))
        except OSError:
            staging.cleanup()
            raise
        return staging

    def _load_into(self, staging: Path) -> None:
        damaged = 0
        for path in self._entries():
            name, _, known = path.name.rpartition(".")
            content = path.read_bytes()
            if digest(content) == known:
                (staging / name).write_bytes(content)
                self.loaded.add(name)
            else:
                path.unlink(missing_ok=True)
                damaged += 1
        if damaged:
            self.notes.append(f"{damaged} damaged of the compiled programs in {self.folder}: removed")

    def publish(self, staging: Path) -> None:
        """Moves what has been added to the temporary folder since `stage` here; others see it whole or not at all."""
        for path in staging.iterdir():
            if path.is_file() and path.name not in self.loaded:
                path.replace(self.folder / f"{path.name}.{digest(path.read_bytes())}")

    def reject(self) -> None:
        """Removes the entries, which XLA would not load, and lets no others in."""
        for path in self._entries():
            path.unlink(missing_ok=True)
        (self.folder / REJECTED).touch()
        self.notes.append("XLA did not load its own compiled programs: they are no longer kept on this machine")

    def _entries(self) -> list[Path]:
        return [path for path in self.folder.iterdir() if path.name != REJECTED]


def machine() -> str:
    """The name of the folder for what was compiled here."""
    version, flags = jaxlib.version.__version__, os.environ.get("XLA_FLAGS", "").encode()
    return f"jaxlib-{version}-cpu-{digest(cpu_features())}-flags-{digest(flags)}-threads-{count_threads()}"


def cpu_features() -> bytes:
    """What the CPU can do, as far as the system says: the flags of the first core, or else its name."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_bytes().splitlines():
            if line.startswith((b"flags", b"Features")):
                return line
    return f"{platform.machine()} {platform.processor()}".encode()
