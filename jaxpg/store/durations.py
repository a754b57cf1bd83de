"""How long compilations have taken on this machine."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Sequence

from jaxpg.store import texts
from jaxpg.store.cache_folder import TIMES, digest
from jaxpg.store.executables import machine


@contextlib.contextmanager
def record_duration(enabled: bool, what: str) -> Iterator[str]:
    """Writes down how long what is done inside takes; yields how long it has taken so far, in words.

    Args:
      enabled: without it nothing is read or written.
      what: its name; of each machine, by `machine()`, there are durations of its own.
    """
    records = texts.find(TIMES) if enabled else None
    name = digest(f"{machine()} {what}".encode())
    text = records.read(name) if records else None
    seconds = [float(x) for x in text.split()] if text else []
    began = time.monotonic()
    yield _in_words(seconds)
    if records:
        seconds.append(time.monotonic() - began)
        records.write(name, f"{min(seconds):.1f} {max(seconds):.1f}")


def _in_words(seconds: Sequence[float]) -> str:
    """The range of the durations, for the terminal.

    >>> _in_words([]), _in_words([2.04, 15.3]), _in_words([15.3, 15.3])
    ('for the first time here', '2.0 to 15.3 s here before', '15.3 s here before')
    """
    if not seconds:
        return "for the first time here"
    low, high = (f"{x:.1f}" for x in (min(seconds), max(seconds)))
    return f"{high} s here before" if low == high else f"{low} to {high} s here before"
