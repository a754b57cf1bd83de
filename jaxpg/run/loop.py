"""The host's loop over the compiled chunks of a run."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxpg.config.configuration import Config
from jaxpg.config.schema import Run
from jaxpg.program.compile import Program
from jaxpg.program.schedule import Schedule
from jaxpg.program.state import Best, RunState, choose_better, get_policy
from jaxpg.run.chunks import PATIENCE, NonFiniteMonitor, summarize
from jaxpg.run.signals import StopRequests
from jaxpg.run.terminal import Display
from jaxpg.run.watchdog import Watchdog
from jaxpg.store.folder import RunFolder, to_json
from jaxpg.store.keeper import Keeper
from jaxpg.store.metrics_log import MetricsLog
from jaxpg.store.names import rename_metrics
from jaxpg.store.statistics import finite_mean, penalize_diverged
from jaxpg.types import Metrics, TrainState


class Session(NamedTuple):
    """A run: its configuration, schedule, folder and display."""

    config: Config
    schedule: Schedule
    run_folder: RunFolder
    display: Display


class Loop:
    """Runs chunk after chunk, and after each one writes metrics, evaluates and saves checkpoints.

    Args:
      session: the run.
      program: its compiled functions.
      state: the state to start from.

    Attributes:
      first, update: number of updates at the start, and now.
      solved: whether an evaluation has reached `stop_return`.
      monitor: reports numbers that are not finite.
      keeper: saves checkpoints.
    """

    def __init__(self, session: Session, program: Program, state: RunState):
        self._config, self._schedule, run_folder, self._display = session
        self._program, self._state = program, state
        self.first = self.update = count_updates(state.train)
        self.solved = False
        say, left = self._display.say, self._schedule.num_updates - self.first
        self.keeper = Keeper(self._config, run_folder, say)  # before the log, which opens files and processes
        self._log = MetricsLog(run_folder, self.update, say, self._config.run.loggers, self._config.num_agents)
        self.monitor, self._watchdog = NonFiniteMonitor(self._config, say, min(PATIENCE, left)), Watchdog()
        self._began, self._seconds_before = time.monotonic(), self._log.seconds
        self._display.start()

    def run(self, stop: StopRequests) -> None:
        """Runs until the last update or a request to stop, and saves the last state."""
        while self._can_continue and not stop.signal and self._advance():
            if self._schedule.is_due(self.update, self._schedule.checkpoint_every) or self.keeper.failed:
                self._save()
        if self.update > self.first and self.keeper.saved != self.update:
            self._save()

    def close(self) -> float:
        """Closes the display and the log; returns the seconds of training."""
        self._display.stop()
        seconds = self._seconds
        self._log.close()  # may take a while
        return seconds

    @property
    def _seconds(self) -> float:
        return time.monotonic() - self._began

    @property
    def _can_continue(self) -> bool:
        return self.update < self._schedule.num_updates and not (self.solved or self.monitor.is_stuck)

    def _advance(self) -> bool:
        """Trains up to the next line of metrics; returns whether any update was made."""
        number = self._schedule.updates_to_next_line(self.update)
        with self._watchdog.chunk(f"update {self.update + 1:,} to {self.update + number:,}"):
            train, metrics = jax.block_until_ready(self._program.advance(self._state.train, number))
        self.monitor.observe(self._state.train, metrics)
        count = count_updates(train) - self.update
        if count:
            self._state, self.update = self._state._replace(train=train), self.update + count
            self._write({name: x[:, :count] for name, x in metrics.items()})
        return count > 0

    def _write(self, metrics: Metrics) -> None:
        """Writes the line of metrics, with an evaluation if one is due."""
        line = {"update": self.update, "steps": self.update * self._schedule.steps_per_update} | summarize(metrics)
        if self._schedule.is_due(self.update, self._schedule.eval_every):
            self._state, evaluation = _evaluate(self._program, self._state)
            line |= evaluation
            self.solved = is_solved(self._config.run, self._state.best.episode_return)
        line["seconds"] = round(self._seconds_before + self._seconds, 3)
        self._log.write(line)
        self._display.update(line)

    def _save(self) -> None:
        self.keeper.save(self.update, self._state, self._log)


def count_updates(train: TrainState) -> int:
    """Updates made by the agents that still train; in numpy, as jax would compile a program for it."""
    return int(np.asarray(train.update).max())


def _evaluate(program: Program, state: RunState) -> tuple[RunState, dict[str, Any]]:
    """Evaluates the deterministic policy; returns the state with the best policy so far, and the results."""
    policy = get_policy(state.train)
    episodes = jax.tree.map(np.asarray, program.evaluate(policy))
    returns = penalize_diverged(episodes.episode_return, episodes.diverged).mean(axis=-1)
    results = {name: finite_mean(value) for name, value in rename_metrics(episodes.metrics).items()}
    results |= {"return": returns, "diverged": episodes.diverged.sum(axis=-1)}
    best = choose_better(state.best, Best(policy, returns.astype(np.float32)))
    return state._replace(best=best), {f"eval_{name}": to_json(value) for name, value in results.items()}


def is_solved(run: Run, best_returns: jax.Array | np.ndarray) -> bool:
    """Whether the run has reached `stop_return`: with all agents, or with one of them."""
    if run.stop_return is None:
        return False
    is_reached = np.asarray(best_returns) >= run.stop_return
    return bool(is_reached.all() if run.stop_agents == "all" else is_reached.any())
