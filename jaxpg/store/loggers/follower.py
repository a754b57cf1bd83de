"""The training process's side of a logger that runs in its own process."""

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
from typing import IO

from envs.hints import pip_install
from jaxpg.errors import UserError
from jaxpg.store import files
from jaxpg.store.loggers import SERVICES, LoggerError
from jaxpg.store.loggers.sender import ERROR, MAX_SECONDS

CLOSE_TIMEOUT = 15.0  # seconds to wait at the end of a run; MLflow takes half of them to create its database


class Follower:
    """A process that reads the lines of metrics from their file and sends them to a service.

    Training never waits for it: for each line, one byte is written into a non-blocking pipe. The pipe closes when the
    training ends, however that happens, and so ends the metrics. The process has its own session, so that Ctrl-C does
    not reach it, and no terminal; its output goes to `NAME.log` in `folder`.

    Args:
      name: name of the service, in `SERVICES`.
      folder: folder for the service's files, in the run folder; created if needed. Lines must be in the run's
        `metrics.jsonl` before `write` is called.

    Raises:
      OSError: the process cannot be started.
    """

    def __init__(self, name: str, folder: Path):
        self._log = folder / f"{name}.log"
        with files.open_folder(folder.parent) as run, files.open_folder(folder, make=True), self._open_log() as log:
            self._process = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "jaxpg.store.loggers.sender",
                    name,
                    str(files.descriptor_path(run, folder.parent)),
                ],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                bufsize=0,
                start_new_session=True,
                pass_fds=(run,),  # the run folder, even if it is moved
            )
        assert self._process.stdin is not None  # a pipe, as asked
        self._pipe = self._process.stdin
        os.set_blocking(self._pipe.fileno(), False)

    def _open_log(self) -> AbstractContextManager[IO[bytes]]:
        return files.open_file(self._log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)

    def write(self, values: Mapping[str, float], step: int) -> None:
        """Signals that there is a line; raises LoggerError if the process has ended."""
        try:
            os.write(self._pipe.fileno(), b"\n")
        except BlockingIOError:
            pass  # enough signals are waiting
        except BrokenPipeError:
            self._pipe.close()
            self._process.wait()
            raise LoggerError(f"{self._find_problem()}; it gets no more metrics") from None

    def close(self) -> None:
        """Waits a while for the rest to be sent; raises LoggerError if that takes too long or fails."""
        with contextlib.suppress(BrokenPipeError):
            self._pipe.close()
        try:
            status = self._process.wait(CLOSE_TIMEOUT)
        except subprocess.TimeoutExpired:
            rest = f"process {self._process.pid} continues for at most {MAX_SECONDS // 60} minutes"
            raise LoggerError(f"has not received all metrics after {CLOSE_TIMEOUT:.0f} s; {rest}") from None
        if status:
            raise LoggerError(f"{self._find_problem()}; it has not received all metrics")

    def _find_problem(self) -> str:
        lines = files.read(self._log).decode(errors="replace").splitlines()
        errors = [line.removeprefix(ERROR) for line in lines if line.startswith(ERROR)]
        return f"{errors[-1]} ({self._log})" if errors else f"ended, see {self._log}"


def check_installed(names: Iterable[str]) -> None:
    """Raises UserError, saying what to install, if a package of one of the services is missing."""
    for name in names:
        if not all(map(_is_installed, importlib.import_module(SERVICES[name]).packages())):
            raise UserError(f"loggers=[{name}]: {pip_install(name)}")


def _is_installed(package: str) -> bool:
    """Whether it is a package, and not just a folder of that name, such as W&B leaves behind."""
    spec = importlib.util.find_spec(package)
    return spec is not None and spec.origin is not None
