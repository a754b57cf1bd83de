"""The process of a logger: `python -m jaxpg.store.loggers.sender NAME RUN`, started by a Follower.

It reads the lines of metrics from their file, from the first one on, and sends those to the service that are newer than
the last that it has had. So nothing is missing there after a kill, after a failure or where the service was not asked
for from the beginning; and nothing is there twice, for a run that was resumed repeats its lines to the bit.
(But for `seconds`, and on another machine or with other versions: of lines repeated there, the first stay.)
"""

from __future__ import annotations

import fcntl
import importlib
import json
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

from jaxpg.store.loggers import SERVICES, Service, values_of

ERROR = "error: "  # begins the line that says why it failed
LONGEST = 600  # seconds that it goes on after the training has ended
NOT_SENT = ("program",)  # of config.yaml: a path on this machine is no option of the run


def main(arguments: Sequence[str]) -> int:
    """Sends lines until standard input ends; returns the exit status."""
    name, run = arguments[0], Path(arguments[1])
    folder, told = run / "loggers", _only_ours(0)
    with (run / "metrics.jsonl").open("rb") as lines, (folder / f"{name}.log").open("ab") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)  # the one of the training before it may still be sending
            service = importlib.import_module(SERVICES[name])
            logger = service.begin(folder, run.resolve().name, _read(run / "config.yaml"))
            follow(logger, lines, told)
            logger.close()
        except Exception as error:  # of any kind: whatever it is, the training says it in one line
            print(f"{ERROR}{_first_line(error)}", file=sys.stderr, flush=True)
            return 1
    return 0


def follow(service: Service, lines: BinaryIO, told: int) -> None:
    """Writes the lines that are newer than the service's last.

    Args:
      service: where they go.
      lines: the file of metrics, which grows.
      told: descriptor of a pipe; bytes come when there are new lines, and its end when there will be none.
    """
    more = True
    while more:
        more = bool(os.read(told, 1 << 16))
        if not more:
            signal.alarm(LONGEST)
        for line in map(json.loads, _new(lines)):
            if line["steps"] > service.last:
                service.write(values_of(line), line["steps"])


def _new(lines: BinaryIO) -> list[bytes]:
    """The whole lines that have come; of a torn one the rest may come, or it will be written anew."""
    position = lines.tell()
    whole = lines.read().rpartition(b"\n")[0]
    lines.seek(position + len(whole) + bool(whole))
    return whole.splitlines()


def _only_ours(descriptor: int) -> int:
    """A descriptor for the same file, which libraries and their processes do not know; they find the null device."""
    ours = os.dup(descriptor)
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, descriptor)
    os.close(null)
    return ours


def _read(config: Path) -> dict:
    from jaxpg.config import plain_yaml

    values = plain_yaml.load(config.read_text(encoding="utf-8"))
    return {name: value for name, value in values.items() if name not in NOT_SENT}


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
