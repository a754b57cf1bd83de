"""The agents of a run: each setting of the sweep with each seed."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxpg.config import sweep
from jaxpg.config.configuration import Config
from jaxpg.config.sweep import Setting, list_settings


class Agents(NamedTuple):
    """What the compiled program is told of its agents.

    Attributes:
      seed: `[S]`.
      values: of the swept options, `[S]` by name; empty without a sweep.
    """

    seed: np.ndarray
    values: dict[str, np.ndarray]


def agents_of(config: Config) -> Agents:
    """The agents of a run: the seeds seed, seed + 1, ... of the first setting, then those of the second, ..."""
    return crossed(list_settings(config.sweep), range(config.run.seed, config.run.seed + config.run.num_seeds))


def crossed(settings: Sequence[Setting], seeds: Sequence[int]) -> Agents:
    """Every setting with every seed, setting by setting.

    >>> agents = crossed([{"algo.gamma": 0.5}, {"algo.gamma": 0.75}], seeds=[3, 4])
    >>> agents.seed.tolist(), agents.values["algo.gamma"].tolist()
    ([3, 4, 3, 4], [0.5, 0.5, 0.75, 0.75])
    """
    values = {name: np.array([setting[name] for setting in settings], np.float32) for name in settings[0]}
    return Agents(
        np.tile(np.array(seeds, np.uint32), len(settings)),
        {name: np.repeat(column, len(seeds)) for name, column in values.items()},
    )


def with_values(config: Config, values: Mapping[str, Any]) -> Config:
    """The configuration with other values of some options, by their names; numbers, or what JAX traces instead."""
    for name, value in values.items():
        group, _, leaf = name.partition(".")
        options = dataclasses.replace(getattr(config, group), **{leaf: value})
        config = dataclasses.replace(config, **{group: options})
    return config


def setting_of(config: Config, agent: int) -> Setting:
    """The setting of one agent, counted from 0 as in `agents_of`."""
    return list_settings(config.sweep)[agent // config.run.num_seeds]


def alone(config: Config, agent: int) -> Config:
    """The configuration of a run of one agent, counted from 0 as in `agents_of`."""
    seed = config.run.seed + agent % config.run.num_seeds
    run = dataclasses.replace(config.run, seed=seed, num_seeds=1, vmap_seeds=1)
    return dataclasses.replace(with_values(config, setting_of(config, agent)), run=run, sweep={})


def described_agent(config: Config, agent: int) -> str:
    """One agent in words, such as `seed 3 algo.gamma=0.9`."""
    return f"seed {alone(config, agent).run.seed} {sweep.format_setting(setting_of(config, agent))}".strip()


def described(config: Config) -> str:
    """The run and its agents in words, such as `td on pendulum, 6 settings x seeds 0 to 3`."""
    run, number = config.run, len(list_settings(config.sweep))
    seeds = f"seeds {run.seed} to {run.seed + run.num_seeds - 1}" if run.num_seeds > 1 else f"seed {run.seed}"
    agents = f"{number} settings x {seeds}" if config.sweep else seeds
    return f"{config.choices['algo']} on {config.task}, {agents}"
