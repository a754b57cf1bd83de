"""A watchdog for computations that never end: on a CPU, some jaxlib releases can hang silently."""

from __future__ import annotations

import faulthandler
import statistics
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

import jaxlib.version

from jaxpg.compatibility import may_deadlock

PATIENCE = 10.0  # multiple of the median duration of a chunk
MIN_LIMIT = 120.0  # seconds
PULSE = 1.0  # seconds between two checks
RECENT = 101  # chunks that the median is taken over


class Watchdog:
    """Warns on standard error when a chunk takes ten times as long as the others, and at least two minutes.

    It warns once per chunk and stops nothing. It counts its own pulses, so time in which the process was stopped or the
    machine asleep does not count.

    Args:
      at_least, patience, pulse: see `MIN_LIMIT`, `PATIENCE` and `PULSE`.
    """

    def __init__(self, at_least: float = MIN_LIMIT, patience: float = PATIENCE, pulse: float = PULSE):
        self._at_least, self._patience, self._pulse = at_least, patience, pulse
        self._durations: deque[float] = deque(maxlen=RECENT)

    @property
    def limit(self) -> float:
        """Seconds after which it warns."""
        usual = statistics.median(self._durations) if self._durations else 0.0
        return max(self._at_least, self._patience * usual)

    @contextmanager
    def chunk(self, name: str) -> Iterator[None]:
        """Watches the computation in the block; `name` describes it."""
        finished = threading.Event()
        guard = threading.Thread(target=self._guard, args=(name, finished), daemon=True)
        began = time.monotonic()
        guard.start()
        try:
            yield
        finally:
            finished.set()
            guard.join()
        self._durations.append(time.monotonic() - began)

    def _guard(self, name: str, finished: threading.Event) -> None:
        pulses = int(self.limit / self._pulse)
        for _ in range(pulses):
            if finished.wait(self._pulse):
                return
        warning = f"warning: {name} has been running for {self.limit:.0f} s: {describe_cause()}"
        print(warning, file=sys.stderr, flush=True)
        faulthandler.dump_traceback(file=sys.stderr)


def describe_cause() -> str:
    """Why a computation may not end, and what to do about it."""
    version = jaxlib.version.__version__
    if may_deadlock(version):
        return (
            f"jaxlib {version} can hang in batched LAPACK calls, which brax's and your own environments may "
            "make; PJRT_NPROC=1 or jaxlib 0.12 avoids it. Where each thread is:"
        )
    return "the machine may be out of memory, or busy with other work. Where each thread is:"
