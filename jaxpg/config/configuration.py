"""The configuration of a training run: typed options in groups, and their checks.

Names, types and ranges come from dataclasses of `envs.options.option` fields, so all mistakes are reported at once and
by the names that the user typed. `jaxpg.config.parsing` reads the command line.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import envs
from envs.options import OptionError, build, describe_unknown
from jaxpg.config import conflicts, plain_yaml, registered
from jaxpg.config import sweep as sweeping
from jaxpg.config.entries import GROUPS, find_option_fields
from jaxpg.config.schema import Run
from jaxpg.errors import UserError

DEFAULT_ROLLOUT = 16  # steps of a TD rollout if neither the user nor the environment sets them
LIBRARIES = ("brax", "playground")  # other libraries, whose environments are chosen by the option `name`


@dataclass(frozen=True)
class Config:
    """A checked configuration: the chosen member of each group, its options, and those of the run.

    Attributes:
      choices: group -> member, such as `{"env": "pendulum", "algo": "td", "network": "mlp"}`.
      env, algo, network: options of the members, dataclasses of `GROUPS`.
      run: options of the run.
      sweep: swept option -> its values, which replace the value of the option itself.
    """

    choices: Mapping[str, str]
    env: Any
    algo: Any
    network: Any
    run: Run
    sweep: Mapping[str, list[float]] = field(default_factory=dict)

    @property
    def task(self) -> str:
        """The environment's name; for another library, its name there."""
        return self.env.name if self.choices["env"] in LIBRARIES else self.choices["env"]

    @property
    def num_shards(self) -> int:
        """Number of shards of each agent's environments; 1 for algorithms that do not divide them."""
        return self.algo.num_shards

    @property
    def num_agents(self) -> int:
        return len(sweeping.list_settings(self.sweep)) * self.run.num_seeds

    def to_dict(self) -> dict[str, Any]:
        """Plain nested values, as written to `config.yaml`; `from_dict` is its inverse."""
        groups = {
            group: {"id": choice, **dataclasses.asdict(getattr(self, group))} for group, choice in self.choices.items()
        }
        return groups | dataclasses.asdict(self.run) | {"sweep": dict(self.sweep)}


def from_dict(values: Mapping[str, Any], problems: Sequence[str] = ()) -> Config:
    """Checks plain nested values and makes the configuration from them.

    Args:
      values: as from `Config.to_dict`; `sweep` may be missing.
      problems: problems that are already known.

    Raises:
      OptionError: lists the given problems, and every unknown name, wrong type and value out of range.
    """
    choices = {group: values[group]["id"] for group in GROUPS}
    check_choices(choices)
    problems, parts = list(problems), {}
    rest = {name: value for name, value in values.items() if name not in (*GROUPS, "sweep")}
    sections = [(group, GROUPS[group][choices[group]], dict(values[group])) for group in GROUPS] + [("", Run, rest)]
    for name, schema, options in sections:
        options.pop("id", None)
        try:
            parts[name or "run"] = build(schema, options, prefix=f"{name}." if name else "")
        except OptionError as error:
            problems += error.problems
    try:
        parts["sweep"] = sweeping.check(values.get("sweep", {}), choices)
    except OptionError as error:
        problems += error.problems
    if problems:
        raise OptionError(problems)
    return _complete(Config(choices, **parts))


def _complete(config: Config) -> Config:
    """Sets the rollout length, which depends on algorithm and environment, and checks for conflicts."""
    problems = list(conflicts.find_choice_conflicts(config))
    default = config.env.episode_length if config.algo.whole_episodes else DEFAULT_ROLLOUT
    config = dataclasses.replace(config, run=dataclasses.replace(config.run, num_steps=config.run.num_steps or default))
    problems += conflicts.find_size_conflicts(config)
    if problems:
        raise OptionError(problems)
    return config


def select_choices(values: Mapping[str, Any]) -> dict[str, Any]:
    """The values that choose a member of a group."""
    return {name: value for name, value in values.items() if name in GROUPS}


def split_sweep(values: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The swept values, by the names of their options, and the other values."""
    swept = {name: value for name, value in values.items() if name.startswith(sweeping.PREFIX)}
    plain = {name: value for name, value in values.items() if name not in swept}
    return {name.removeprefix(sweeping.PREFIX): value for name, value in swept.items()}, plain


def check_choices(choices: Mapping[str, Any]) -> None:
    """Raises OptionError for a member of a group that does not exist, with the nearest one."""
    names = {group: str(choice) for group, choice in choices.items()}
    problems = [
        describe_unknown(group, name, GROUPS[group]) for group, name in names.items() if name not in GROUPS[group]
    ]
    if problems:
        raise OptionError(problems)
    if "env" in names:
        envs.find(names["env"])


def describe_unknown_names(given: Mapping[str, Any], choices: Mapping[str, Any]) -> list[str]:
    """One line for each name that is neither an option nor a group; other members of its group may have it."""
    known = {*find_option_fields(choices), *GROUPS}
    return [
        _describe_other_members(name, choices) or describe_unknown("option", name, known)
        for name in given
        if name not in known
    ]


def _describe_other_members(name: str, choices: Mapping[str, Any]) -> str | None:
    """`GROUP=MEMBER has no NAME; GROUP=OTHER has it` if so; else None."""
    group, _, leaf = name.partition(".")
    if group not in ("algo", "network"):
        return None
    others = [member for member in GROUPS[group] if f"{group}.{leaf}" in find_option_fields({group: member})]
    return f"{group}={choices[group]} has no option {name}; {' or '.join(others)} has it" if others else None


def to_yaml(config: Config) -> str:
    """The content of `config.yaml`; `from_yaml` reads it.

    For an environment that is not shipped, it also names the program that registered it.
    """
    return plain_yaml.dump(registered.find_program(config.choices["env"]) | config.to_dict())


def from_yaml(text: str, name: str) -> Config:
    """The configuration in the content of a `config.yaml`, as from `to_yaml`.

    Args:
      text: the content.
      name: name of the file, for messages.

    Raises:
      UserError: it is not a configuration. OptionError: a name, type or range in it is wrong.
    """
    try:
        values = plain_yaml.load(text)
        registered.check_registered(values["env"]["id"], values.pop(registered.PROGRAM, None))
        return from_dict(values)
    except (OptionError, UserError):
        raise
    except Exception as error:  # YAML raises many kinds, and the file may hold anything
        raise make_unreadable_error(name, error) from error


def make_unreadable_error(name: str, error: Exception) -> UserError:
    """The error for a `config.yaml` that cannot be read."""
    return UserError(f"{name}: not a configuration of a run ({' '.join(str(error).split())})")


def change(config: Config, changes: Mapping[str, Any]) -> Config:
    """The configuration with new values, given by dotted name.

    Raises:
      OptionError: an unknown name, another member of a group, a wrong type or a value out of range.
    """
    check_choices({**config.choices, **select_choices(changes)})
    others = [name for name in GROUPS if changes.get(name, config.choices[name]) != config.choices[name]]
    if others:
        raise OptionError([f"{name}={changes[name]}: the run has {name}={config.choices[name]}" for name in others])
    swept, plain = split_sweep(changes)
    problems, values = describe_unknown_names(plain, config.choices), config.to_dict()
    values["sweep"] |= swept
    for name, value in plain.items():
        group, _, leaf = name.rpartition(".")
        if name in find_option_fields(config.choices):
            (values[group] if group else values)[leaf] = value
    return from_dict(values, problems)


def to_arguments(config: Config) -> dict[str, Any]:
    """All values that can be given on the command line, by name: the members of the groups, and all options."""
    return {**config.choices, **flatten(config)}


def flatten(config: Config) -> dict[str, Any]:
    """The values of all options and of the sweep, by their names on the command line."""
    values = config.to_dict()
    options = {
        name: values[group][leaf] if group else values[leaf]
        for name in find_option_fields(config.choices)
        for group, _, leaf in [name.rpartition(".")]
    }
    return options | {sweeping.PREFIX + name: swept for name, swept in config.sweep.items()}
