"""What a run keeps on disk, and what becomes of a save that fails."""

from __future__ import annotations

from collections.abc import Callable

from jaxpg.config.configuration import Config
from jaxpg.program.state import RunState
from jaxpg.store.checkpoint_errors import SaveError
from jaxpg.store.folder import RunFolder
from jaxpg.store.metrics_log import MetricsLog


class Keeper:
    """Writes the run's state to `checkpoints/` and its best policy to `best/`, or says that it could not.

    Args:
      config, folder: of the run.
      say: takes notes.

    Attributes:
      saved: the last update whose state, best policy and lines of metrics this process has saved; None before.
      failed: whether the last save has failed.
    """

    def __init__(self, config: Config, folder: RunFolder, say: Callable[[str], None]):
        from jaxpg.store.checkpoint import Checkpoints  # and orbax, which is slow to import

        self._checkpoints = Checkpoints(folder.checkpoints)
        self._best = Checkpoints(folder.best, keep=1)
        self._meta = {"config": config.to_dict()}
        self._say = say
        self._last: int | None = None  # the newest checkpoint of this process
        self.saved: int | None = None
        self.failed = False

    def save(self, update: int, state: RunState, log: MetricsLog) -> None:
        """Saves the state after `update` updates; the first of several failures is said, and the end of them.

        Args:
          update, state: what is saved.
          log: the lines of metrics, which are written before a checkpoint that has them.
        """
        problem = self._problem(update, state, log)
        if problem and not self.failed:
            self._say(f"note: {problem}; training goes on, and saving is tried again at each line of metrics")
        elif self.failed and not problem:
            self._say(f"note: saved again, after {update:,} updates")
        self.failed = problem is not None
        if not problem:
            self.saved = update

    def _problem(self, update: int, state: RunState, log: MetricsLog) -> str | None:
        """Saves; what has kept it from that."""
        try:
            log.flush()  # first: a checkpoint whose lines are not there would be resumed with a gap
            if self._last != update:  # else only the best policy is missing
                self._checkpoints.replace(update, state, self._meta)  # damaged ones may be newer than what was resumed
                self._last = update
            self._best.replace(update, state.best, self._meta)
        except SaveError as error:
            return str(error)
        except OSError as error:
            where = self._checkpoints.folder / str(update)
            return f"{where}: not written without its lines of metrics, which cannot be ({error.strerror})"
        return None
