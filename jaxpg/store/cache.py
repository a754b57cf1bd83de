"""Caches between runs, so that only the first run of a kind waits for XLA and for MJX.

What jax's persistent compilation cache holds is machine code that will be executed, and jax trusts its folder: it
neither checks an entry nor ever replaces one that it cannot read. So jax gets a fresh temporary folder while a command
compiles. Entries are copied into it from the user's cache folder once their digests have been verified; what jax adds
is moved there afterwards. The equations of the environments' physics (`envs.physics.storage`) are text, and the same on
every machine.
"""

from __future__ import annotations

import contextlib
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache as jax_cache

from envs.physics import storage
from jaxpg.store import cache_folder, texts
from jaxpg.store.cache_folder import PHYSICS, CacheError
from jaxpg.store.executables import Executables
from jaxpg.store.stderr import filter_stderr

UNREADABLE = "Error reading persistent compilation cache entry"

# What changes inside, JAX's settings, warnings and standard error, is the process's: several trainings in threads
# compile one after the other.
_ALONE = threading.RLock()


@contextlib.contextmanager
def physics_cache(enabled: bool) -> Iterator[None]:
    """Equations of physics that are made inside come from the user's cache folder where they are there.

    Where there can be no such folder they are made anew; that there is none is said where programs are compiled.

    Args:
      enabled: without it nothing is read or written.
    """
    with _ALONE, storage.use_store(texts.find(PHYSICS) if enabled else None):
        yield


@contextlib.contextmanager
def compilation_cache(enabled: bool, say: Callable[[str], None]) -> Iterator[None]:
    """What jax compiles inside comes from the user's cache folder, or is added to it where it is not there.

    Nothing is changed where the user has set jax's own cache folder. Whatever is wrong with the user's is one line, and
    then there is no cache or a smaller one; it never stops a command.

    Args:
      enabled: without it nothing is read or written.
      say: takes the line, if there is something to say.
    """
    with _ALONE:
        staged = _stage(say) if enabled and jax.config.values["jax_compilation_cache_dir"] is None else None
        if staged is None:
            with filter_stderr():
                yield
        else:
            executables, staging = staged
            with staging as folder:
                yield from _compile_in(executables, Path(folder), say)


def _stage(say: Callable[[str], None]) -> tuple[Executables, tempfile.TemporaryDirectory] | None:
    """The compiled programs, and a temporary folder with them; None, and a line, where there can be none."""
    try:
        executables = Executables(cache_folder.locate())
        return executables, executables.stage()
    except (CacheError, OSError) as error:
        say(f"note: no compilation cache: {error}")
        return None


def _compile_in(executables: Executables, staging: Path, say: Callable[[str], None]) -> Iterator[None]:
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
        executables.reject() if rejected else executables.publish(staging)
    except OSError as error:
        say(f"note: compiled programs could not be kept: {error}")
    for line in executables.notes:
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
