"""The metrics of a chunk of updates: its line in metrics.jsonl, and whether its numbers were finite."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from jaxpg.config.configuration import Config
from jaxpg.divergence import BOUND
from jaxpg.nonfinite import FLAGS, list_quantities
from jaxpg.program.agents import describe_agent
from jaxpg.store.folder import to_json
from jaxpg.types import Metrics, TrainState

NO_MEASUREMENTS = (*FLAGS, "diverged_env")
PATIENCE = 100  # consecutive updates that could not be applied, after which a run with nan_policy=skip ends


def summarize(metrics: Metrics) -> dict[str, Any]:
    """The line of metrics for a chunk: means over its sound updates, and the mean return of its finished episodes.

    Args:
      metrics: metrics of the updates, `[S, chunk]` by name.

    Returns:
      By name a number, or a list with one number per agent. `skipped` counts updates that were not applied, `diverged`
      environments whose physics diverged.
    """
    values = {name: np.asarray(value, np.float64) for name, value in metrics.items()}
    unsound = values["nonfinite"] > 0
    values = {name: np.where(unsound, np.nan, value) for name, value in values.items() if name not in NO_MEASUREMENTS}
    sums = {name: np.nansum(values.pop(name), axis=-1) for name in ("return_sum", "episodes", "diverged")}
    mean_return = np.where(sums["episodes"] > 0, sums["return_sum"] / np.maximum(sums["episodes"], 1), np.nan)
    counts = {"skipped": unsound.sum(axis=-1), "diverged": sums["diverged"]}
    results = {"return": mean_return, "episodes": sums["episodes"]} | {name: _mean(x) for name, x in values.items()}
    return {name: to_json(x) for name, x in (results | counts).items()}


def _mean(values: np.ndarray) -> np.ndarray:
    """The mean of each row without its NaNs; NaN for a row of NaNs."""
    count = (~np.isnan(values)).sum(axis=-1)
    return np.where(count > 0, np.nansum(values, axis=-1) / np.maximum(count, 1), np.nan)


def _count_trailing(flags: np.ndarray) -> np.ndarray:
    """The number of consecutive true entries at the end of each row.

    >>> _count_trailing(np.array([[True, False, True, True], [True, True, False, False]])).tolist()
    [2, 0]
    """
    return np.cumprod(flags[:, ::-1], axis=-1).sum(axis=-1)


class NonFiniteMonitor:
    """Reports non-finite numbers, once per agent, and keeps track of agents that make no progress.

    An agent that stops before an unsound update would only repeat it, so a single one shows that it is stuck. An agent
    that skips such updates draws other random numbers for the next one, which may be sound.

    Args:
      config: configuration of the run.
      say: takes the notes.
      patience: consecutive unsound updates, across chunks, after which an agent that skips them counts as stuck.

    Attributes:
      problem: the first problem; None as long as all numbers are finite.
      consecutive: unsound updates in a row up to now, of the agent with the fewest.
    """

    def __init__(self, config: Config, say: Callable[[str], None], patience: int = PATIENCE):
        self._config, self._say = config, say
        self._reported_agents: set[int] = set()
        self._diverged = False
        self._in_a_row = np.zeros(config.num_agents, int)
        self._patience = patience if config.run.nan_policy == "skip" else 1
        self.problem: str | None = None

    @property
    def consecutive(self) -> int:
        return int(self._in_a_row.min())

    @property
    def is_stuck(self) -> bool:
        """Whether no agent can be expected to apply another update."""
        return self.consecutive >= self._patience

    def observe(self, before: TrainState, metrics: Metrics) -> None:
        """Looks at a chunk: the state `before` it and its metrics, `[S, chunk]`."""
        unsound, first_update = np.asarray(metrics["nonfinite"]), np.asarray(before.update) + 1
        for agent in np.flatnonzero(unsound.any(axis=-1)).tolist():
            if agent not in self._reported_agents:
                self._reported_agents.add(agent)
                self._report(agent, first_update[agent], metrics)
        self._in_a_row = np.where((unsound > 0).all(axis=-1), self._in_a_row, 0) + _count_trailing(unsound > 0)
        diverged = np.argwhere(np.asarray(metrics["diverged"]) > 0)
        if len(diverged) and not self._diverged:
            self._diverged = True
            agent, at = diverged[0]
            environment = int(np.asarray(metrics["diverged_env"])[agent, at])
            where = f"the physics of environment {environment}{self._describe_agent(agent)}"
            self._say(
                f"note: update {first_update[agent] + at:,}: {where} diverged: a number is not finite or beyond "
                f"{BOUND:.0e}; its episode ends there and is not learned from; metrics.jsonl counts these as diverged"
            )

    def _report(self, agent: int, first_update: int, metrics: Metrics) -> None:
        codes = np.asarray(metrics["nonfinite"])[agent]
        at = int(np.argmax(codes > 0))
        what = list_quantities(metrics)[codes[at] - 1]
        environment = int(np.asarray(metrics["nonfinite_env"])[agent, at])
        where = f" of environment {environment}" if environment >= 0 else ""
        problem = f"update {first_update + at:,}: {what}{where} is not finite{self._describe_agent(agent)}"
        self.problem = self.problem or problem
        stops = self._config.run.nan_policy == "stop"
        if self._config.num_agents > 1 or not stops:
            self._say(f"note: {problem}; {'this agent stops before it' if stops else 'such updates are skipped'}")

    def _describe_agent(self, agent: int) -> str:
        return f", {describe_agent(self._config, agent)}" if self._config.num_agents > 1 else ""
