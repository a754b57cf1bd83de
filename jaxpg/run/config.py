"""What a training run is told: typed options in groups, composed and checked here.

The command line is in Hydra's grammar: `env=arm algo=td algo.lambda_=0.9 seed=3`. Names, types and ranges come from
dataclasses of `envs.options.option` fields, so that every mistake is reported at once and in the user's words. Values
that nobody gave come from the environment's registry entry, which keeps what was tuned on it, and else from the
dataclasses. Hydra reads values and nothing more: a program that runs under Hydra itself has its state to itself, and
what a user writes stands as it is written, `${...}` too.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import envs
from envs.options import OptionError, build, unknown
from jaxpg.run import conflicts, files, plain_yaml, registered
from jaxpg.run import sweep as sweeping
from jaxpg.run.conflicts import nearest_divisor
from jaxpg.run.errors import UserError
from jaxpg.run.schema import GROUPS, LARGEST, Gaussian, Run, option_fields

DEFAULT_CHOICES = {"env": "pendulum", "algo": "td", "network": "mlp"}  # algo: the first that the environment has tuned
FOLDERS = ("run_dir", "resume", "run", "out")  # options whose value is a path
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
        return getattr(self.algo, "num_shards", 1)

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
    _check_choices(choices)
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
    default = config.env.episode_length if config.choices["algo"] == "reinforce" else DEFAULT_ROLLOUT
    config = dataclasses.replace(config, run=dataclasses.replace(config.run, num_steps=config.run.num_steps or default))
    problems += conflicts.of_sizes(config)
    if problems:
        raise OptionError(problems)
    return config


def compose(arguments: Sequence[str]) -> Config:
    """The configuration that a command line asks for.

    Args:
      arguments: overrides in Hydra's grammar, `name=value`.

    Raises:
      OptionError, UserError: every unknown name, wrong type and value out of range, of the command line or of the
        environment's training values; or text that is no override.
    """
    given = parse(arguments)
    _check_choices(_members(given))
    tuned = _fitting(_tuned(_members(given)), given)
    choices = DEFAULT_CHOICES | _members(tuned) | _members(given)
    _check_choices(choices)
    swept, plain = _divide(given)
    problems = _unknown_names(plain, choices)
    problems += [f"{name} is given and swept: leave out one of them" for name in plain if name in swept]
    values = {name: value for name, value in tuned.items() if name in _tunable(tuned, choices)} | plain
    return from_dict({**_with_defaults(choices, values), "sweep": swept}, problems)


def _members(values: Mapping[str, Any]) -> dict[str, Any]:
    """Those of the values that choose a member of a group."""
    return {name: value for name, value in values.items() if name in GROUPS}


def _divide(values: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """What is swept, by the names of the options, and the other values."""
    swept = {name: value for name, value in values.items() if name.startswith(sweeping.PREFIX)}
    plain = {name: value for name, value in values.items() if name not in swept}
    return {name.removeprefix(sweeping.PREFIX): value for name, value in swept.items()}, plain


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
    """`name=value` arguments read by Hydra's grammar into plain values.

    Raises:
      UserError: an argument is not of that form, or a name is given twice.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    parser, given = OverridesParser.create(), {}
    for argument in arguments:
        name, _, text = argument.partition("=")
        if name in FOLDERS and text:
            value = text  # as it stands: Hydra's grammar has no brackets, commas or spaces in plain words
        else:
            try:
                override = parser.parse_override(argument)
            except HydraException:
                raise _not_an_override(argument) from None
            if override.type.name != "CHANGE" or override.package or override.is_sweep_override():
                raise _not_an_override(argument)
            name, value = override.key_or_group, _plain(override.value())
        if name in given:
            raise UserError(f"{name} is given twice")
        given[name] = value
    return given


def _not_an_override(argument: str) -> UserError:
    return UserError(f"'{argument}': expected name=value, such as seed=3; see --help")


def _plain(value: Any) -> Any:
    """Hydra's quoted strings as str, also inside lists."""
    if isinstance(value, list):
        return [_plain(element) for element in value]
    is_plain = isinstance(value, (bool, int, float, dict)) or value is None
    return value if is_plain else str(getattr(value, "text", value))


def _check_choices(choices: Mapping[str, Any]) -> None:
    names = {group: str(choice) for group, choice in choices.items()}
    problems = [unknown(group, name, GROUPS[group]) for group, name in names.items() if name not in GROUPS[group]]
    if problems:
        raise OptionError(problems)
    if "env" in names:
        envs.find(names["env"])


def _unknown_names(given: Mapping[str, Any], choices: Mapping[str, Any]) -> list[str]:
    """A line for each name that is no option and no group."""
    known = {*option_fields(choices), *GROUPS}
    return [unknown("option", name, known) for name in given if name not in known]


def _with_defaults(choices: Mapping[str, str], values: Mapping[str, Any]) -> dict[str, Any]:
    """The groups' members and the run's own options with their defaults, but for the values given, nested."""
    members = {group: {"id": name, **dataclasses.asdict(GROUPS[group][name]())} for group, name in choices.items()}
    nested = {**dataclasses.asdict(Run()), **members}
    for name in option_fields(choices).keys() & values.keys():
        group, _, leaf = name.rpartition(".")
        (nested[group] if group else nested)[leaf] = values[name]
    return nested


def to_yaml(config: Config) -> str:
    """The content of `config.yaml`; `load` reads it.

    Of an environment of somebody's own it says too which program registered it.
    """
    return plain_yaml.dump(registered.program_of(config.choices["env"]) | config.to_dict())


def load(path: Path) -> Config:
    """The configuration in a `config.yaml`.

    Raises:
      UserError: the file cannot be read; OptionError: a name, type or range in it is wrong.
    """
    try:
        values = plain_yaml.load(files.read(path).decode())
        registered.check_known(values["env"]["id"], values.pop(registered.PROGRAM, None))
        return from_dict(values)
    except (OptionError, UserError):
        raise
    except Exception as error:  # YAML raises many kinds, and what it reads may be anything; it is not ours
        raise UserError(f"{path}: not a configuration of a run ({' '.join(str(error).split())})") from error


def change(config: Config, changes: Mapping[str, Any]) -> Config:
    """The configuration with new values, by dotted name.

    Raises:
      OptionError: an unknown name, another member of a group, a wrong type or a value out of range.
    """
    _check_choices(config.choices | _members(changes))
    others = [name for name in GROUPS if changes.get(name, config.choices[name]) != config.choices[name]]
    if others:
        raise OptionError([f"{name}={changes[name]}: the run has {name}={config.choices[name]}" for name in others])
    swept, plain = _divide(changes)
    problems, values = _unknown_names(plain, config.choices), config.to_dict()
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
