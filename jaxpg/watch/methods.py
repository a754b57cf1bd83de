"""Methods: runs that differ in their seeds only, and where they stand at equal numbers of steps.

A method is all options that training depends on but the seed. Agents of the same method, whichever runs they are of,
are its seeds; each setting of a sweep is a method of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxpg.config import configuration
from jaxpg.errors import UserError
from jaxpg.program.agents import alone
from jaxpg.store import config_file, folder
from jaxpg.store.statistics import interquartile_mean
from jaxpg.watch.curves import PANELS

# What does not make another method: how much is looked at, written and waited for, and who draws the numbers.
SAME_METHOD = {"seed", "num_seeds", "vmap_seeds", "run_dir", "cache", "report", "loggers", "total_steps"}
SAME_METHOD |= {"log_interval", "eval_interval", "eval_episodes", "checkpoint_interval", "stop_return", "stop_agents"}


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
    def reached(self) -> int:
        """The last steps at which all agents have been evaluated."""
        return int(self.values("eval_return")[0][-1])

    @property
    def longest(self) -> int:
        """The last steps at which one of the agents has been evaluated."""
        return max(max(agent.curves["eval_return"]) for agent in self.agents)

    def at(self, metric: str, steps: int) -> tuple[int, np.ndarray]:
        """The steps nearest to these at which all agents have this metric, and its values there, `[S]`."""
        every, values = self.values(metric)
        nearest = int(np.argmin(np.abs(every - steps)))
        return int(every[nearest]), values[:, nearest]


class Standing(NamedTuple):
    """A method at the steps where methods are compared.

    Attributes:
      method: itself.
      steps: of the evaluation that counts.
      returns: there, `[S]`.
      success: the success rate there, `[S]`; None where the environment does not say.
    """

    method: Method
    steps: int
    returns: np.ndarray
    success: np.ndarray | None


def methods(paths: Sequence[str]) -> list[Method]:
    """The methods of these run folders, that with the best interquartile mean at equal steps first.

    Raises:
      UserError: no run folder, runs of different environments, a run twice, or one that has not been evaluated.
    """
    of_runs = [list(_agents(path)) for path in paths]
    _check_one_task([(task(agents[0]), path) for agents, path in zip(of_runs, paths, strict=True)])
    agents = [agent for agents in of_runs for agent in agents]
    groups: dict[str, list[Agent]] = {}
    for agent in agents:
        groups.setdefault(repr({k: v for k, v in agent.options.items() if k not in SAME_METHOD}), []).append(agent)
    labels = _labels([group[0].options for group in groups.values()])
    found = [Method(label, group) for label, group in zip(labels, groups.values(), strict=True)]
    for method in found:
        _check(method)
    best = sorted(standings(found), key=lambda one: -float(interquartile_mean(one.returns)))
    return [one.method for one in best]


def _check_one_task(runs: Sequence[tuple[str, str]]) -> None:
    tasks: dict[str, list[str]] = {}
    for name, path in sorted(runs):
        tasks.setdefault(name, []).append(path)
    if len(tasks) > 1:
        where = "; ".join(f"{name} in {', '.join(paths)}" for name, paths in tasks.items())
        raise UserError(f"only returns of one environment can be compared: {where}")


def compared_at(found: Sequence[Method]) -> int:
    """The most environment steps that all methods have reached."""
    return min(method.reached for method in found)


def standings(found: Sequence[Method]) -> list[Standing]:
    """Each method at the evaluation nearest to the steps that all have reached: who trained longer has no advantage."""
    steps, stand = compared_at(found), []
    for method in found:
        at, returns = method.at("eval_return", steps)
        success = method.at("eval_success", at)[1] if method.values("eval_success")[0].size else None
        stand.append(Standing(method, at, returns, success))
    return stand


def task(agent: Agent) -> str:
    """What the agent was trained on."""
    return agent.options.get("env.name", agent.options["env"])


def _agents(path: str) -> Iterator[Agent]:
    run_folder = folder.find(path)
    config = config_file.load(run_folder.config)
    lines = folder.read_metrics(run_folder, config.num_agents)
    for i in range(config.num_agents):
        own = alone(config, i)
        curves = {
            metric: {line["steps"]: value for line in lines for value in _of_agent(line, metric, i)}
            for metric in PANELS
        }
        yield Agent(configuration.named(own), own.run.seed, curves)


def _of_agent(line: Mapping[str, Any], metric: str, agent: int) -> Iterator[float]:
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
