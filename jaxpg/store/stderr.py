"""Filters standard error while XLA compiles: removes its alarms and its messages about another machine.

They are written by C++, so the file descriptor itself is redirected to a pipe. A separate process, which runs this
file, reads the pipe: even if the compiler aborts the training process, its last messages get through.
"""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator

# XLA's message for a program that it takes for another machine's; some CPUs do not recognise their own.
OTHER_MACHINE = b"Machine type used for XLA:CPU compilation"
# The same message for a preference, not a capability; it appears on every CPU with AVX-512.
PREFERENCE = re.compile(rb"feature \+?prefer-")
# After two minutes: "Very slow compile? If you want to file a bug ...", between lines of asterisks.
ALARM = re.compile(rb"slow_operation_alarm\.cc|Very slow compile\?|^\*{8,}$|^The operation took ")
REFUSED = 3  # exit status of the filter if XLA refused a program as another machine's
PATIENCE = 5.0  # seconds; processes started in the meantime may keep the pipe open longer


class FilterResult:
    """What the filter saw; `refused`: whether XLA took a program for another machine's."""

    refused = False


@contextlib.contextmanager
def filter_stderr() -> Iterator[FilterResult]:
    """Filters standard error in the block; does nothing if that is impossible.

    Yields:
      What the filter saw, complete only after the block.
    """
    result = FilterResult()
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            stack.enter_context(_pipe_through_filter(result))
        yield result


@contextlib.contextmanager
def _pipe_through_filter(result: FilterResult) -> Iterator[None]:
    original, (reader, writer) = os.dup(2), os.pipe()
    try:
        # In its own session, so that Ctrl-C does not reach it.
        command = [sys.executable, "-I", "-S", __file__]
        process = subprocess.Popen(command, stdin=reader, stdout=subprocess.DEVNULL, start_new_session=True)
    except OSError:
        for descriptor in (original, writer):
            os.close(descriptor)
        raise
    finally:
        os.close(reader)
    os.dup2(writer, 2)
    os.close(writer)
    try:
        yield
    finally:
        os.dup2(original, 2)  # closes the pipe's last writing end, so the process ends
        os.close(original)
        try:
            result.refused = process.wait(PATIENCE) == REFUSED
        except subprocess.TimeoutExpired:  # a busy machine, or a process that holds the pipe open
            threading.Thread(target=process.wait, daemon=True).start()


def main() -> int:
    """Copies standard input to standard error, without XLA's noise."""
    is_refused = is_dropped = False
    for line in sys.stdin.buffer:
        other_machine = OTHER_MACHINE in line
        is_refused |= other_machine and not PREFERENCE.search(line)
        is_dropped = other_machine or bool(ALARM.search(line)) or (is_dropped and not line.strip())
        if not is_dropped:
            with contextlib.suppress(OSError):
                sys.stderr.buffer.write(line)
                sys.stderr.buffer.flush()
    return REFUSED if is_refused else 0


if __name__ == "__main__":
    sys.exit(main())
