"""What a chunk of updates says: its line of metrics, and whether its numbers were finite."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from jaxpg.config.configuration import Config
from jaxpg.divergence import BOUND
from jaxpg.nonfinite import FLAGS, quantities
from jaxpg.program.agents import described_agent
from jaxpg.store.folder import jsonable
from jaxpg.types import Metrics, TrainState

NO_MEASUREMENTS = (*FLAGS, "diverged_env")
PATIENCE = 100  # updates in a row that could not be applied, after which a run that leaves such out gives up


def summary(metrics: Metrics) -> dict[str, Any]:
    """One line of metrics for a chunk: means over its sound updates, and the mean return of the episodes that ended.

    Args:
      metrics: of the updates, `[S, chunk]` by name.

    Returns:
      A number by name, or a list of them with one for each agent. `skipped` and `diverged` are counts: of updates that
      were not applied, and of environments whose physics diverged.
    """
    values = {name: np.asarray(value, np.float64) for name, value in metrics.items()}
    unsound = values["nonfinite"] > 0
    values = {name: np.where(unsound, np.nan, value) for name, value in values.items() if name not in NO_MEASUREMENTS}
    sums = {name: np.nansum(values.pop(name), axis=-1) for name in ("return_sum", "episodes", "diverged")}
    mean_return = np.where(sums["episodes"] > 0, sums["return_sum"] / np.maximum(sums["episodes"], 1), np.nan)
    counts = {"skipped": unsound.sum(axis=-1), "diverged": sums["diverged"]}
    found = {"return": mean_return, "episodes": sums["episodes"]} | {name: _mean(x) for name, x in values.items()}
    return {name: jsonable(x) for name, x in (found | counts).items()}


def _mean(values: np.ndarray) -> np.ndarray:
    """The mean of each row's numbers, NaN where it has none."""
    number = (~np.isnan(values)).sum(axis=-1)
    return np.where(number > 0, np.nansum(values, axis=-1) / np.maximum(number, 1), np.nan)


def _at_the_end(flags: np.ndarray) -> np.ndarray:
    """How many of each row's last entries are true in a row.

    >>> _at_the_end(np.array([[True, False, True, True], [True, True, False, False]])).tolist()
    [2, 0]
    """
    return np.cumprod(flags[:, ::-1], axis=-1).sum(axis=-1)


class Watch:
    """Says what was not finite, once for each agent, and knows who stands still since then.

    An agent that stops before an unsound update makes the same one again and again: one is enough to know that it does
    not go on. One that leaves such updates out draws other random numbers for the next, which may be sound.

    Args:
      config: of the run.
      say: takes the notes.
      patience: updates in a row, in this chunk and those before it, by which an agent that leaves them out is given up.

    Attributes:
      problem: what was seen first of all; None as long as all numbers are finite.
      in_a_row: unsound updates up to now, of the agent with the fewest.
    """

    def __init__(self, config: Config, say: Callable[[str], None], patience: int = PATIENCE):
        self._config, self._say = config, say
        self._noted: set[int] = set()
        self._diverged = False
        self._in_a_row = np.zeros(config.num_agents, int)
        self._patience = patience if config.run.nan_policy == "skip" else 1
        self.problem: str | None = None

    @property
    def in_a_row(self) -> int:
        return int(self._in_a_row.min())

    @property
    def nobody_goes_on(self) -> bool:
        """Whether no agent is expected to apply another update."""
        return self.in_a_row >= self._patience

    def look(self, before: TrainState, metrics: Metrics) -> None:
        """Takes in a chunk: the state that it began with, and its metrics, `[S, chunk]`."""
        unsound, first_update = np.asarray(metrics["nonfinite"]), np.asarray(before.update) + 1
        for agent in np.flatnonzero(unsound.any(axis=-1)):
            if agent not in self._noted:
                self._noted.add(agent)
                self._note(agent, first_update[agent], metrics)
        self._in_a_row = np.where((unsound > 0).all(axis=-1), self._in_a_row, 0) + _at_the_end(unsound > 0)
        diverged = np.argwhere(np.asarray(metrics["diverged"]) > 0)
        if len(diverged) and not self._diverged:
            self._diverged = True
            agent, at = diverged[0]
            environment = int(np.asarray(metrics["diverged_env"])[agent, at])
            where = f"the physics of environment {environment}{self._of(agent)}"
            self._say(
                f"note: update {first_update[agent] + at:,}: {where} diverged: a number is not finite or beyond "
                f"{BOUND:.0e}; its episode ended there and is not learned from, and diverged in metrics.jsonl counts "
                "such"
            )

    def _note(self, agent: int, first_update: int, metrics: Metrics) -> None:
        codes = np.asarray(metrics["nonfinite"])[agent]
        at = int(np.argmax(codes > 0))
        what = quantities(metrics)[codes[at] - 1]
        environment = int(np.asarray(metrics["nonfinite_env"])[agent, at])
        where = f" of environment {environment}" if environment >= 0 else ""
        problem = f"update {first_update + at:,}: {what}{where} is not finite{self._of(agent)}"
        self.problem = self.problem or problem
        stops = self._config.run.nan_policy == "stop"
        if self._config.num_agents > 1 or not stops:
            self._say(f"note: {problem}; {'this agent stops before it' if stops else 'such updates are left out'}")

    def _of(self, agent: int) -> str:
        return f", {described_agent(self._config, agent)}" if self._config.num_agents > 1 else ""
