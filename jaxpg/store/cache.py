"""Compiled programs kept between runs, so that only the first run of a kind waits for XLA.

What jax's persistent compilation cache holds is machine code that will be executed, and jax trusts its folder: it
neither checks an entry nor ever replaces one that it cannot read. So jax gets a fresh temporary folder while a command
compiles. Entries are copied into it from the store, where each has its digest in its name, once the digest has been
verified; what jax adds is published in the store by renaming, which other processes see whole or not at all.

The store is `jaxpg` in the user's cache folder (XDG_CACHE_HOME, else ~/.cache), with one folder for each jaxlib, CPU,
XLA_FLAGS and number of threads: jax's own keys leave out the last one, and trust the CPU to be the same.

The equations of the environments' physics (`envs.physics.storage`) are kept beside them, in `physics`. They are text,
and the same on every machine. In `times` it is kept how long compilations have taken.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import shutil
import stat
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import jax
import jaxlib
from jax.experimental.compilation_cache import compilation_cache as jax_cache

from envs.physics import storage
from jaxpg.program.backend import num_threads
from jaxpg.store.stderr import filter_stderr

MAX_AGE = 30 * 24 * 3600.0  # seconds; an older entry is removed, and compiled anew when it is needed
MAX_BYTES = 64 * 2**20  # of all entries together: every start reads those of its folder. A training takes half a MB.
MAX_STAGING_AGE = 24 * 3600.0  # of the temporary folder of a process that was killed
STAGING = "staging-"
PHYSICS = "physics"
TIMES = "times"
REJECTED = "rejected"  # a file where the entries belong, on a machine that cannot load what it has compiled
UNREADABLE = "Error reading persistent compilation cache entry"


# What changes inside, JAX's settings, warnings and standard error, is the process's: several trainings in threads
# compile one after the other.
_ALONE = threading.RLock()


class CacheError(Exception):
    """A folder that compiled programs cannot be kept in; its text says why."""


@contextlib.contextmanager
def compilation_cache(enabled: bool, say: Callable[[str], None]) -> Iterator[None]:
    """What jax compiles inside comes from the store where it is there, and is kept in it where it is not.

    Nothing is changed where the user has set jax's own cache folder. Whatever is wrong with the store is one line, and
    then there is no cache or a smaller one; it never stops a command.

    Args:
      enabled: without it nothing is read or written.
      say: takes the line, if there is something to say.
    """
    with _ALONE:
        yield from _cached(enabled, say)


def _cached(enabled: bool, say: Callable[[str], None]) -> Iterator[None]:
    if not enabled or jax.config.jax_compilation_cache_dir is not None:
        with filter_stderr():
            yield
        return
    try:
        store = Store(cache_folder())
        staging = store.stage()
    except (CacheError, OSError) as error:
        say(f"note: no compilation cache: {error}")
        with filter_stderr():
            yield
        return
    with staging:
        yield from _compile_in(store, Path(staging.name), say)


def _compile_in(store: Store, staging: Path, say: Callable[[str], None]) -> Iterator[None]:
    with warnings.catch_warnings(record=True) as caught, filter_stderr() as seen:
        warnings.simplefilter("always")
        with _jax_cache_in(staging):
            yield
    rejected = seen.refused
    for warning in caught:
        if str(warning.message).startswith(UNREADABLE):
            rejected = True
        else:
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    try:
        store.reject() if rejected else store.publish(staging)
    except OSError as error:
        say(f"note: compiled programs could not be kept: {error}")
    for line in store.notes:
        say(f"note: {line}")


@contextlib.contextmanager
def _jax_cache_in(folder: Path) -> Iterator[None]:
    """jax's persistent cache in this folder, for every program however small; afterwards as it was before."""
    settings = {
        "jax_compilation_cache_dir": str(folder),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_enable_xla_caches": "none",
    }
    before = {name: getattr(jax.config, name) for name in settings}
    try:
        _configure(settings)
        yield
    finally:
        _configure(before)


def _configure(settings: dict) -> None:
    for name, value in settings.items():
        jax.config.update(name, value)
    jax_cache.reset_cache()  # jax looks at its settings once, at the first compilation


@contextlib.contextmanager
def physics_cache(enabled: bool) -> Iterator[None]:
    """Equations of physics that are made inside come from the user's cache folder where they are there.

    Where there can be no such folder they are made anew; that there is none is said where programs are compiled.

    Args:
      enabled: without it nothing is read or written.
    """
    texts = None
    if enabled:
        with contextlib.suppress(CacheError, OSError):
            texts = Texts(cache_folder())
    with _ALONE, storage.kept_in(texts):
        yield


@contextlib.contextmanager
def timed(enabled: bool, what: str) -> Iterator[str]:
    """Keeps how long what is done inside takes, by its name; yields how long it has taken so far, in words.

    Args:
      enabled: without it nothing is read or written.
      what: its name; of each machine, by `machine()`, there are times of its own.
    """
    texts = None
    if enabled:
        with contextlib.suppress(CacheError, OSError):
            texts = Texts(cache_folder(), TIMES)
    name = _digest(f"{machine()} {what}".encode())
    known = texts.read(name) if texts else None
    times = [float(x) for x in known.split()] if known else []
    began = time.monotonic()
    yield _in_words(times)
    if texts:
        times.append(time.monotonic() - began)
        texts.write(name, f"{min(times):.1f} {max(times):.1f}")


def _in_words(times: Sequence[float]) -> str:
    """
    >>> _in_words([]), _in_words([2.04, 15.3]), _in_words([15.3, 15.3])
    ('for the first time here', '2.0 to 15.3 s here before', '15.3 s here before')
    """
    if not times:
        return "for the first time here"
    low, high = (f"{x:.1f}" for x in (min(times), max(times)))
    return f"{high} s here before" if low == high else f"{low} to {high} s here before"


class Texts:
    """Texts by name, each in a file with its digest in its name; a damaged one is as if it were not there.

    Args:
      root: the cache folder.
      kind: the folder in it.

    Raises:
      CacheError: the folder is not the user's alone; OSError: there can be none.
    """

    def __init__(self, root: Path, kind: str = PHYSICS):
        self.folder = root / kind
        _make_private(root, self.folder)

    def read(self, name: str) -> str | None:
        for path in self.folder.glob(f"{name}.*"):
            with contextlib.suppress(OSError):
                content = path.read_bytes()
                if path.name == f"{name}.{_digest(content)}":
                    return content.decode()
        return None

    def write(self, name: str, text: str) -> None:
        """Keeps the text instead of what was kept under its name; without a word where that is not possible."""
        content = text.encode()
        with (
            contextlib.suppress(OSError),
            tempfile.TemporaryDirectory(prefix=STAGING, dir=self.folder.parent) as folder,
        ):
            path = Path(folder) / f"{name}.{_digest(content)}"
            path.write_bytes(content)
            for damaged in self.folder.glob(f"{name}.*"):
                damaged.unlink(missing_ok=True)
            path.replace(self.folder / path.name)


def _make_private(root: Path, folder: Path) -> None:
    """Makes both where they are not there; raises CacheError unless they are the user's alone."""
    root.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    for path in (root, folder):
        path.mkdir(mode=0o700, exist_ok=True)
        check_private(path)


class Store:
    """The entries that belong to this jaxlib, CPU, XLA_FLAGS and number of threads.

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
        _make_private(root, self.folder)

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
        for path in _entries(self.folder):
            name, _, digest = path.name.rpartition(".")
            content = path.read_bytes()
            if _digest(content) == digest:
                (staging / name).write_bytes(content)
                self.loaded.add(name)
            else:
                path.unlink(missing_ok=True)
                damaged += 1
        if damaged:
            self.notes.append(f"{damaged} damaged of the compiled programs in {self.folder}: removed")

    def publish(self, staging: Path) -> None:
        """Moves the entries that jax has added since `stage` into the store."""
        for path in staging.iterdir():
            if path.is_file() and path.name not in self.loaded:
                path.replace(self.folder / f"{path.name}.{_digest(path.read_bytes())}")

    def reject(self) -> None:
        """Removes the entries, which XLA would not load, and keeps no others."""
        for path in _entries(self.folder):
            path.unlink(missing_ok=True)
        (self.folder / REJECTED).touch()
        self.notes.append("XLA did not load its own compiled programs: they are no longer kept on this machine")


def cache_folder() -> Path:
    """`jaxpg` in the user's cache folder; raises CacheError where the user has none."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    try:
        return (Path(given) if os.path.isabs(given) else Path.home() / ".cache") / "jaxpg"
    except RuntimeError as error:
        raise CacheError("the user has no home folder") from error


def machine() -> str:
    """The name of the folder for what was compiled here."""
    flags = os.environ.get("XLA_FLAGS", "").encode()
    return f"jaxlib-{jaxlib.__version__}-cpu-{_digest(cpu_features())}-flags-{_digest(flags)}-threads-{num_threads()}"


def cpu_features() -> bytes:
    """What the CPU can do, as far as the system says: the flags of the first core, or else its name."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_bytes().splitlines():
            if line.startswith((b"flags", b"Features")):
                return line
    return f"{platform.machine()} {platform.processor()}".encode()


def check_private(folder: Path) -> None:
    """Raises CacheError unless `folder` is a real folder that belongs to this user and that no other can write to."""
    found = folder.lstat()
    if stat.S_ISLNK(found.st_mode) or not stat.S_ISDIR(found.st_mode):
        raise CacheError(f"{folder} is not a folder of its own")
    if found.st_uid != os.getuid():
        raise CacheError(f"{folder} belongs to another user")
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise CacheError(f"{folder} can be written to by others")


def remove_old(root: Path, now: float | None = None) -> None:
    """Keeps the newest entries of all machines, up to `MAX_AGE` and `MAX_BYTES`; removes left temporary folders."""
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


def _entries(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.name != REJECTED]


def _digest(content: bytes) -> str:
    return hashlib.blake2b(content, digest_size=16).hexdigest()
