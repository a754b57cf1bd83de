"""Environments over MuJoCo MJX with brax's interface, made by name.

    env = envs.make("pendulum", mass=2.0)

A registry entry keeps what belongs to an environment together: its options, how it is built, and the training values
that were tuned on it. Importing this package loads neither mujoco nor brax; making an environment does.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from envs import arm, brax_env, pendulum, playground_env, quadratic
from envs.contract import conform
from envs.options import OptionError, build, declaration_problems, unknown
from envs.user_code import user_code


class Entry(NamedTuple):
    """One environment of the registry.

    Attributes:
      config: dataclass of its options; has `episode_length`.
      build: `build(config) -> env`.
      training: tuned training values by algorithm, under the training command's option names; the first algorithm is
        the environment's default. `network` among the values chooses the network, and options of another network than
        the chosen one do not count. An algorithm that is not there trains with the training command's defaults.
    """

    config: type
    build: Callable[[Any], Any]
    training: Mapping[str, Mapping[str, Any]] = MappingProxyType({})


RESERVED = "id"  # under which a run's config.yaml names the environment, beside its options
REGISTRY: dict[str, Entry] = {
    "pendulum": Entry(pendulum.PendulumConfig, pendulum.Pendulum, pendulum.TRAINING),
    "arm": Entry(arm.ArmConfig, arm.Arm, arm.TRAINING),
    "quadratic": Entry(quadratic.QuadraticConfig, quadratic.make, quadratic.TRAINING),
    "brax": Entry(brax_env.BraxConfig, brax_env.make, brax_env.TRAINING),
    "playground": Entry(playground_env.PlaygroundConfig, playground_env.make, playground_env.TRAINING),
}
SHIPPED = tuple(REGISTRY)


def register(name: str, entry: Entry) -> None:
    """Adds an environment of one's own: it can be made, trained and looked at as the others, by its name.

    What is wrong with its options or its training values is said when it is asked for.

    Raises:
      ValueError: there is one of that name already, or the name is not a text with something in it.
    """
    if not (isinstance(name, str) and name.strip() and name.isprintable()):
        raise ValueError(f"an environment cannot be called {name!r}: expected a text of one line")
    if name in REGISTRY:
        raise ValueError(f"there is an environment called '{name}' already")
    REGISTRY[name] = entry


def make(name: str, /, **overrides: Any) -> Any:
    """The environment called `name`, with some of its options changed.

    Args:
      name: a key of `REGISTRY`.
      **overrides: options by name, see the environment's config class.

    Raises:
      OptionError: no such environment or option (with the nearest name), wrong type, or value out of range; or the
        environment does not give what it must (`envs.contract`).

    >>> make("pendulum", length=0.5).observation_size
    3
    """
    return of_config(name, build(find(name).config, overrides))


def of_config(name: str, config: Any) -> Any:
    """The environment called `name` with these options; raises OptionError as `make` does.

    One of somebody's own is looked at before it is handed out. brax's and Playground's are known, and slow to trace.
    """
    entry = find(name)
    if name in SHIPPED:
        return entry.build(config)
    with user_code(name, "its build", entry.build):
        env = entry.build(config)
    return conform(env, name)


def find(name: str) -> Entry:
    """The registry entry called `name`.

    Raises:
      OptionError: there is none, with the nearest name; or its options are none that can be given.
    """
    if name not in REGISTRY:
        raise OptionError([unknown("environment", name, REGISTRY)])
    entry = REGISTRY[name]
    problems = [f"env={name}: {problem}" for problem in _problems_of_options(entry.config)]
    if problems:
        raise OptionError(problems)
    return entry


def _problems_of_options(config: Any) -> Iterator[str]:
    problems = list(declaration_problems(config))
    yield from problems
    if problems:
        return
    names = [field.name for field in dataclasses.fields(config)]
    if RESERVED in names:
        yield f"an option cannot be called '{RESERVED}', which stands for the environment's name in config.yaml"
    if "episode_length" not in names:
        yield "it needs an option episode_length: int = option(200, 'steps until the time limit', at_least=1)"
    elif typing.get_type_hints(config)["episode_length"] is not int:
        yield "its option episode_length must be an int"
