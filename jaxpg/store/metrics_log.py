"""Writes the lines of metrics of a run."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from jaxpg.store import files
from jaxpg.store.folder import RunFolder, read_metrics_text
from jaxpg.store.lines import format_line, parse_lines, select_until
from jaxpg.store.loggers import SafeLogger, mean_values
from jaxpg.store.loggers.follower import Follower
from jaxpg.store.loggers.tensorboard import TensorBoard
from jaxpg.store.run_files import replace


class MetricsLog:
    """Writes `metrics.jsonl`, TensorBoard and other loggers; on resume, lines after the checkpoint are removed.

    Lines that cannot be written wait in memory until the next one. The file is opened again for each line, as the
    folder may have been replaced or removed.

    Args:
      folder: the run folder.
      update: updates made so far; later lines are removed.
      say: takes notes on what cannot be written.
      loggers: names of further loggers, in `SERVICES`.
      agents: as in `read_metrics`.

    Raises:
      UserError: the file cannot be written when the run begins.
    """

    def __init__(
        self,
        folder: RunFolder,
        update: int,
        say: Callable[[str], None],
        loggers: Sequence[str] = (),
        agents: int | None = None,
    ):
        self._folder, self._where, self._say = folder, folder.path, say
        lines = self._truncate(update, agents)
        self._waiting = ""
        purge_step = lines[-1]["steps"] + 1 if lines else 0
        self._loggers = [SafeLogger(partial(TensorBoard, folder.tensorboard, purge_step), folder.tensorboard, say)]
        for name in dict.fromkeys(loggers):
            begin = partial(Follower, name, folder.loggers)
            self._loggers.append(SafeLogger(begin, name, say))
        self.seconds = lines[-1]["seconds"] if lines else 0.0

    def _truncate(self, update: int, agents: int | None) -> list[dict[str, Any]]:
        """Removes the lines after an update from the file; returns the others."""
        lines, damaged = parse_lines(read_metrics_text(self._folder), agents)
        for number in damaged:
            self._say(f"note: {self._folder.metrics}: line {number} is damaged and dropped; the others are kept")
        selected = select_until(lines, update)
        text = "".join(map(format_line, selected))
        replace(self._folder.metrics, text)
        self._size = len(text)  # bytes of whole lines in the file, which is ASCII
        return selected

    def write(self, line: dict[str, Any]) -> None:
        """Adds one line; values are numbers, or lists with one number per agent."""
        self._note_move()
        first = not self._waiting
        self._waiting += format_line(line)
        try:
            self.flush()
        except OSError as error:
            if first:
                self._say(
                    f"note: {self._folder.metrics}: cannot be written ({error.strerror}); lines are kept until it can"
                )
        values = mean_values(line)
        for logger in self._loggers:
            logger.write(values, line["steps"])

    def _note_move(self) -> None:
        """Notes it if the folder has been moved."""
        where = self._folder.path
        if where != self._where:
            self._say(f"note: {self._where} was moved: the run continues in {where}")
            self._where = where

    def flush(self) -> None:
        """Writes the waiting lines; raises OSError if that fails."""
        if not self._waiting:
            return
        with files.open_file(self._folder.metrics, os.O_RDWR) as file:
            if file.seek(0, os.SEEK_END) < self._size:
                raise OSError(errno.EIO, "earlier lines have disappeared")
            file.truncate(self._size)  # removes the rest of a failed write
            file.seek(self._size)
            file.write(self._waiting.encode())
        self._size += len(self._waiting)
        self._waiting = ""

    def close(self) -> None:
        for logger in self._loggers:
            logger.close()
