"""What a training run is told: typed options in groups, composed by Hydra, checked here.

The command line is Hydra's: `env=arm algo=td algo.lambda_=0.9 seed=3`. Hydra composes the groups and reads the values;
names, types and ranges come from dataclasses of `envs.options.option` fields, so that every mistake is reported at once
and in the user's words. Values that nobody gave come from the environment's registry entry, which keeps what was tuned
on it, and else from the dataclasses.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import envs
from envs.options import OptionError, build, unknown
from jaxpg.run.errors import UserError
from jaxpg.run.schema import GROUPS, Run

DEFAULT_CHOICES = {"env": "pendulum", "algo": "td", "network": "mlp"}
FOLDERS = ("run_dir", "resume", "run")  # options whose value is a path
DEFAULT_ROLLOUT = 16  # steps of a TD rollout where neither the user nor the environment says


@dataclass(frozen=True)
class Config:
    """A checked configuration: which member of each group, its options, and the run's.

    Attributes:
      choices: group -> member, such as `{"env": "pendulum", "algo": "td", "network": "mlp"}`.
      env, algo, network: the members' options, dataclasses of `GROUPS`.
      run: the run's own options.
    """

    choices: Mapping[str, str]
    env: Any
    algo: Any
    network: Any
    run: Run

    def to_dict(self) -> dict[str, Any]:
        """Plain nested values, as written to `config.yaml`; `from_dict` is its inverse."""
        groups = {
            group: {"id": choice, **dataclasses.asdict(getattr(self, group))} for group, choice in self.choices.items()
        }
        return groups | dataclasses.asdict(self.run)


def from_dict(values: Mapping[str, Any]) -> Config:
    """The configuration in plain nested values, once everything in it has been checked.

    Raises:
      OptionError: lists every unknown name, wrong type and value out of range.
    """
    choices = {group: values[group]["id"] for group in GROUPS}
    problems, parts = [], {}
    rest = {name: value for name, value in values.items() if name not in GROUPS}
    sections = [(group, GROUPS[group][choices[group]], dict(values[group])) for group in GROUPS] + [("", Run, rest)]
    for name, schema, options in sections:
        options.pop("id", None)
        try:
            parts[name or "run"] = build(schema, options, prefix=f"{name}." if name else "")
        except OptionError as error:
            problems += error.problems
    if problems:
        raise OptionError(problems)
    return _complete(Config(choices, **parts))


def _complete(config: Config) -> Config:
    """The rollout length filled in, which depends on algorithm and environment."""
    given, horizon = config.run.num_steps, config.env.episode_length
    if config.choices["algo"] == "reinforce":
        if given not in (None, horizon):
            raise OptionError(
                [f"num_steps={given}: algo=reinforce plays whole episodes, {horizon} steps here; leave it out"]
            )
        given = horizon
        if config.algo.baseline == "leave_one_out" and config.run.num_envs < 2:
            raise OptionError(["algo.baseline=leave_one_out needs other episodes: num_envs must be at least 2"])
        if config.algo.discounted and config.algo.returns == "whole":
            raise OptionError(["algo.discounted=true: whole returns have the factors gamma^t in them; leave it out"])
    if config.choices["algo"] == "ppo" and config.run.num_envs % config.algo.minibatches:
        divisors = [n for n in range(1, config.run.num_envs + 1) if config.run.num_envs % n == 0]
        nearest = min(divisors, key=lambda n: abs(n - config.algo.minibatches))
        raise OptionError(
            [
                f"algo.minibatches={config.algo.minibatches} does not divide num_envs={config.run.num_envs}: "
                f"the nearest that does is {nearest}"
            ]
        )
    if config.choices["algo"] == "online" and config.network.sigma_is == "scheduled":
        raise OptionError(
            ["network.sigma_is=scheduled: algo=online has no schedules; fixed, learned and state are left"]
        )
    if config.choices["network"] == "linear" and config.network.features == "radial" and config.network.order < 2:
        raise OptionError([f"network.order={config.network.order}: radial features need at least 2 points of an axis"])
    if config.run.num_seeds + config.run.seed > 2**32:
        raise OptionError([f"seed={config.run.seed} num_seeds={config.run.num_seeds}: seeds must stay below 2**32"])
    return dataclasses.replace(config, run=dataclasses.replace(config.run, num_steps=given or DEFAULT_ROLLOUT))


def compose(arguments: Sequence[str]) -> Config:
    """The configuration that a command line asks for.

    Args:
      arguments: Hydra overrides, `name=value`.

    Raises:
      OptionError, UserError: every unknown name, wrong type and value out of range; or text that is no override.
    """
    given = parse(arguments)
    tuned = _tuned(DEFAULT_CHOICES | _members(given))
    choices = DEFAULT_CHOICES | _members(tuned) | _members(given)
    _check_names(given, choices)
    fields = option_fields(choices)
    values = {name: value for name, value in (tuned | given).items() if name in fields}
    return from_dict(_hydra_compose(choices, values))


def _members(values: Mapping[str, Any]) -> dict[str, Any]:
    """Those of the values that choose a member of a group."""
    return {name: value for name, value in values.items() if name in GROUPS}


def _tuned(choices: Mapping[str, Any]) -> Mapping[str, Any]:
    """What the environment's registry entry says for the algorithm; nothing where there is no such environment."""
    entry = envs.REGISTRY.get(choices["env"])
    return entry.training.get(choices["algo"], {}) if entry else {}


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
    return value if isinstance(value, (bool, int, float)) or value is None else str(getattr(value, "text", value))


def _check_names(given: Mapping[str, Any], choices: Mapping[str, Any]) -> None:
    problems = [
        unknown(group, str(choices[group]), members)
        for group, members in GROUPS.items()
        if choices[group] not in members
    ]
    if problems:
        raise OptionError(problems)
    known = set(option_fields(choices)) | set(GROUPS)
    leaves = {name.rsplit(".", 1)[-1]: name for name in known}
    for name in given:
        if name not in known:
            same_leaf = leaves.get(name.rsplit(".", 1)[-1])
            problems.append(
                f"unknown option '{name}': did you mean '{same_leaf}'?" if same_leaf else unknown("option", name, known)
            )
    if problems:
        raise OptionError(problems)


def option_fields(choices: Mapping[str, str]) -> dict[str, dataclasses.Field]:
    """Every option under these choices, by its name on the command line."""
    fields = {field.name: field for field in dataclasses.fields(Run)}
    for group, choice in choices.items():
        fields |= {f"{group}.{field.name}": field for field in dataclasses.fields(GROUPS[group][choice])}
    return fields


def _hydra_compose(choices: Mapping[str, str], values: Mapping[str, Any]) -> dict[str, Any]:
    """Hydra's composition of the groups' defaults and of `values`, as plain nested values."""
    import hydra
    from hydra.core.config_store import ConfigStore
    from omegaconf import OmegaConf

    store = ConfigStore.instance()
    for group, members in GROUPS.items():
        for name, schema in members.items():
            store.store(name=name, group=group, node={"id": name, **dataclasses.asdict(schema())})
    defaults = [{group: choice} for group, choice in DEFAULT_CHOICES.items()]
    store.store(name="config", node={"defaults": [*defaults, "_self_"], **dataclasses.asdict(Run())})
    with hydra.initialize(version_base=None, config_path=None):
        composed = hydra.compose("config", [f"{group}={choice}" for group, choice in choices.items()])
    for name, value in values.items():
        OmegaConf.update(composed, name, value)
    return OmegaConf.to_container(composed, resolve=True)


def save(config: Config, path: Path) -> None:
    """Writes `config.yaml`."""
    from omegaconf import OmegaConf

    path.write_text(OmegaConf.to_yaml(OmegaConf.create(config.to_dict())), encoding="utf-8")


def load(path: Path) -> Config:
    """The configuration in a `config.yaml`.

    Raises:
      UserError: the file cannot be read; OptionError: a name, type or range in it is wrong.
    """
    from omegaconf import OmegaConf

    try:
        return from_dict(OmegaConf.to_container(OmegaConf.load(path)))
    except OptionError:
        raise
    except Exception as error:  # YAML and OmegaConf raise many kinds; whichever it is, the file is not ours
        raise UserError(f"{path}: not a configuration of a run ({' '.join(str(error).split())})") from error


def change(config: Config, changes: Mapping[str, Any]) -> Config:
    """The configuration with new values, by dotted name.

    Raises:
      OptionError: an unknown name, another member of a group, a wrong type or a value out of range.
    """
    _check_names(changes, config.choices | _members(changes))
    others = [name for name in GROUPS if changes.get(name, config.choices[name]) != config.choices[name]]
    if others:
        raise OptionError([f"{name}={changes[name]}: the run has {name}={config.choices[name]}" for name in others])
    values = config.to_dict()
    for name, value in changes.items():
        group, _, leaf = name.rpartition(".")
        if name not in GROUPS:
            (values[group] if group else values)[leaf] = value
    return from_dict(values)


def flatten(config: Config) -> dict[str, Any]:
    """The values of all options by their names on the command line."""
    values = config.to_dict()
    return {
        name: values[group][leaf] if group else values[leaf]
        for name in option_fields(config.choices)
        for group, _, leaf in [name.rpartition(".")]
    }
