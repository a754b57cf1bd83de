"""A watchdog for computations that never end: some jaxlib releases wait for ever, without a word, on a CPU."""

from __future__ import annotations

import faulthandler
import statistics
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

import jaxlib

from jaxpg.compatibility import may_deadlock

PATIENCE = 10.0  # times the median chunk
AT_LEAST = 120.0  # seconds
PULSE = 1.0  # seconds between two looks
RECENT = 101  # chunks that the median is of


class Watchdog:
    """Speaks up on standard error when a chunk takes ten times as long as the others did, and at least two minutes.

    Once for each chunk; it stops nothing. Time in which the process itself was stopped or asleep does not count: the
    watchdog counts its own pulses.

    Args:
      at_least, patience, pulse: as `AT_LEAST`, `PATIENCE` and `PULSE`.
    """

    def __init__(self, at_least: float = AT_LEAST, patience: float = PATIENCE, pulse: float = PULSE):
        self._at_least, self._patience, self._pulse = at_least, patience, pulse
        self._durations: deque[float] = deque(maxlen=RECENT)

    @property
    def limit(self) -> float:
        """Seconds after which it speaks up."""
        usual = statistics.median(self._durations) if self._durations else 0.0
        return max(self._at_least, self._patience * usual)

    @contextmanager
    def chunk(self, name: str) -> Iterator[None]:
        """Watches over what is computed inside; `name` says what it is."""
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
        print(f"warning: {name} has not ended after {self.limit:.0f} s: {likely_cause()}", file=sys.stderr, flush=True)
        faulthandler.dump_traceback(file=sys.stderr)


def likely_cause() -> str:
    """Why a computation may not end, in words that say what to do."""
    if may_deadlock(jaxlib.__version__):
        return (
            f"jaxlib {jaxlib.__version__} can wait for ever in batched LAPACK calls, which environments of one's own "
            "or of brax may make; PJRT_NPROC=1 avoids it, as does jaxlib 0.12. Where each thread is:"
        )
    return "the machine may be out of memory, or busy with other work. Where each thread is:"
