"""The training's side of a logger that has a process of its own."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import os
import subprocess
import sys
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import BinaryIO

from envs.hints import pip_install
from jaxpg.errors import UserError
from jaxpg.store import files
from jaxpg.store.loggers import SERVICES, LoggerError
from jaxpg.store.loggers.sender import ERROR, LONGEST

CLOSING = 15.0  # seconds that the end of a run waits; MLflow takes half of them to make its database


class Follower:
    """A process that reads the lines of metrics from their file and sends them to a service.

    The training never waits for it: a write is one byte into a pipe that does not block, and says that there is a line.
    The pipe's end, however the training ends, is the end of the metrics. The process has a session of its own, so that
    Ctrl-C does not reach it, no terminal, and for its output `NAME.log` in `folder`.

    Args:
      name: of the service, in `SERVICES`.
      folder: where the service keeps what it has to, in the run folder; made where there is none. The lines are in
        the run's `metrics.jsonl` before they are written here.

    Raises:
      OSError: the process cannot be started.
    """

    def __init__(self, name: str, folder: Path):
        self._log = folder / f"{name}.log"
        with files.opened(folder.parent) as run, files.opened(folder, make=True), self._opened_log() as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "jaxpg.store.loggers.sender", name, str(files.through(run, folder.parent))],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                bufsize=0,
                start_new_session=True,
                pass_fds=(run,),  # by which it finds the run folder, wherever that is moved
            )
        self._pipe = self._process.stdin
        os.set_blocking(self._pipe.fileno(), False)

    def _opened_log(self) -> AbstractContextManager[BinaryIO]:
        return files.opened_in(self._log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)

    def write(self, values: Mapping[str, float], step: int) -> None:
        """Says that there is a line; raises LoggerError where the process has ended."""
        try:
            os.write(self._pipe.fileno(), b"\n")
        except BlockingIOError:
            pass  # it has been told often enough
        except BrokenPipeError:
            self._pipe.close()
            self._process.wait()
            raise LoggerError(f"{self._problem()}; it gets no more metrics") from None

    def close(self) -> None:
        """Waits for it to send the rest, but not for long; raises LoggerError where that was not enough, or failed."""
        with contextlib.suppress(BrokenPipeError):
            self._pipe.close()
        try:
            status = self._process.wait(CLOSING)
        except subprocess.TimeoutExpired:
            left = f"process {self._process.pid} goes on with it for {LONGEST // 60} minutes at most"
            raise LoggerError(f"has not got all metrics after {CLOSING:.0f} s; {left}") from None
        if status:
            raise LoggerError(f"{self._problem()}; it has not got all metrics")

    def _problem(self) -> str:
        lines = files.read(self._log).decode(errors="replace").splitlines()
        errors = [line.removeprefix(ERROR) for line in lines if line.startswith(ERROR)]
        return f"{errors[-1]} ({self._log})" if errors else f"ended, see {self._log}"


def check(names: Iterable[str]) -> None:
    """Raises UserError, with what to install, where one of the services' packages is missing."""
    for name in names:
        if not all(map(_is_installed, importlib.import_module(SERVICES[name]).packages())):
            raise UserError(f"loggers=[{name}]: {pip_install(name)}")


def _is_installed(package: str) -> bool:
    """Not a mere folder of that name, such as W&B leaves where it has been."""
    spec = importlib.util.find_spec(package)
    return spec is not None and spec.origin is not None
