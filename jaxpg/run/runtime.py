"""What has to be settled before JAX starts its CPU backend, and requests to stop while it computes."""

from __future__ import annotations

import os
import signal
from types import FrameType

import jaxlib

from jaxpg.compatibility import may_deadlock
from jaxpg.run.config import Config
from jaxpg.run.folder import num_threads


def prepare(config: Config, threads: int | None = None) -> None:
    """Pins the number of XLA's threads, on which the bits of large reductions depend.

    Args:
      config: brax's environments make LAPACK calls, which need a single thread on some jaxlib releases.
      threads: those of the run that is resumed; by default as many as there are cores.
    """
    if threads is None and config.choices["env"] == "brax" and may_deadlock(jaxlib.__version__):
        threads = 1
    os.environ["PJRT_NPROC"] = str(threads or num_threads())


class StopRequests:
    """SIGINT and SIGTERM as a request to stop at the next occasion; a second SIGINT stops at once.

    As a context manager; `signal` is the signal that came, or None.
    """

    HANDLED = (signal.SIGINT, signal.SIGTERM)

    def __enter__(self) -> StopRequests:
        self.signal: signal.Signals | None = None
        self._before = {number: signal.signal(number, self._note) for number in self.HANDLED}
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.signal = signal.Signals(number)
        signal.signal(signal.SIGINT, signal.default_int_handler)
