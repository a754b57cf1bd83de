"""Groups runs by method, and compares methods at equal numbers of steps.

A method is all options that training depends on, except the seed. Agents with the same method, from whichever runs, are
its seeds; each setting of a sweep is a separate method.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxpg.config import configuration
from jaxpg.errors import UserError
from jaxpg.program.agents import select_agent
from jaxpg.store import config_file, folder
from jaxpg.store.statistics import interquartile_mean
from jaxpg.watch.curves import PANELS

# Options that do not distinguish methods: seeds, the length of training, and what is evaluated and written.
SAME_METHOD = {"seed", "num_seeds", "vmap_seeds", "run_dir", "cache", "report", "loggers", "total_steps"}
SAME_METHOD |= {"log_interval", "eval_interval", "eval_episodes", "checkpoint_interval", "stop_return", "stop_agents"}


class Agent(NamedTuple):
    """One agent of a run.

    Attributes:
      options: all options, by name.
      seed: seed of the agent.
      curves: metric -> {steps: value}, from its evaluations.
    """

    options: dict[str, Any]
    seed: int
    curves: dict[str, dict[int, float]]


class Method(NamedTuple):
    """Agents that differ in their seeds only.

    Attributes:
      label: the options that distinguish it from the others.
      agents: at least one.
    """

    label: str
    agents: list[Agent]

    def values(self, metric: str) -> tuple[np.ndarray, np.ndarray]:
        """Steps `[K]` at which all agents have this metric, and its values `[S, K]`."""
        curves = [agent.curves.get(metric, {}) for agent in self.agents]
        steps = sorted(set.intersection(*(set(values) for values in curves)))
        return np.array(steps), np.array([[values[step] for step in steps] for values in curves])

    @property
    def max_common_steps(self) -> int:
        """The largest number of steps at which all agents have been evaluated."""
        return int(self.values("eval_return")[0][-1])

    @property
    def max_steps(self) -> int:
        """The largest number of steps at which any agent has been evaluated."""
        return max(max(agent.curves["eval_return"]) for agent in self.agents)

    def at(self, metric: str, steps: int) -> tuple[int, np.ndarray]:
        """The number of steps nearest to `steps` at which all agents have this metric, and its values, `[S]`."""
        all_steps, values = self.values(metric)
        nearest = int(np.argmin(np.abs(all_steps - steps)))
        return int(all_steps[nearest]), values[:, nearest]


class Standing(NamedTuple):
    """A method at the number of steps where methods are compared.

    Attributes:
      method: the method.
      steps: steps of the evaluation that counts.
      returns: its returns, `[S]`.
      success: its success rates, `[S]`; None if the environment has none.
    """

    method: Method
    steps: int
    returns: np.ndarray
    success: np.ndarray | None


def read_methods(paths: Sequence[str]) -> list[Method]:
    """The methods in these run folders, best interquartile mean at equal steps first.

    Raises:
      UserError: a path is not a run folder, the environments differ, a run is given twice, or a run has not been
        evaluated.
    """
    of_runs = [list(_read_agents(path)) for path in paths]
    _check_one_task([(task_name(agents[0]), path) for agents, path in zip(of_runs, paths, strict=True)])
    agents = [agent for agents in of_runs for agent in agents]
    groups: dict[str, list[Agent]] = {}
    for agent in agents:
        groups.setdefault(repr({k: v for k, v in agent.options.items() if k not in SAME_METHOD}), []).append(agent)
    labels = _make_labels([group[0].options for group in groups.values()])
    methods = [Method(label, group) for label, group in zip(labels, groups.values(), strict=True)]
    for method in methods:
        _check_method(method)
    ranked = sorted(compute_standings(methods), key=lambda one: -float(interquartile_mean(one.returns)))
    return [one.method for one in ranked]


def _check_one_task(runs: Sequence[tuple[str, str]]) -> None:
    tasks: dict[str, list[str]] = {}
    for name, path in sorted(runs):
        tasks.setdefault(name, []).append(path)
    if len(tasks) > 1:
        where = "; ".join(f"{name} in {', '.join(paths)}" for name, paths in tasks.items())
        raise UserError(f"returns can only be compared in the same environment: {where}")


def common_steps(methods: Sequence[Method]) -> int:
    """The largest number of environment steps that all methods have reached."""
    return min(method.max_common_steps for method in methods)


def compute_standings(methods: Sequence[Method]) -> list[Standing]:
    """Each method at the evaluation nearest to `common_steps`: longer training gives no advantage."""
    steps, standings = common_steps(methods), []
    for method in methods:
        at, returns = method.at("eval_return", steps)
        success = method.at("eval_success", at)[1] if method.values("eval_success")[0].size else None
        standings.append(Standing(method, at, returns, success))
    return standings


def task_name(agent: Agent) -> str:
    """The environment that the agent was trained in."""
    return agent.options.get("env.name", agent.options["env"])


def _read_agents(path: str) -> Iterator[Agent]:
    run_folder = folder.find(path)
    config = config_file.load(run_folder.config)
    lines = folder.read_metrics(run_folder, config.num_agents)
    for i in range(config.num_agents):
        agent_config = select_agent(config, i)
        curves = {
            metric: {line["steps"]: value for line in lines for value in _find_value(line, metric, i)}
            for metric in PANELS
        }
        yield Agent(configuration.to_arguments(agent_config), agent_config.run.seed, curves)


def _find_value(line: Mapping[str, Any], metric: str, agent: int) -> Iterator[float]:
    """Yields the agent's value in a line of metrics, if it is there and finite."""
    value = np.atleast_1d(np.array(line.get(metric), float))
    if len(value) > agent and np.isfinite(value[agent]):
        yield float(value[agent])


def _make_labels(options: Sequence[Mapping[str, Any]]) -> list[str]:
    """Labels of a few options that distinguish the methods, groups' choices first; the algorithm for a single one."""
    names = dict.fromkeys(name for one in options for name in one if name not in SAME_METHOD)
    names = sorted(names, key=lambda name: "." in name)
    selected: list[str] = []
    for name in names:
        if _count_distinct(options, [*selected, name]) > _count_distinct(options, selected):
            selected.append(name)
    selected = selected or ["algo"]
    return [" ".join(f"{name}={one[name]}" for name in selected if name in one) for one in options]


def _count_distinct(options: Sequence[Mapping[str, Any]], names: Sequence[str]) -> int:
    """The number of distinct options, as far as these names show."""
    return len({tuple(repr(one.get(name)) for name in names) for one in options})


def _check_method(method: Method) -> None:
    seeds = [agent.seed for agent in method.agents]
    duplicates = sorted({seed for seed in seeds if seeds.count(seed) > 1})
    if duplicates:
        raise UserError(f"{method.label}: seed {duplicates[0]} occurs twice; give each run once")
    if not method.values("eval_return")[0].size:
        raise UserError(f"{method.label}: its runs have no evaluation in common")
