"""Names of an environment's own numbers: never two alike, and never one of ours."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from typing import Any

from envs.base import Interface

# What lines of metrics and evaluations call their own numbers, or may call them one day.
OURS = {"return", "reward", "value", "length", "diverged", "episodes", "time"}
OURS |= {"update", "updates", "step", "steps", "seconds", "skipped", "mean", "stderr", "best"}
OWN = "env_"  # begins the names of an environment's metrics that could be taken for ours
LONGEST = 100  # letters of a metric's name: services refuse longer ones
SHOWN_BESIDE_COMMANDS = ("reward", "value")


def numbered(names: Sequence[str], taken: Sequence[str] = ()) -> list[str]:
    """Names that tell things apart: one that is there twice, or taken, has its place after it; all, if need be.

    >>> numbered(["torque", "value", "torque"], taken=["reward", "value"])
    ['torque (1)', 'value (2)', 'torque (3)']
    >>> numbered(["a", "a", "a (1)"])
    ['a (1)', 'a (2)', 'a (1) (3)']
    """
    places = [f"{name} ({i})" for i, name in enumerate(names, start=1)]
    found = [
        place if names.count(name) > 1 or name in taken else name for name, place in zip(names, places, strict=True)
    ]
    return found if len({*found, *taken}) == len(found) + len(taken) else places


def own_metrics(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """An environment's metrics by the names that they have among ours: in lines of metrics, behind `eval_`.

    Most keep their name. One that we use ourselves has `env_` before it, and so has one that begins with that; letters
    that TensorBoard, W&B or MLflow refuse become `_`, and of names that are the same then, the later ones get a number.

    >>> own_metrics({"success": 1, "return": 2, "env_return": 3, "a b%": 4, "a b&": 5})
    {'success': 1, 'env_return': 2, 'env_env_return': 3, 'a b_': 4, 'a b__2': 5}
    """
    found: dict[str, Any] = {}
    for name, value in metrics.items():
        own = _apart(_plain(str(name)))
        others = (f"{own}_{number}" for number in itertools.count(2))
        found[next(new for new in itertools.chain([own], others) if new not in found)] = value
    return found


def own_interface(interface: Interface) -> Interface:
    """The interface with names that tell its numbers apart, from each other and from what is shown beside commands."""

    def named(names, kind, taken=()):
        return tuple(numbered([str(name) or f"{kind}_{i}" for i, name in enumerate(names)], taken))

    observations = named(interface.observations, "observation")
    commands = named(interface.commands, "action", SHOWN_BESIDE_COMMANDS)
    return interface._replace(observations=observations, commands=commands)


def _apart(name: str) -> str:
    return OWN + name if name in OURS or name.startswith(OWN) else name


def _plain(name: str) -> str:
    """Letters, digits, `_`, `.`, `-`, spaces within, and slashes between parts that are no places of a file system."""
    parts = re.sub(r"[^\w./ -]", "_", name[:LONGEST]).split("/")
    return "/".join(part.strip() if part.strip(" .") else "_" for part in parts)
