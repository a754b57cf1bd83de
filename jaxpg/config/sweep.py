"""A sweep: options that have several values in one run; every combination of them is a setting.

`sweep.algo.actor_lr=[0.001,0.003] sweep.algo.gamma=[0.95,0.98]` are four settings. The values are arguments of the
compiled program, so only options that the program takes as numbers can be swept (`jaxpg.config.schema.number`).
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from typing import Any

from envs.options import OptionError, build, describe_unknown
from jaxpg.config.entries import GROUPS, option_fields

PREFIX = "sweep."  # of the option's name, on the command line
Setting = dict[str, float]  # option -> value


def sweepable(choices: Mapping[str, str]) -> dict[str, dataclasses.Field]:
    """The options that can be swept under these choices, by name."""
    return {name: field for name, field in option_fields(choices).items() if "sweepable" in field.metadata}


def settings(sweep: Mapping[str, list[float]]) -> list[Setting]:
    """Every combination of the values, those of the last option changing fastest; without a sweep the empty one.

    >>> settings({"algo.gamma": [0.9, 0.99], "algo.actor_lr": [0.1]})
    [{'algo.gamma': 0.9, 'algo.actor_lr': 0.1}, {'algo.gamma': 0.99, 'algo.actor_lr': 0.1}]
    """
    return [dict(zip(sweep, values, strict=True)) for values in itertools.product(*sweep.values())]


def described(setting: Mapping[str, float]) -> str:
    """The setting as one would give it, such as `algo.gamma=0.98 algo.actor_lr=0.001`."""
    return " ".join(f"{name}={value}" for name, value in setting.items())


def check(sweep: Mapping[str, Any], choices: Mapping[str, str]) -> dict[str, list[float]]:
    """The sweep, once every name, type and range has been checked.

    Args:
      sweep: option -> what was given as its values.
      choices: group -> member.

    Raises:
      OptionError: lists every option that is unknown or cannot be swept, and every value that it cannot have.
    """
    problems = [problem for name, values in sweep.items() for problem in _problems(name, values, choices)]
    if problems:
        raise OptionError(problems)
    return {name: [float(value) for value in values] for name, values in sweep.items()}


def _problems(name: str, values: Any, choices: Mapping[str, str]) -> Iterator[str]:
    known = sweepable(choices)
    if name in {*option_fields(choices), *GROUPS} - known.keys():
        yield f"{PREFIX}{name}: {name} cannot be swept, each of its values needs a run of its own"
    elif name not in known:
        yield describe_unknown("option", PREFIX + name, [PREFIX + other for other in known])
    elif not isinstance(values, list):
        yield f"{PREFIX}{name}={values}: expected a list of values, such as [{values},...]"
    elif not values:
        yield f"{PREFIX}{name}=[]: expected at least one value"
    else:
        yield from _problems_of_values(name, values, choices)


def _problems_of_values(name: str, values: list[Any], choices: Mapping[str, str]) -> Iterator[str]:
    group, _, leaf = name.partition(".")
    for i, value in enumerate(values):
        if value is None:
            yield f"{PREFIX}{name}=null: null cannot be swept, it needs a run of its own"
        elif value in values[:i]:
            yield f"{PREFIX}{name}={value}: is in the list twice"
        else:
            try:
                build(GROUPS[group][choices[group]], {leaf: value}, prefix=f"{PREFIX}{group}.")
            except OptionError as error:
                yield from error.problems
