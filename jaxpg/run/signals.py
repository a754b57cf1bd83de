"""Ctrl-C and other signals: as an exception that cannot get lost, or as a request to stop soon."""

from __future__ import annotations

import os
import signal
import sys
import threading
from types import FrameType
from typing import Any


def can_be_handled() -> bool:
    """Whether signals can be handled here: Python does so in the main thread only."""
    return threading.current_thread() is threading.main_thread()


class Interrupts:
    """Context manager in which SIGINT reliably ends the block with a KeyboardInterrupt.

    Python prints and drops an exception that is raised during garbage collection, for example in one of JAX's
    callbacks, and Ctrl-C would have no effect. So the signal is raised again until the block has ended. If it led to
    another exception on the way, that becomes a KeyboardInterrupt.
    """

    AGAIN = 1.0  # seconds

    def __init__(self) -> None:
        self._is_interrupted, self._ended = False, threading.Event()

    def __enter__(self) -> Interrupts:
        self._before = signal.getsignal(signal.SIGINT)
        self._handles = can_be_handled() and self._before is signal.default_int_handler
        if self._handles:
            signal.signal(signal.SIGINT, self._handle)
            self._hook, sys.unraisablehook = sys.unraisablehook, self._handle_unraisable
        return self

    def __exit__(self, kind: type[BaseException] | None, *exception: Any) -> None:
        self._ended.set()
        if self._handles:
            signal.signal(signal.SIGINT, self._before)
            if sys.unraisablehook == self._handle_unraisable:  # else a later hook calls it
                sys.unraisablehook = self._hook
        if self._is_interrupted and kind is not KeyboardInterrupt:
            raise KeyboardInterrupt

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if not self._is_interrupted:
            self._is_interrupted = True
            threading.Thread(target=self._raise_again, daemon=True).start()
        raise KeyboardInterrupt

    def _raise_again(self) -> None:
        while not self._ended.wait(self.AGAIN):
            os.kill(os.getpid(), signal.SIGINT)

    def _handle_unraisable(self, unraisable: Any) -> None:
        if self._ended.is_set() or unraisable.exc_type is not KeyboardInterrupt:
            self._hook(unraisable)


class StopRequests:
    """Context manager in which SIGINT, SIGTERM and SIGHUP request a stop; a second SIGINT stops at once.

    `signal` is the signal that was received, or None. Signals that the process ignores, as SIGHUP under `nohup`, stay
    ignored. Outside of the main thread no signal is handled.
    """

    HANDLED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

    def __enter__(self) -> StopRequests:
        self.signal: signal.Signals | None = None
        numbers = [number for number in self.HANDLED if signal.getsignal(number) is not signal.SIG_IGN]
        self._before = {number: signal.signal(number, self._handle) for number in numbers if can_be_handled()}
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.signal = signal.Signals(number)
        if signal.SIGINT in self._before:
            signal.signal(signal.SIGINT, self._before[signal.SIGINT])
