"""The loop on the host around the compiled chunks of a run."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxpg.config.configuration import Config
from jaxpg.config.schema import Run
from jaxpg.program.compile import Program
from jaxpg.program.schedule import Schedule
from jaxpg.program.state import Best, RunState, better, current_policy
from jaxpg.run.chunks import PATIENCE, Watch, summary
from jaxpg.run.signals import StopRequests
from jaxpg.run.terminal import Display
from jaxpg.run.watchdog import Watchdog
from jaxpg.store.folder import RunFolder, jsonable
from jaxpg.store.keeper import Keeper
from jaxpg.store.metrics_log import MetricsLog
from jaxpg.store.names import own_metrics
from jaxpg.store.statistics import counted_returns, finite_mean
from jaxpg.types import Metrics, TrainState


class Session(NamedTuple):
    """What a run is, how it is divided, where it is kept and where it shows."""

    config: Config
    schedule: Schedule
    run_folder: RunFolder
    display: Display


class Loop:
    """Chunk after chunk of a run, each with what is written of it: a line of metrics, evaluation, checkpoint.

    Args:
      session: the run.
      program: its compiled functions.
      state: where it begins or goes on.

    Attributes:
      first, update: updates made before, and made by now.
      solved: whether an evaluation has reached `stop_return`.
      watch: what was not finite.
      keeper: what is on the disk.
    """

    def __init__(self, session: Session, program: Program, state: RunState):
        self._config, self._schedule, run_folder, self._display = session
        self._program, self._state = program, state
        self.first = self.update = updates_made(state.train)
        self.solved = False
        say, left = self._display.say, self._schedule.num_updates - self.first
        self.keeper = Keeper(self._config, run_folder, say)  # before the log, which has files and processes to close
        self._log = MetricsLog(run_folder, self.update, say, self._config.run.loggers, self._config.num_agents)
        self.watch, self._watchdog = Watch(self._config, say, min(PATIENCE, left)), Watchdog()
        self._began, self._seconds_before = time.monotonic(), self._log.seconds
        self._display.start()

    def run(self, stop: StopRequests) -> None:
        """Until the last update, or a request to stop; what was made is saved then."""
        while self._goes_on and not stop.signal and self._advance():
            if self._schedule.is_due(self.update, self._schedule.checkpoint_every) or self.keeper.failed:
                self._save()
        if self.update > self.first and self.keeper.saved != self.update:
            self._save()

    def close(self) -> float:
        """Ends what is shown and written; returns the seconds of training."""
        self._display.stop()
        seconds = self._seconds
        self._log.close()  # which may wait for a while
        return seconds

    @property
    def _seconds(self) -> float:
        return time.monotonic() - self._began

    @property
    def _goes_on(self) -> bool:
        return self.update < self._schedule.num_updates and not (self.solved or self.watch.nobody_goes_on)

    def _advance(self) -> bool:
        """Up to the next line of metrics; whether an update was made."""
        number = self._schedule.until_next_line(self.update)
        with self._watchdog.chunk(f"update {self.update + 1:,} to {self.update + number:,}"):
            train, metrics = jax.block_until_ready(self._program.advance(self._state.train, number))
        self.watch.look(self._state.train, metrics)
        made = updates_made(train) - self.update
        if made:
            self._state, self.update = self._state._replace(train=train), self.update + made
            self._write({name: x[:, :made] for name, x in metrics.items()})
        return made > 0

    def _write(self, metrics: Metrics) -> None:
        """The line of metrics of the updates up to here, with an evaluation where one is due."""
        line = {"update": self.update, "steps": self.update * self._schedule.steps_per_update} | summary(metrics)
        if self._schedule.is_due(self.update, self._schedule.eval_every):
            self._state, evaluation = _evaluate(self._program, self._state)
            line |= evaluation
            self.solved = is_solved(self._config.run, self._state.best.episode_return)
        line["seconds"] = round(self._seconds_before + self._seconds, 3)
        self._log.write(line)
        self._display.update(line)

    def _save(self) -> None:
        self.keeper.save(self.update, self._state, self._log)


def updates_made(train: TrainState) -> int:
    """By the agents that still go on; read by numpy, as jax would compile a program for it."""
    return int(np.asarray(train.update).max())


def _evaluate(program: Program, state: RunState) -> tuple[RunState, dict[str, Any]]:
    """The deterministic policy's results, and the state with the best policy kept."""
    policy = current_policy(state.train)
    episodes = jax.tree.map(np.asarray, program.evaluate(policy))
    returns = counted_returns(episodes.episode_return, episodes.diverged).mean(axis=-1)
    found = {name: finite_mean(value) for name, value in own_metrics(episodes.metrics).items()}
    found |= {"return": returns, "diverged": episodes.diverged.sum(axis=-1)}
    best = better(state.best, Best(policy, returns.astype(np.float32)))
    return state._replace(best=best), {f"eval_{name}": jsonable(value) for name, value in found.items()}


def is_solved(run: Run, best_returns: np.ndarray) -> bool:
    """Whether all agents, or one of them, have reached the return at which the run ends."""
    if run.stop_return is None:
        return False
    reached = np.asarray(best_returns) >= run.stop_return
    return bool(reached.all() if run.stop_agents == "all" else reached.any())
