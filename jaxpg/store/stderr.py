"""Standard error while XLA compiles: without its alarms, and without its lines about another machine.

They are written by C++, so the file descriptor itself is led through a pipe. Who reads that is a process of its own, as
which this file is run: if the compiler ends the training's process, its last words are passed on all the same.
"""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
from collections.abc import Iterator

# XLA's words for a program that it takes for another machine's; some CPUs never know their own.
OTHER_MACHINE = b"Machine type used for XLA:CPU compilation"
# The same of what is no capability but a choice between instructions, which it makes on every CPU with AVX-512.
PREFERENCE = re.compile(rb"feature \+?prefer-")
# After two minutes: "Very slow compile? If you want to file a bug ...", between lines of asterisks.
ALARM = re.compile(rb"slow_operation_alarm\.cc|Very slow compile\?|^\*{8,}$|^The operation took ")
REFUSED = 3  # exit status of the process where XLA has refused a program as another machine's
PATIENCE = 5.0  # seconds; what was started meanwhile may hold the pipe for longer


class Seen:
    """What has come by; `refused`: whether XLA took a program for another machine's."""

    refused = False


@contextlib.contextmanager
def filtered() -> Iterator[Seen]:
    """Standard error is filtered inside; where there is none, or no process to filter it, nothing is changed.

    Yields:
      What has come by, complete only afterwards.
    """
    seen = Seen()
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            stack.enter_context(_led_through_a_process(seen))
        yield seen


@contextlib.contextmanager
def _led_through_a_process(seen: Seen) -> Iterator[None]:
    before, (reader, writer) = os.dup(2), os.pipe()
    try:
        # In a session of its own, where Ctrl-C does not reach it.
        command = [sys.executable, "-I", "-S", __file__]
        process = subprocess.Popen(command, stdin=reader, stdout=subprocess.DEVNULL, start_new_session=True)
    except OSError:
        for descriptor in (before, writer):
            os.close(descriptor)
        raise
    finally:
        os.close(reader)
    os.dup2(writer, 2)
    os.close(writer)
    try:
        yield
    finally:
        os.dup2(before, 2)  # closes the pipe's last writing end: the process ends
        os.close(before)
        with contextlib.suppress(subprocess.TimeoutExpired):
            seen.refused = process.wait(PATIENCE) == REFUSED


def main() -> int:
    """Copies standard input to standard error, but for XLA's noise."""
    refused = dropped = False
    for line in sys.stdin.buffer:
        other_machine = OTHER_MACHINE in line
        refused |= other_machine and not PREFERENCE.search(line)
        dropped = other_machine or bool(ALARM.search(line)) or (dropped and not line.strip())
        if not dropped:
            with contextlib.suppress(OSError):
                sys.stderr.buffer.write(line)
                sys.stderr.buffer.flush()
    return REFUSED if refused else 0


if __name__ == "__main__":
    sys.exit(main())
