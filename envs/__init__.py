"""Environments over MuJoCo with brax's interface, made by name.

    env = envs.make("pendulum", mass=2.0)

A registry entry holds everything about an environment: its options, how to build it, and the training values tuned on
it. Importing this package loads neither mujoco nor brax; making an environment does.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from envs import arm, brax_env, drive, pendulum, playground_env, push, quadratic, reach, walk
from envs.base import Env
from envs.contract import conform
from envs.options import OptionError, build, describe_unknown, find_declaration_problems
from envs.user_code import catch_user_errors


class Entry(NamedTuple):
    """One environment of the registry.

    Attributes:
      config: dataclass of its options, with `episode_length`.
      build: `build(config) -> env`.
      training: tuned training values by algorithm, under the training command's option names; the first algorithm is
        the environment's default. `network` among the values chooses the network, and options of other networks are
        ignored. Other algorithms train with the training command's defaults.
    """

    config: type
    build: Callable[[Any], Env]
    training: Mapping[str, Mapping[str, Any]] = MappingProxyType({})


RESERVED = "id"  # in a run's config.yaml, the name of the environment among its options
REGISTRY: dict[str, Entry] = {
    "pendulum": Entry(pendulum.PendulumConfig, pendulum.Pendulum, pendulum.TRAINING),
    "arm": Entry(arm.ArmConfig, arm.Arm, arm.TRAINING),
    "reach": Entry(reach.ReachConfig, reach.Reach, reach.TRAINING),
    "drive": Entry(drive.DriveConfig, drive.Drive, drive.TRAINING),
    "walk": Entry(walk.WalkConfig, walk.Walk, walk.TRAINING),
    "push": Entry(push.PushConfig, push.Push, push.TRAINING),
    "quadratic": Entry(quadratic.QuadraticConfig, quadratic.make, quadratic.TRAINING),
    "brax": Entry(brax_env.BraxConfig, brax_env.make, brax_env.TRAINING),
    "playground": Entry(playground_env.PlaygroundConfig, playground_env.make, playground_env.TRAINING),
}
SHIPPED = tuple(REGISTRY)


def register(name: str, entry: Entry) -> None:
    """Adds your own environment: it can be made, trained and rendered by its name, like the others.

    Mistakes in its options or training values are reported when it is used.

    Raises:
      ValueError: the name is taken, or is not a non-empty line of text.
    """
    if not (isinstance(name, str) and name.strip() and name.isprintable()):
        raise ValueError(f"an environment cannot be called {name!r}: expected one line of text")
    if name in REGISTRY:
        raise ValueError(f"there is an environment called '{name}' already")
    REGISTRY[name] = entry


def make(name: str, /, **overrides: Any) -> Env:
    """The environment called `name`, with some of its options changed.

    Args:
      name: a key of `REGISTRY`.
      **overrides: options by name, see the environment's config class.

    Raises:
      OptionError: there is no such environment or option (with the nearest name), a type is wrong, a value is out of
        range, or the environment violates its contract (`envs.contract`).

    >>> make("pendulum", length=0.5).observation_size
    3
    """
    return make_from_config(name, build(find(name).config, overrides))


def make_from_config(name: str, config: Any) -> Env:
    """The environment called `name` with these options; raises OptionError as `make` does.

    A user's environment is checked first. Those of brax and Playground are not, as they are slow to trace.
    """
    entry = find(name)
    if name in SHIPPED:
        return entry.build(config)
    with catch_user_errors(name, "its build", entry.build):
        env = entry.build(config)
    return conform(env, name)


def find(name: str) -> Entry:
    """The registry entry called `name`.

    Raises:
      OptionError: there is none (with the nearest name), or its options are not valid.
    """
    if name not in REGISTRY:
        raise OptionError([describe_unknown("environment", name, REGISTRY)])
    entry = REGISTRY[name]
    problems = [f"env={name}: {problem}" for problem in _find_option_problems(entry.config)]
    if problems:
        raise OptionError(problems)
    return entry


def _find_option_problems(config: Any) -> Iterator[str]:
    problems = list(find_declaration_problems(config))
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
