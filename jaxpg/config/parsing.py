"""The command line: `env=arm algo=td algo.lambda_=0.9 seed=3`.

Values that are not given come from the environment's registry entry, which has tuned values, or else from the
dataclasses.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from jaxpg.config import plain_yaml, registered
from jaxpg.config.configuration import (
    Config,
    check_choices,
    describe_unknown_names,
    from_dict,
    select_choices,
    split_sweep,
)
from jaxpg.config.conflicts import find_nearest_divisor
from jaxpg.config.entries import GROUPS, find_option_fields
from jaxpg.config.schema import LARGEST, Gaussian, Run
from jaxpg.errors import UserError

DEFAULT_CHOICES = {"env": "pendulum", "algo": "td", "network": "mlp"}  # algo: the environment's first tuned one
NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(\.[A-Za-z_][A-Za-z0-9_]*)*")
FOLDERS = ("run_dir", "resume", "run", "out")  # options whose value is a path


def compose(arguments: Sequence[str]) -> Config:
    """The configuration for a command line.

    Args:
      arguments: texts `name=value`.

    Raises:
      OptionError, UserError: lists every unknown name, wrong type and value out of range, on the command line or in the
        environment's training values; or an argument is not `name=value`.
    """
    given = parse(arguments)
    check_choices(select_choices(given))
    tuned = _fit_divisors(_read_tuned_values(select_choices(given)), given)
    choices = DEFAULT_CHOICES | select_choices(tuned) | select_choices(given)
    check_choices(choices)
    swept, plain = split_sweep(given)
    problems = describe_unknown_names(plain, choices)
    problems += [f"{name} is both given and swept; leave one out" for name in plain if name in swept]
    values = {name: value for name, value in tuned.items() if name in _find_tunable_options(tuned, choices)} | plain
    return from_dict({**_add_defaults(choices, values), "sweep": swept}, problems)


def _read_tuned_values(chosen: Mapping[str, Any]) -> Mapping[str, Any]:
    """The algorithm, by default the environment's first tuned one, and the environment's values for it."""
    name = chosen.get("env", DEFAULT_CHOICES["env"])
    training = registered.read_training_values(name)
    algo = chosen.get("algo", next(iter(training), DEFAULT_CHOICES["algo"]))
    return {"algo": algo, **training.get(algo, {})}


def _find_tunable_options(tuned: Mapping[str, Any], choices: Mapping[str, str]) -> set[str]:
    """The options whose tuned values apply; values tuned for another network than the chosen one do not."""
    known = set(find_option_fields(choices))
    if choices["network"] == tuned.get("network", DEFAULT_CHOICES["network"]):
        return known
    names = {field.name for field in dataclasses.fields(GROUPS["network"][choices["network"]])}
    return known - {f"network.{name}" for name in names - {field.name for field in dataclasses.fields(Gaussian)}}


def _fit_divisors(tuned: Mapping[str, Any], given: Mapping[str, Any]) -> Mapping[str, Any]:
    """Adjusts the tuned numbers of shards and minibatches so that they divide the number of environments."""
    num_envs, adjusted = given.get("num_envs", tuned.get("num_envs")), {}
    if not isinstance(num_envs, int) or not 1 <= num_envs <= LARGEST:
        return tuned
    divisors = ("algo.num_shards", "algo.minibatches")
    for name in divisors:
        if isinstance(given.get(name), int) and given[name] in range(1, num_envs + 1):
            num_envs //= given[name]  # if it does not divide them, the given options conflict
    for name in divisors:
        if name in tuned and name not in given:
            adjusted[name] = find_nearest_divisor(num_envs, tuned[name])
            num_envs //= adjusted[name]
    return {**tuned, **adjusted}


def parse(arguments: Sequence[str]) -> dict[str, Any]:
    """`name=value` arguments as plain values: numbers, true, false, null, text, and lists of these.

    A value is read as in `config.yaml`; a path is taken literally.

    Raises:
      UserError: an argument does not have this form, or a name is given twice.
    """
    given = {}
    for argument in arguments:
        name, equals, text = argument.partition("=")
        if not (equals and NAME.fullmatch(name)):
            raise _make_syntax_error(argument)
        if name in given:
            raise UserError(f"{name} is given twice")
        given[name] = text if name in FOLDERS and text else _parse_value(text, argument)
    return given


def _parse_value(text: str, argument: str) -> Any:
    try:
        return plain_yaml.load_value(text) if text else text
    except yaml.YAMLError:
        raise _make_syntax_error(argument) from None


def _make_syntax_error(argument: str) -> UserError:
    return UserError(f"'{argument}': expected name=value, such as seed=3; see --help")


def _add_defaults(choices: Mapping[str, str], values: Mapping[str, Any]) -> dict[str, Any]:
    """The options of the run and of the chosen members, nested, with defaults where no value is given."""
    groups = {group: {"id": name, **dataclasses.asdict(GROUPS[group][name]())} for group, name in choices.items()}
    nested = {**dataclasses.asdict(Run()), **groups}
    for name in find_option_fields(choices).keys() & values.keys():
        group, _, leaf = name.rpartition(".")
        (nested[group] if group else nested)[leaf] = values[name]
    return nested
