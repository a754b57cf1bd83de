"""What a training run is told: typed options in groups, checked here.

Names, types and ranges come from dataclasses of `envs.options.option` fields, so that every mistake is reported at once
and in the user's words. `jaxpg.config.parsing` reads the command line.
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
from jaxpg.config.entries import GROUPS, option_fields
from jaxpg.config.schema import Run
from jaxpg.errors import UserError

DEFAULT_ROLLOUT = 16  # steps of a TD rollout where neither the user nor the environment says
LIBRARIES = ("brax", "playground")  # whose environments have names of their own, as the option `name`


@dataclass(frozen=True)
class Config:
    """A checked configuration: which member of each group, its options, and the run's.

    Attributes:
      choices: group -> member, such as `{"env": "pendulum", "algo": "td", "network": "mlp"}`.
      env, algo, network: the members' options, dataclasses of `GROUPS`.
      run: the run's own options.
      sweep: option -> its values, for what is swept; the options themselves then count for nothing.
    """

    choices: Mapping[str, str]
    env: Any
    algo: Any
    network: Any
    run: Run
    sweep: Mapping[str, list[float]] = field(default_factory=dict)

    @property
    def task(self) -> str:
        """The environment's name; of another library's, the name that it has there."""
        return self.env.name if self.choices["env"] in LIBRARIES else self.choices["env"]

    @property
    def num_shards(self) -> int:
        """Parts of each agent's environments; algorithms that do not divide them have one."""
        return self.algo.num_shards

    @property
    def num_agents(self) -> int:
        return len(sweeping.settings(self.sweep)) * self.run.num_seeds

    def to_dict(self) -> dict[str, Any]:
        """Plain nested values, as written to `config.yaml`; `from_dict` is its inverse."""
        groups = {
            group: {"id": choice, **dataclasses.asdict(getattr(self, group))} for group, choice in self.choices.items()
        }
        return groups | dataclasses.asdict(self.run) | {"sweep": dict(self.sweep)}


def from_dict(values: Mapping[str, Any], problems: Sequence[str] = ()) -> Config:
    """The configuration in plain nested values, once everything in it has been checked.

    Args:
      values: as `Config.to_dict` makes them; without a sweep nothing is swept.
      problems: what is known to be wrong already.

    Raises:
      OptionError: lists these, and every unknown name, wrong type and value out of range.
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
    """The rollout length filled in, which depends on algorithm and environment; and what then does not go together."""
    problems = list(conflicts.of_choices(config))
    default = config.env.episode_length if config.algo.whole_episodes else DEFAULT_ROLLOUT
    config = dataclasses.replace(config, run=dataclasses.replace(config.run, num_steps=config.run.num_steps or default))
    problems += conflicts.of_sizes(config)
    if problems:
        raise OptionError(problems)
    return config


def members(values: Mapping[str, Any]) -> dict[str, Any]:
    """Those of the values that choose a member of a group."""
    return {name: value for name, value in values.items() if name in GROUPS}


def divide(values: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """What is swept, by the names of the options, and the other values."""
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


def unknown_names(given: Mapping[str, Any], choices: Mapping[str, Any]) -> list[str]:
    """A line for each name that is no option and no group."""
    known = {*option_fields(choices), *GROUPS}
    return [describe_unknown("option", name, known) for name in given if name not in known]


def to_yaml(config: Config) -> str:
    """The content of `config.yaml`; `from_yaml` reads it.

    Of an environment of somebody's own it says too which program registered it.
    """
    return plain_yaml.dump(registered.program_of(config.choices["env"]) | config.to_dict())


def from_yaml(text: str, name: str) -> Config:
    """The configuration in the content of a `config.yaml`, as `to_yaml` makes it.

    Args:
      text: the content.
      name: of the file, for messages.

    Raises:
      UserError: it is no configuration; OptionError: a name, type or range in it is wrong.
    """
    try:
        values = plain_yaml.load(text)
        registered.check_known(values["env"]["id"], values.pop(registered.PROGRAM, None))
        return from_dict(values)
    except (OptionError, UserError):
        raise
    except Exception as error:  # YAML raises many kinds, and what it reads may be anything; it is not ours
        raise not_a_configuration(name, error) from error


def not_a_configuration(name: str, error: Exception) -> UserError:
    """What is said of a `config.yaml` that cannot be read."""
    return UserError(f"{name}: not a configuration of a run ({' '.join(str(error).split())})")


def change(config: Config, changes: Mapping[str, Any]) -> Config:
    """The configuration with new values, by dotted name.

    Raises:
      OptionError: an unknown name, another member of a group, a wrong type or a value out of range.
    """
    check_choices({**config.choices, **members(changes)})
    others = [name for name in GROUPS if changes.get(name, config.choices[name]) != config.choices[name]]
    if others:
        raise OptionError([f"{name}={changes[name]}: the run has {name}={config.choices[name]}" for name in others])
    swept, plain = divide(changes)
    problems, values = unknown_names(plain, config.choices), config.to_dict()
    values["sweep"] |= swept
    for name, value in plain.items():
        group, _, leaf = name.rpartition(".")
        if name in option_fields(config.choices):
            (values[group] if group else values)[leaf] = value
    return from_dict(values, problems)


def named(config: Config) -> dict[str, Any]:
    """Everything that the command line can say, by its name there: the groups' members, and all options."""
    return {**config.choices, **flatten(config)}


def flatten(config: Config) -> dict[str, Any]:
    """The values of all options, and of the sweep, by their names on the command line."""
    values = config.to_dict()
    options = {
        name: values[group][leaf] if group else values[leaf]
        for name in option_fields(config.choices)
        for group, _, leaf in [name.rpartition(".")]
    }
    return options | {sweeping.PREFIX + name: swept for name, swept in config.sweep.items()}
