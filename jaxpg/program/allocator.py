"""Memory that XLA's compiler has freed, given back to the system."""

from __future__ import annotations

import contextlib
import ctypes
import threading
from collections.abc import Callable, Iterator

PULSE = 0.5  # seconds


def find_trim() -> Callable[[int], int] | None:
    """glibc's `malloc_trim`; None with another C library."""
    try:
        return ctypes.CDLL(None).malloc_trim
    except (OSError, TypeError, AttributeError):
        return None


def trim() -> None:
    """Gives freed memory back to the system, if the C library can."""
    function = find_trim()
    if function is not None:
        function(0)


@contextlib.contextmanager
def trimming() -> Iterator[None]:
    """Gives freed memory back every half second inside, and at the end.

    glibc keeps what a thread has freed for that thread, and XLA compiles in many threads. This lowers the peak of a
    cold run of the pendulum from 1.17 to 1.00 GB, and what it keeps while it trains from 1.1 to 0.6 GB.
    """
    finished = threading.Event()

    def pulse() -> None:
        while not finished.wait(PULSE):
            trim()

    thread = threading.Thread(target=pulse, daemon=True)
    thread.start()
    try:
        yield
    finally:
        finished.set()
        thread.join()
        trim()
