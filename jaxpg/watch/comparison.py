"""The page of several runs: which method is better, and how sure that is.

A method is all options that training depends on but the seed. Agents of the same method, whichever runs they are of,
are its seeds; each setting of a sweep is a method of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxpg.run import config as configuration
from jaxpg.run import folder, results
from jaxpg.run.agents import alone
from jaxpg.run.errors import UserError
from jaxpg.run.statistics import improvement_interval, interquartile_mean, probability_of_improvement
from jaxpg.watch.curves import PANELS, curve, finite
from jaxpg.watch.page import page

Json = dict[str, Any]
# What does not make another method: how much is looked at, written and waited for, and who draws the numbers.
SAME_METHOD = {"seed", "num_seeds", "vmap_seeds", "run_dir", "cache", "report", "loggers", "total_steps"}
SAME_METHOD |= {"log_interval", "eval_interval", "eval_episodes", "checkpoint_interval", "stop_return", "stop_agents"}
MOST = 10  # methods with a colour of their own
COLUMNS = ["method", "seeds", "environment steps", "return", "success rate"]


class Agent(NamedTuple):
    """One agent of a run.

    Attributes:
      options: all of them, by name.
      seed: its own.
      curves: metric -> {steps: value}, of its evaluations.
    """

    options: dict[str, Any]
    seed: int
    curves: dict[str, dict[int, float]]


class Method(NamedTuple):
    """Agents that differ in their seeds only.

    Attributes:
      label: what distinguishes it from the others.
      agents: at least one.
    """

    label: str
    agents: list[Agent]

    def values(self, metric: str) -> tuple[np.ndarray, np.ndarray]:
        """Steps `[K]` at which all agents have this metric, and its values `[S, K]`."""
        found = [agent.curves.get(metric, {}) for agent in self.agents]
        steps = sorted(set.intersection(*(set(values) for values in found)))
        return np.array(steps), np.array([[values[step] for step in steps] for values in found])

    @property
    def scores(self) -> np.ndarray:
        """The last return that all agents have, `[S]`."""
        return self.values("eval_return")[1][:, -1]


def write(paths: Sequence[str], out: Path, say: Callable[[str], None]) -> None:
    """Writes the page of these run folders, and says what its table says.

    Raises:
      UserError: as `methods`; or the page cannot be written.
    """
    found = methods(paths)
    folder.replace(out, page(comparison(found)))
    rows = [COLUMNS, *table(found)]
    widths = [max(len(row[i]) for row in rows if i < len(row)) for i in range(len(rows[1]))]
    for row in rows:
        say("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=False)).rstrip())
    say(str(out))


def methods(paths: Sequence[str]) -> list[Method]:
    """The methods of these run folders, that with the best interquartile mean at its end first.

    Raises:
      UserError: no run folder, runs of different environments, a run twice, or one that has not been evaluated.
    """
    agents = [agent for path in paths for agent in _agents(path)]
    tasks = sorted({_task(agent) for agent in agents})
    if len(tasks) > 1:
        raise UserError(f"runs of {' and '.join(tasks)}: only returns of the same environment can be compared")
    groups: dict[str, list[Agent]] = {}
    for agent in agents:
        groups.setdefault(repr({k: v for k, v in agent.options.items() if k not in SAME_METHOD}), []).append(agent)
    labels = _labels([group[0].options for group in groups.values()])
    found = [Method(label, group) for label, group in zip(labels, groups.values(), strict=True)]
    for method in found:
        _check(method)
    return sorted(found, key=lambda method: -float(interquartile_mean(method.scores)))


def _task(agent: Agent) -> str:
    return agent.options.get("env.name", agent.options["env"])


def _agents(path: str) -> Iterator[Agent]:
    run_folder = folder.find(path)
    config = configuration.load(run_folder.config)
    lines = folder.read_metrics(run_folder, config.num_agents)
    for i in range(config.num_agents):
        own = alone(config, i)
        curves = {
            metric: {line["steps"]: value for line in lines for value in _of_agent(line, metric, i)}
            for metric in PANELS
        }
        yield Agent(configuration.named(own), own.run.seed, curves)


def _of_agent(line: Json, metric: str, agent: int) -> Iterator[float]:
    """The agent's value in a line of metrics, if it is there and finite."""
    value = np.atleast_1d(np.array(line.get(metric), float))
    if len(value) > agent and np.isfinite(value[agent]):
        yield float(value[agent])


def _labels(options: Sequence[Mapping[str, Any]]) -> list[str]:
    """As few options as tell each from all others, the groups' members first; of a single one its algorithm."""
    names = dict.fromkeys(name for one in options for name in one if name not in SAME_METHOD)
    names = sorted(names, key=lambda name: "." in name)
    chosen: list[str] = []
    for name in names:
        if _kinds(options, [*chosen, name]) > _kinds(options, chosen):
            chosen.append(name)
    chosen = chosen or ["algo"]
    return [" ".join(f"{name}={one[name]}" for name in chosen if name in one) for one in options]


def _kinds(options: Sequence[Mapping[str, Any]], names: Sequence[str]) -> int:
    """How many of the options differ, as far as these names say."""
    return len({tuple(repr(one.get(name)) for name in names) for one in options})


def _check(method: Method) -> None:
    seeds = [agent.seed for agent in method.agents]
    twice = sorted({seed for seed in seeds if seeds.count(seed) > 1})
    if twice:
        raise UserError(f"{method.label}: seed {twice[0]} is there twice; a run counts once")
    if not method.values("eval_return")[0].size:
        raise UserError(f"{method.label}: no evaluation that all its runs have made")


def comparison(found: Sequence[Method]) -> Json:
    """What the page shows of some methods, as plain values."""
    shown = found[:MOST]
    task, rows = _task(found[0].agents[0]), table(found)
    data = {
        "kind": "comparison",
        "title": f"{len(found)} methods on {task}" if len(found) > 1 else f"{found[0].label} on {task}",
        "facts": [["score", "return of the last evaluation that all seeds of a method have"]],
        "curves": [panel for panel in (_panel(shown, *metric) for metric in PANELS.items()) if panel["series"]],
        "tables": [{"title": "methods, the best first", "columns": COLUMNS[: len(rows[0])], "rows": rows}],
        "improvement": improvement(shown) if len(shown) > 1 else None,
        **{"player": None, "portrait": None, "workspace": None},
        "configuration": _common(found),
        "versions": [],
    }
    return finite(data)


def table(found: Sequence[Method]) -> list[list[str]]:
    """A row for each method: what `COLUMNS` says; with several seeds interquartile means and their 95 % intervals."""
    rows = []
    for method in found:
        steps, success = method.values("eval_return")[0][-1], method.values("eval_success")[1]
        rate = results.score(100 * success[:, -1]) + " %" if success.size else ""
        rows.append([method.label, str(len(method.agents)), f"{steps:,}", results.score(method.scores), rate])
    return rows if any(row[-1] for row in rows) else [row[:-1] for row in rows]


def _panel(found: Sequence[Method], metric: str, title: str) -> Json:
    series = [curve(method.label, *method.values(metric)) for method in found if method.values(metric)[0].size]
    return {"title": title, "x": "environment steps", "series": series}


def improvement(found: Sequence[Method]) -> Json:
    """How probable it is that a run of the method of a row is better than one of the column's, with 95 % intervals."""
    pairs = [[None if a is b else (a.scores, b.scores) for b in found] for a in found]
    intervals = [[pair and improvement_interval(*pair) for pair in row] for row in pairs]
    return {
        "labels": [method.label for method in found],
        "probability": [[pair and probability_of_improvement(*pair) for pair in row] for row in pairs],
        "low": [[interval and interval[0] for interval in row] for row in intervals],
        "high": [[interval and interval[1] for interval in row] for row in intervals],
    }


def _common(found: Sequence[Method]) -> list[list[str]]:
    """The options that are the same in all methods."""
    every = [method.agents[0].options for method in found]
    return [
        [name, str(value)]
        for name, value in every[0].items()
        if name not in SAME_METHOD and all(name in one and one[name] == value for one in every)
    ]
