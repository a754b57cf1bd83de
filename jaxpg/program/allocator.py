"""Returns memory that XLA's compiler has freed to the system."""

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
    """Returns freed memory to the system, if the C library can."""
    function = find_trim()
    if function is not None:
        function(0)


@contextlib.contextmanager
def trim_repeatedly() -> Iterator[None]:
    """Inside this context, returns freed memory to the system every half second and at the end.

    glibc keeps memory freed by a thread for that thread, and XLA compiles in many threads. Trimming lowers the peak of
    a cold run of the pendulum from 1.17 to 1.00 GB, and its memory while training from 1.1 to 0.6 GB.
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
