"""Environments over MuJoCo MJX with brax's interface, made by name.

    env = envs.make("pendulum", mass=2.0)

A registry entry keeps what belongs to an environment together: its options, how it is built, and the training values
that were tuned on it. Importing this package loads neither mujoco nor brax; making an environment does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from envs import arm, brax_env, pendulum, playground_env, quadratic
from envs.options import OptionError, build, unknown


class Entry(NamedTuple):
    """One environment of the registry.

    Attributes:
      config: dataclass of its options; has `episode_length`.
      build: `build(config) -> env`.
      training: tuned training values by algorithm, under the training command's option names; the first algorithm is
        the environment's default. `network` among the values chooses the network, and options of another network than
        the chosen one do not count.
    """

    config: type
    build: Callable[[Any], Any]
    training: Mapping[str, Mapping[str, Any]]


REGISTRY: dict[str, Entry] = {
    "pendulum": Entry(pendulum.PendulumConfig, pendulum.Pendulum, pendulum.TRAINING),
    "arm": Entry(arm.ArmConfig, arm.Arm, arm.TRAINING),
    "quadratic": Entry(quadratic.QuadraticConfig, quadratic.make, quadratic.TRAINING),
    "brax": Entry(brax_env.BraxConfig, brax_env.make, brax_env.TRAINING),
    "playground": Entry(playground_env.PlaygroundConfig, playground_env.make, playground_env.TRAINING),
}


def register(name: str, entry: Entry) -> None:
    """Adds an environment of one's own: it can be made, trained and looked at as the others, by its name.

    Raises:
      ValueError: there is one of that name already.
    """
    if name in REGISTRY:
        raise ValueError(f"there is an environment called '{name}' already")
    REGISTRY[name] = entry


def make(name: str, /, **overrides: Any) -> Any:
    """The environment called `name`, with some of its options changed.

    Args:
      name: a key of `REGISTRY`.
      **overrides: options by name, see the environment's config class.

    Raises:
      OptionError: no such environment or option (with the nearest name), wrong type, or value out of range.

    >>> make("pendulum", length=0.5).observation_size
    3
    """
    entry = find(name)
    return entry.build(build(entry.config, overrides))


def find(name: str) -> Entry:
    """The registry entry called `name`; raises OptionError with the nearest name where there is none."""
    if name not in REGISTRY:
        raise OptionError([unknown("environment", name, REGISTRY)])
    return REGISTRY[name]
