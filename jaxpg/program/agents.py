"""The agents of a run: all combinations of the settings of the sweep and the seeds."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxpg.config.configuration import Config
from jaxpg.config.sweep import Setting, format_setting, list_settings


class Agents(NamedTuple):
    """The arguments of the compiled program, for each of its agents.

    Attributes:
      seed: seeds, `[S]`.
      values: values of the swept options, `[S]` by name; empty without a sweep.
    """

    seed: np.ndarray
    values: dict[str, np.ndarray]


def list_agents(config: Config) -> Agents:
    """The agents of a run: the seeds seed, seed + 1, ... of the first setting, then those of the second, ..."""
    return combine(list_settings(config.sweep), range(config.run.seed, config.run.seed + config.run.num_seeds))


def combine(settings: Sequence[Setting], seeds: Sequence[int]) -> Agents:
    """Every setting with every seed, ordered by setting.

    >>> agents = combine([{"algo.gamma": 0.5}, {"algo.gamma": 0.75}], seeds=[3, 4])
    >>> agents.seed.tolist(), agents.values["algo.gamma"].tolist()
    ([3, 4, 3, 4], [0.5, 0.5, 0.75, 0.75])
    """
    values = {name: np.array([setting[name] for setting in settings], np.float32) for name in settings[0]}
    return Agents(
        np.tile(np.array(seeds, np.uint32), len(settings)),
        {name: np.repeat(column, len(seeds)) for name, column in values.items()},
    )


def replace_values(config: Config, values: Mapping[str, Any]) -> Config:
    """The configuration with new values of some options, by name; the values may be traced by JAX."""
    for name, value in values.items():
        group, _, leaf = name.partition(".")
        options = dataclasses.replace(getattr(config, group), **{leaf: value})
        config = dataclasses.replace(config, **{group: options})
    return config


def get_setting(config: Config, agent: int) -> Setting:
    """The setting of one agent, by its index in `list_agents`."""
    return list_settings(config.sweep)[agent // config.run.num_seeds]


def select_agent(config: Config, agent: int) -> Config:
    """The configuration of a run with one agent only, by its index in `list_agents`."""
    seed = config.run.seed + agent % config.run.num_seeds
    run = dataclasses.replace(config.run, seed=seed, num_seeds=1, vmap_seeds=1)
    return dataclasses.replace(replace_values(config, get_setting(config, agent)), run=run, sweep={})


def describe_agent(config: Config, agent: int) -> str:
    """Describes one agent, such as `seed 3 algo.gamma=0.9`."""
    return f"seed {select_agent(config, agent).run.seed} {format_setting(get_setting(config, agent))}".strip()


def describe_run(config: Config) -> str:
    """Describes the run and its agents, such as `td on pendulum, 6 settings x seeds 0 to 3`."""
    run, number = config.run, len(list_settings(config.sweep))
    seeds = f"seeds {run.seed} to {run.seed + run.num_seeds - 1}" if run.num_seeds > 1 else f"seed {run.seed}"
    agents = f"{number} settings x {seeds}" if config.sweep else seeds
    return f"{config.choices['algo']} on {config.task}, {agents}"
