"""Where a run writes its lines of metrics."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from jaxpg.store import files
from jaxpg.store.folder import RunFolder, metrics_text, replace
from jaxpg.store.lines import json_line, sound, up_to
from jaxpg.store.loggers import UntilItFails, values_of
from jaxpg.store.loggers.follower import Follower
from jaxpg.store.loggers.tensorboard import TensorBoard


class MetricsLog:
    """`metrics.jsonl`, TensorBoard and other loggers; on resume, lines after the checkpoint are taken back.

    Lines that cannot be written wait in memory, and are written before the next one. The file is opened anew for each:
    the folder may be another's, or gone.

    Args:
      folder: the run.
      update: updates made so far; later lines are removed.
      say: takes notes of what cannot be written.
      loggers: names of the others, in `SERVICES`.
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
        kept = self._take_back(update, agents)
        self._waiting = ""
        purge_step = kept[-1]["steps"] + 1 if kept else 0
        self._loggers = [UntilItFails(partial(TensorBoard, folder.tensorboard, purge_step), folder.tensorboard, say)]
        for name in dict.fromkeys(loggers):
            begin = partial(Follower, name, folder.loggers)
            self._loggers.append(UntilItFails(begin, name, say))
        self.seconds = kept[-1]["seconds"] if kept else 0.0

    def _take_back(self, update: int, agents: int | None) -> list[dict[str, Any]]:
        """The lines up to an update, which are then all that the file has."""
        lines, damaged = sound(metrics_text(self._folder), agents)
        for number in damaged:
            self._say(f"note: {self._folder.metrics}: line {number} is damaged and left out; the others are kept")
        kept = up_to(lines, update)
        text = "".join(map(json_line, kept))
        replace(self._folder.metrics, text)
        self._size = len(text)  # of the whole lines in the file; in ASCII a character is a byte
        return kept

    def write(self, line: dict[str, Any]) -> None:
        """Adds one line; values are numbers, or lists of them with one for each agent."""
        self._say_where()
        first = not self._waiting
        self._waiting += json_line(line)
        try:
            self.flush()
        except OSError as error:
            if first:
                self._say(
                    f"note: {self._folder.metrics}: cannot be written ({error.strerror}); lines wait until it can"
                )
        values = values_of(line)
        for logger in self._loggers:
            logger.write(values, line["steps"])

    def _say_where(self) -> None:
        """A note where the folder has been moved."""
        where = self._folder.path
        if where != self._where:
            self._say(f"note: {self._where} was moved: the run goes on in {where}")
            self._where = where

    def flush(self) -> None:
        """Writes the lines that wait; raises OSError where the file has not got all of them."""
        if not self._waiting:
            return
        with files.opened_in(self._folder.metrics, os.O_RDWR) as file:
            if file.seek(0, os.SEEK_END) < self._size:
                raise OSError(errno.EIO, "lines that were written are not there any more")
            file.truncate(self._size)  # what a failure has left of a line
            file.seek(self._size)
            file.write(self._waiting.encode())
        self._size += len(self._waiting)
        self._waiting = ""

    def close(self) -> None:
        for logger in self._loggers:
            logger.close()
