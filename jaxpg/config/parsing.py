"""The command line: `env=arm algo=td algo.lambda_=0.9 seed=3`.

Values that nobody gave come from the environment's registry entry, which keeps what was tuned on it, and else from the
dataclasses.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from jaxpg.config import plain_yaml, registered
from jaxpg.config.configuration import Config, check_choices, divide, from_dict, members, unknown_names
from jaxpg.config.conflicts import nearest_divisor
from jaxpg.config.entries import GROUPS, option_fields
from jaxpg.config.schema import LARGEST, Gaussian, Run
from jaxpg.errors import UserError

DEFAULT_CHOICES = {"env": "pendulum", "algo": "td", "network": "mlp"}  # algo: the first that the environment has tuned
NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(\.[A-Za-z_][A-Za-z0-9_]*)*")
FOLDERS = ("run_dir", "resume", "run", "out")  # options whose value is a path


def compose(arguments: Sequence[str]) -> Config:
    """The configuration that a command line asks for.

    Args:
      arguments: `name=value`.

    Raises:
      OptionError, UserError: every unknown name, wrong type and value out of range, of the command line or of the
        environment's training values; or text that is no `name=value`.
    """
    given = parse(arguments)
    check_choices(members(given))
    tuned = _fitting(_tuned(members(given)), given)
    choices = DEFAULT_CHOICES | members(tuned) | members(given)
    check_choices(choices)
    swept, plain = divide(given)
    problems = unknown_names(plain, choices)
    problems += [f"{name} is given and swept: leave out one of them" for name in plain if name in swept]
    values = {name: value for name, value in tuned.items() if name in _tunable(tuned, choices)} | plain
    return from_dict({**_with_defaults(choices, values), "sweep": swept}, problems)


def _tuned(chosen: Mapping[str, Any]) -> Mapping[str, Any]:
    """What the environment's registry entry says: its algorithm where none was chosen, and that one's values."""
    name = chosen.get("env", DEFAULT_CHOICES["env"])
    training = registered.training_values(name)
    algo = chosen.get("algo", next(iter(training), DEFAULT_CHOICES["algo"]))
    return {"algo": algo, **training.get(algo, {})}


def _tunable(tuned: Mapping[str, Any], choices: Mapping[str, str]) -> set[str]:
    """The options whose tuned values count: those of another network than the chosen one say nothing of it."""
    known = set(option_fields(choices))
    if choices["network"] == tuned.get("network", DEFAULT_CHOICES["network"]):
        return known
    own = {field.name for field in dataclasses.fields(GROUPS["network"][choices["network"]])}
    return known - {f"network.{name}" for name in own - {field.name for field in dataclasses.fields(Gaussian)}}


def _fitting(tuned: Mapping[str, Any], given: Mapping[str, Any]) -> Mapping[str, Any]:
    """The tuned values with numbers of shards, and of minibatches of each, that divide the environments asked for."""
    left, fitting = given.get("num_envs", tuned.get("num_envs")), {}
    if not isinstance(left, int) or not 1 <= left <= LARGEST:
        return tuned
    divisors = ("algo.num_shards", "algo.minibatches")
    for name in divisors:
        if isinstance(given.get(name), int) and given[name] in range(1, left + 1):
            left //= given[name]  # where it does not divide them, that is a conflict of what was asked for
    for name in divisors:
        if name in tuned and name not in given:
            fitting[name] = nearest_divisor(left, tuned[name])
            left //= fitting[name]
    return {**tuned, **fitting}


def parse(arguments: Sequence[str]) -> dict[str, Any]:
    """`name=value` arguments as plain values: numbers, true, false, null, text, and lists of these.

    A value is read as `config.yaml` would read it; a path stands as it is.

    Raises:
      UserError: an argument is not of that form, or a name is given twice.
    """
    given = {}
    for argument in arguments:
        name, equals, text = argument.partition("=")
        if not (equals and NAME.fullmatch(name)):
            raise _not_an_assignment(argument)
        if name in given:
            raise UserError(f"{name} is given twice")
        given[name] = text if name in FOLDERS and text else _value(text, argument)
    return given


def _value(text: str, argument: str) -> Any:
    try:
        return plain_yaml.load_value(text) if text else text
    except yaml.YAMLError:
        raise _not_an_assignment(argument) from None


def _not_an_assignment(argument: str) -> UserError:
    return UserError(f"'{argument}': expected name=value, such as seed=3; see --help")


def _with_defaults(choices: Mapping[str, str], values: Mapping[str, Any]) -> dict[str, Any]:
    """The groups' members and the run's own options with their defaults, but for the values given, nested."""
    members = {group: {"id": name, **dataclasses.asdict(GROUPS[group][name]())} for group, name in choices.items()}
    nested = {**dataclasses.asdict(Run()), **members}
    for name in option_fields(choices).keys() & values.keys():
        group, _, leaf = name.rpartition(".")
        (nested[group] if group else nested)[leaf] = values[name]
    return nested
