"""Saves the checkpoints of a run, and survives saves that fail."""

from __future__ import annotations

from collections.abc import Callable

from jaxpg.config.configuration import Config
from jaxpg.program.state import RunState
from jaxpg.store.checkpoint_errors import SaveError
from jaxpg.store.folder import RunFolder
from jaxpg.store.metrics_log import MetricsLog


class Keeper:
    """Writes the run's state to `checkpoints/` and its best policy to `best/`; a failure only gives a note.

    Args:
      config, folder: configuration and folder of the run.
      say: takes notes.

    Attributes:
      saved: the last update whose state, best policy and metrics this process has saved; None before the first.
      failed: whether the last save failed.
    """

    def __init__(self, config: Config, folder: RunFolder, say: Callable[[str], None]):
        from jaxpg.store.checkpoint import Checkpoints  # with orbax, which is slow to import

        self._checkpoints = Checkpoints(folder.checkpoints)
        self._best = Checkpoints(folder.best, keep=1)
        self._meta = {"config": config.to_dict()}
        self._say = say
        self._last: int | None = None  # the newest checkpoint of this process
        self.saved: int | None = None
        self.failed = False

    def save(self, update: int, state: RunState, log: MetricsLog) -> None:
        """Saves the state after `update` updates; notes the first of several failures, and their end.

        Args:
          update, state: the state to save, and its number of updates.
          log: the log of metrics, whose lines are written before the checkpoint.
        """
        problem = self._try_save(update, state, log)
        if problem and not self.failed:
            self._say(f"note: {problem}; training continues, and saving is tried again at each line of metrics")
        elif self.failed and not problem:
            self._say(f"note: saving works again, after {update:,} updates")
        self.failed = problem is not None
        if not problem:
            self.saved = update

    def _try_save(self, update: int, state: RunState, log: MetricsLog) -> str | None:
        """Saves; returns the reason if it fails."""
        try:
            log.flush()  # first: without its lines, a resumed run would have a gap
            if self._last != update:  # else only the best policy is missing
                self._checkpoints.replace(update, state, self._meta)  # there may be newer ones that are damaged
                self._last = update
            self._best.replace(update, state.best, self._meta)
        except SaveError as error:
            return str(error)
        except OSError as error:
            where = self._checkpoints.folder / str(update)
            return f"{where}: not written, as its lines of metrics cannot be ({error.strerror})"
        return None
