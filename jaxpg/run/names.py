"""Names of an environment's own numbers: never two alike, and never one of ours."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

from envs.base import Interface

# What lines of metrics and evaluations call their own numbers, or may call them one day.
OURS = {"return", "reward", "value", "length", "diverged", "episodes", "time"}
OURS |= {"update", "updates", "step", "steps", "seconds", "skipped", "mean", "stderr", "best"}
OWN = "env_"  # begins the names of an environment's metrics that could be taken for ours
LONGEST = 100  # letters of a metric's name: services refuse longer ones
SHOWN_BESIDE_COMMANDS = ("reward", "value")


def distinct(names: Iterable[str], taken: Iterable[str] = (), form: str = "{} ({})") -> list[str]:
    """The names, each that is there already with a number after it.

    Args:
      names: in order.
      taken: by others.
      form: of a name and its number, from 2.

    >>> distinct(["torque", "value", "torque"], taken=["reward", "value"])
    ['torque', 'value (2)', 'torque (2)']
    """
    used, found = set(taken), []
    for name in names:
        new, number = name, 2
        while new in used:
            new, number = form.format(name, number), number + 1
        used.add(new)
        found.append(new)
    return found


def own_metrics(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """An environment's metrics by the names that they have among ours: in lines of metrics, behind `eval_`.

    Most keep their name. One that we use ourselves has `env_` before it, and so has one that begins with that; letters
    that TensorBoard, W&B or MLflow refuse become `_`, and of names that are the same then, the later ones get a number.

    >>> own_metrics({"success": 1, "return": 2, "env_return": 3, "a b%": 4, "a b&": 5})
    {'success': 1, 'env_return': 2, 'env_env_return': 3, 'a b_': 4, 'a b__2': 5}
    """
    names = [_apart(_plain(str(name))) for name in metrics]
    return dict(zip(distinct(names, form="{}_{}"), metrics.values(), strict=True))


def own_interface(interface: Interface) -> Interface:
    """The interface with names that tell its numbers apart, from each other and from what is shown beside commands."""

    def named(names, kind, taken=()):
        return tuple(distinct((str(name) or f"{kind}_{i}" for i, name in enumerate(names)), taken))

    observations = named(interface.observations, "observation")
    commands = named(interface.commands, "action", SHOWN_BESIDE_COMMANDS)
    return interface._replace(observations=observations, commands=commands)


def _apart(name: str) -> str:
    return OWN + name if name in OURS or name.startswith(OWN) else name


def _plain(name: str) -> str:
    """Letters, digits, `_`, `.`, `-`, spaces within, and slashes between parts that are no places of a file system."""
    parts = re.sub(r"[^\w./ -]", "_", name[:LONGEST]).split("/")
    return "/".join(part.strip() if part.strip(" .") else "_" for part in parts)
