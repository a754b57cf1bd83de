"""Makes the names of an environment's numbers unique, and different from ours."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from typing import Any

from envs.base import Interface

# Names that metrics and evaluations use for their own numbers, or may use one day.
RESERVED = {"return", "reward", "value", "length", "diverged", "episodes", "time"}
RESERVED |= {"update", "updates", "step", "steps", "seconds", "skipped", "mean", "stderr", "best"}
PREFIX = "env_"  # of environment metrics that could be mistaken for ours
MAX_LENGTH = 100  # characters of a metric's name: services refuse longer ones
STEP_SERIES = ("reward", "value")  # shown together with the commands


def number_duplicates(names: Sequence[str], taken: Sequence[str] = ()) -> list[str]:
    """Unique names: those that occur twice or are taken get their position appended; if necessary, all do.

    >>> number_duplicates(["torque", "value", "torque"], taken=["reward", "value"])
    ['torque (1)', 'value (2)', 'torque (3)']
    >>> number_duplicates(["a", "a", "a (1)"])
    ['a (1)', 'a (2)', 'a (1) (3)']
    """
    places = [f"{name} ({i})" for i, name in enumerate(names, start=1)]
    unique = [
        place if names.count(name) > 1 or name in taken else name for name, place in zip(names, places, strict=True)
    ]
    return unique if len({*unique, *taken}) == len(unique) + len(taken) else places


def rename_metrics(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """An environment's metrics by the names under which they are logged, after `eval_`.

    Most keep their name. Names that we use ourselves, or that begin with `env_`, get the prefix `env_`. Characters that
    TensorBoard, W&B or MLflow refuse become `_`; if that makes names equal, the later ones get a number.

    >>> rename_metrics({"success": 1, "return": 2, "env_return": 3, "a b%": 4, "a b&": 5})
    {'success': 1, 'env_return': 2, 'env_env_return': 3, 'a b_': 4, 'a b__2': 5}
    """
    renamed: dict[str, Any] = {}
    for name, value in metrics.items():
        plain = _add_prefix(_replace_symbols(str(name)))
        others = (f"{plain}_{number}" for number in itertools.count(2))
        renamed[next(new for new in itertools.chain([plain], others) if new not in renamed)] = value
    return renamed


def rename_interface(interface: Interface) -> Interface:
    """The interface with unique names, also different from those of `STEP_SERIES`."""

    def tell_apart(names, kind, taken=()):
        return tuple(number_duplicates([str(name) or f"{kind}_{i}" for i, name in enumerate(names)], taken))

    observations = tell_apart(interface.observations, "observation")
    commands = tell_apart(interface.commands, "action", STEP_SERIES)
    return interface._replace(observations=observations, commands=commands)


def _add_prefix(name: str) -> str:
    return PREFIX + name if name in RESERVED or name.startswith(PREFIX) else name


def _replace_symbols(name: str) -> str:
    """Keeps letters, digits, `_`, `.`, `-`, inner spaces, and slashes between parts other than `.` and `..`."""
    parts = re.sub(r"[^\w./ -]", "_", name[:MAX_LENGTH]).split("/")
    return "/".join(part.strip() if part.strip(" .") else "_" for part in parts)
