"""Ctrl-C and other signals: as an exception that does not get lost, or as a request to stop at the next occasion."""

from __future__ import annotations

import os
import signal
import sys
import threading
from types import FrameType
from typing import Any


def can_be_handled() -> bool:
    """Python hears signals in its main thread only; a training in another thread leaves them to the program."""
    return threading.current_thread() is threading.main_thread()


class Interrupts:
    """SIGINT as a KeyboardInterrupt that ends the block, whatever it was doing; as a context manager.

    An exception that is raised while Python collects garbage, in a callback that JAX has there, is printed and dropped:
    then Ctrl-C would have done nothing. So the signal is raised again until the block has ended; and where another
    exception has come of it on the way, it is a KeyboardInterrupt in the end.
    """

    AGAIN = 1.0  # seconds

    def __init__(self) -> None:
        self._heard, self._ended = False, threading.Event()

    def __enter__(self) -> Interrupts:
        self._before = signal.getsignal(signal.SIGINT)
        self._handles = can_be_handled() and self._before is signal.default_int_handler
        if self._handles:
            signal.signal(signal.SIGINT, self._note)
            self._hook, sys.unraisablehook = sys.unraisablehook, self._dropped
        return self

    def __exit__(self, kind: type[BaseException] | None, *exception: Any) -> None:
        self._ended.set()
        if self._handles:
            signal.signal(signal.SIGINT, self._before)
            if sys.unraisablehook == self._dropped:  # or another hook has come meanwhile, which hands on to it
                sys.unraisablehook = self._hook
        if self._heard and kind is not KeyboardInterrupt:
            raise KeyboardInterrupt

    def _note(self, number: int, frame: FrameType | None) -> None:
        if not self._heard:
            self._heard = True
            threading.Thread(target=self._raise_again, daemon=True).start()
        raise KeyboardInterrupt

    def _raise_again(self) -> None:
        while not self._ended.wait(self.AGAIN):
            os.kill(os.getpid(), signal.SIGINT)

    def _dropped(self, unraisable: Any) -> None:
        if self._ended.is_set() or unraisable.exc_type is not KeyboardInterrupt:
            self._hook(unraisable)


class StopRequests:
    """SIGINT, SIGTERM and SIGHUP as a request to stop at the next occasion; a second SIGINT stops at once.

    As a context manager; `signal` is the signal that came, or None. What the process was told to ignore, as `nohup`
    does with SIGHUP, stays ignored. In another thread than the main one no signal is heard.
    """

    HANDLED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

    def __enter__(self) -> StopRequests:
        self.signal: signal.Signals | None = None
        heard = [number for number in self.HANDLED if signal.getsignal(number) is not signal.SIG_IGN]
        self._before = {number: signal.signal(number, self._note) for number in heard if can_be_handled()}
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.signal = signal.Signals(number)
        if signal.SIGINT in self._before:
            signal.signal(signal.SIGINT, self._before[signal.SIGINT])
