"""The process of a logger: `python -m jaxpg.store.loggers.sender NAME RUN`, started by a Follower.

It reads the lines of metrics from their file, from the first one on, and sends those that are newer than the last one
that the service has. So nothing is missing after a kill, after a failure, or if the service was only added later.
Nothing is there twice, as a resumed run repeats its lines to the bit. (Except for `seconds`, and on another machine or
with other versions: the service keeps the first version of a repeated line.)
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

from jaxpg.store.loggers import SERVICES, Service, mean_values

ERROR = "error: "  # prefix of the line that says why it failed
MAX_SECONDS = 600  # that it continues after the training has ended
NOT_SENT = ("program",)  # of config.yaml: a path on this machine, not an option of the run


def main(arguments: Sequence[str]) -> int:
    """Sends lines until standard input ends; returns the exit status."""
    name, run = arguments[0], Path(arguments[1])
    folder, signals = run / "loggers", _claim_descriptor(0)
    with (run / "metrics.jsonl").open("rb") as lines, (folder / f"{name}.log").open("ab") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)  # the process of an earlier part may still be sending
            service = importlib.import_module(SERVICES[name])
            logger = service.begin(folder, run.resolve().name, _read_config(run / "config.yaml"))
            follow(logger, lines, signals)
            logger.close()
        except Exception as error:  # whatever it is, the training process reports it in one line
            print(f"{ERROR}{_first_line(error)}", file=sys.stderr, flush=True)
            return 1
    return 0


def follow(service: Service, lines: BinaryIO, signals: int) -> None:
    """Writes the lines that are newer than the service's last.

    Args:
      service: the service.
      lines: the growing file of metrics.
      signals: descriptor of a pipe; bytes signal new lines, and its end that there will be no more.
    """
    more = True
    while more:
        more = bool(os.read(signals, 1 << 16))
        if not more:
            signal.alarm(MAX_SECONDS)
        for line in map(json.loads, _read_new_lines(lines)):
            if line["steps"] > service.last:
                service.write(mean_values(line), line["steps"])


def _read_new_lines(lines: BinaryIO) -> list[bytes]:
    """The complete new lines; an incomplete one may be finished or rewritten later."""
    position = lines.tell()
    whole = lines.read().rpartition(b"\n")[0]
    lines.seek(position + len(whole) + bool(whole))
    return whole.splitlines()


def _claim_descriptor(descriptor: int) -> int:
    """Moves a file to a new descriptor, so that libraries and their processes find the null device in its place."""
    copy = os.dup(descriptor)
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, descriptor)
    os.close(null)
    return copy


def _read_config(config: Path) -> dict:
    from jaxpg.config import plain_yaml

    values = plain_yaml.load(config.read_text(encoding="utf-8"))
    return {name: value for name, value in values.items() if name not in NOT_SENT}


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
