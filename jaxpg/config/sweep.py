"""Sweeps: options with several values in one run; every combination of the values is a setting.

`sweep.algo.actor_lr=[0.001,0.003] sweep.algo.gamma=[0.95,0.98]` gives four settings. The values are arguments of the
compiled program, so only options made with `jaxpg.config.schema.number` can be swept.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from typing import Any

from envs.options import OptionError, build, describe_unknown
from jaxpg.config.entries import GROUPS, find_option_fields

PREFIX = "sweep."  # before the option's name, on the command line
Setting = dict[str, float]  # option -> value


def find_sweepable_options(choices: Mapping[str, str]) -> dict[str, dataclasses.Field]:
    """The options that can be swept under these choices, by name."""
    return {name: field for name, field in find_option_fields(choices).items() if "sweepable" in field.metadata}


def list_settings(sweep: Mapping[str, list[float]]) -> list[Setting]:
    """All combinations of the values, the last option changing fastest; one empty setting without a sweep.

    >>> list_settings({"algo.gamma": [0.9, 0.99], "algo.actor_lr": [0.1]})
    [{'algo.gamma': 0.9, 'algo.actor_lr': 0.1}, {'algo.gamma': 0.99, 'algo.actor_lr': 0.1}]
    """
    return [dict(zip(sweep, values, strict=True)) for values in itertools.product(*sweep.values())]


def format_setting(setting: Mapping[str, float]) -> str:
    """The setting as on the command line, such as `algo.gamma=0.98 algo.actor_lr=0.001`."""
    return " ".join(f"{name}={value}" for name, value in setting.items())


def check(sweep: Mapping[str, Any], choices: Mapping[str, str]) -> dict[str, list[float]]:
    """Checks the names, types and ranges of a sweep, and returns it.

    Args:
      sweep: option -> its values, as given.
      choices: group -> member.

    Raises:
      OptionError: lists every option that is unknown or cannot be swept, and every invalid value.
    """
    problems = [problem for name, values in sweep.items() for problem in _find_problems(name, values, choices)]
    if problems:
        raise OptionError(problems)
    return {name: [float(value) for value in values] for name, values in sweep.items()}


def _find_problems(name: str, values: Any, choices: Mapping[str, str]) -> Iterator[str]:
    known = find_sweepable_options(choices)
    if name in {*find_option_fields(choices), *GROUPS} - known.keys():
        yield f"{PREFIX}{name}: {name} cannot be swept; train a run for each value"
    elif name not in known:
        yield describe_unknown("option", PREFIX + name, [PREFIX + other for other in known])
    elif not isinstance(values, list):
        yield f"{PREFIX}{name}={values}: expected a list of values, such as [{values},...]"
    elif not values:
        yield f"{PREFIX}{name}=[]: expected at least one value"
    else:
        yield from _find_value_problems(name, values, choices)


def _find_value_problems(name: str, values: list[Any], choices: Mapping[str, str]) -> Iterator[str]:
    group, _, leaf = name.partition(".")
    for i, value in enumerate(values):
        if value is None:
            yield f"{PREFIX}{name}=null: null cannot be swept; train a run for it"
        elif value in values[:i]:
            yield f"{PREFIX}{name}={value}: appears twice in the list"
        else:
            try:
                build(GROUPS[group][choices[group]], {leaf: value}, prefix=f"{PREFIX}{group}.")
            except OptionError as error:
                yield from error.problems
