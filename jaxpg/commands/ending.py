"""How commands end: a user's mistakes give one line each and status 2; our own mistakes give a traceback."""

from __future__ import annotations

import errno
import gc
import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import Any, TextIO

from envs.options import OptionError
from envs.physics import MujocoModelError
from jaxpg.errors import UserError
from jaxpg.run.signals import Interrupts

INTERRUPTED = 130  # exit status, as in shells
# Errors of a file or a folder of the user's; any other OSError is our mistake.
USER_ERRORS = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EISDIR)
USER_ERRORS += (errno.ENOSPC, errno.EDQUOT, errno.EIO)


def run_command(main: Callable[[Sequence[str]], int | None]) -> None:
    """Runs `sys.exit(main(arguments))`; a user's mistake ends in its message and status 2."""
    interrupted = False
    with _redirect_output(), _print_warnings():
        try:
            with Interrupts():
                status = main(sys.argv[1:])
        except OptionError as error:
            status = _report(error.problems)
        except (UserError, MujocoModelError) as error:
            status = _report([str(error)])
        except OSError as error:
            if error.filename is None or error.errno not in USER_ERRORS:
                raise
            status = _report([f"{os.fsdecode(error.filename)}: {error.strerror}"])
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            status, interrupted = INTERRUPTED, True
    if interrupted and threading.active_count() > 1:
        os._exit(INTERRUPTED)  # XLA cannot be interrupted while it compiles, and Python would wait for its threads
    gc.freeze()  # without this, the last garbage collections of the interpreter take half a second
    sys.exit(status)


class WarningPrinter(logging.Handler):
    """Prints each line that is logged as a warning once, as it is.

    A command makes its environment more than once, for training and for the report. And without a handler the first
    library that logs by `absl` would give all later lines the form of `logging.basicConfig`.
    """

    def __init__(self):
        super().__init__(logging.WARNING)
        self._printed: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        line = self.format(record)
        if line not in self._printed:
            self._printed.add(line)
            print(line, file=sys.stderr)


@contextmanager
def _print_warnings() -> Iterator[None]:
    printer, root = WarningPrinter(), logging.getLogger()
    root.addHandler(printer)
    try:
        yield
    finally:
        root.removeHandler(printer)


def _report(problems: Sequence[str]) -> int:
    for problem in problems:
        print(f"error: {problem}", file=sys.stderr)
    return 2


class UnbreakableStream:
    """A text stream that silently drops its output once its reader is gone, as after `| head`, or its disk is full.

    Args:
      stream: where the text goes; characters that it cannot encode are escaped. None discards everything.
      descriptor: the stream's file descriptor; redirected to the null device when the stream breaks.
    """

    def __init__(self, stream: TextIO | None, descriptor: int):
        self._stream = open(os.devnull, "w", encoding="utf-8") if stream is None else stream  # noqa: SIM115
        self._descriptor = descriptor
        reconfigure = getattr(self._stream, "reconfigure", None)
        if reconfigure is not None:
            reconfigure(errors="backslashreplace")

    def write(self, text: str) -> int:
        return self._try(self._stream.write, text)

    def flush(self) -> None:
        self._try(self._stream.flush)

    def _try(self, function: Callable, *arguments: Any) -> Any:
        try:
            return function(*arguments)
        except OSError:
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self._descriptor)
            os.close(null)
            return function(*arguments)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def _redirect_output() -> Iterator[None]:
    out, error = UnbreakableStream(sys.stdout, 1), UnbreakableStream(sys.stderr, 2)
    with redirect_stdout(out), redirect_stderr(error):
        try:
            yield
        finally:
            out.flush()
            error.flush()
