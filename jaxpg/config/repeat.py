"""The command that makes a run once more, and what it says that the defaults do not."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Mapping
from typing import Any

from jaxpg.config import configuration, parsing, registered
from jaxpg.config.configuration import Config

NOT_REPEATED = ("run_dir",)  # its folder is not empty any more
NO_WORDS = ("null", "true", "false", "inf", "nan")  # but values
MOST = 5  # rounds until a command is complete: an option can change the default of another


def defaults(config: Config) -> dict[str, Any]:
    """The options of a run with the same members of the groups and nothing else given, by their names."""
    return configuration.named(_composed(dict(config.choices)))


def command(config: Config) -> str:
    """The command line that trains the same: the environment, and every option that is not its default then.

    Raises:
      RuntimeError: none was found, as when the defaults of the environment are others by now.
    """
    given = {"env": config.choices["env"]}
    for _ in range(MOST):
        missing = _differences(config, _composed(given))
        if not missing:
            return " ".join([_program(config), *(shlex.quote(argument(*option)) for option in given.items())])
        given |= missing
    raise RuntimeError(f"no command line for {given}")


def _differences(config: Config, other: Config) -> dict[str, Any]:
    """The options of `config` that `other` has not, groups before what is in them."""
    wanted, found = configuration.named(config), configuration.named(other)
    groups = {name: choice for name, choice in config.choices.items() if other.choices[name] != choice}
    return groups or {
        name: value
        for name, value in wanted.items()
        if name not in NOT_REPEATED and (name not in found or found[name] != value)
    }


def _composed(given: Mapping[str, Any]) -> Config:
    return parsing.compose([argument(name, value) for name, value in given.items()])


def _program(config: Config) -> str:
    """As anybody would type it: pages are sent to others, who have another interpreter."""
    program = registered.program_of(config.choices["env"]).get(registered.PROGRAM)
    if program is None:
        return "python -m jaxpg.train"
    return f"python {program if program.startswith('-m ') else shlex.quote(program)} train"


def argument(name: str, value: Any) -> str:
    """An option as it is given on the command line.

    >>> argument("network.widths", [64, 32]), argument("stop_return", None), argument("report", False)
    ('network.widths=[64,32]', 'stop_return=null', 'report=false')
    """
    return f"{name}={_text(value)}"


def _text(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return "[" + ",".join(map(_text, value)) + "]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return _quoted(value) if isinstance(value, str) else str(value)


def _quoted(word: str) -> str:
    """A word that the command line reads as itself, in quotes if it has to be."""
    plain = re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", word) and word.lower() not in NO_WORDS
    return word if plain else json.dumps(word, ensure_ascii=False)
