"""The command that repeats a run, with every option that differs from its default."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Mapping
from typing import Any

from jaxpg.config import configuration, parsing, registered
from jaxpg.config.configuration import Config

NOT_REPEATED = ("run_dir",)  # the folder exists by now
YAML_VALUES = ("null", "true", "false", "inf", "nan")  # words that must be quoted as text
MAX_ROUNDS = 5  # in which a command is completed, as an option can change the default of another


def compose_defaults(config: Config) -> dict[str, Any]:
    """The default values of all options under the same choices, by name."""
    return configuration.to_arguments(_compose(dict(config.choices)))


def format_command(config: Config) -> str:
    """The command line that repeats the training: the environment, and every option that differs from its default.

    Raises:
      RuntimeError: no command line was found, as when the environment's defaults have changed.
    """
    given = {"env": config.choices["env"]}
    for _ in range(MAX_ROUNDS):
        missing = _find_differences(config, _compose(given))
        if not missing:
            arguments = (shlex.quote(format_argument(name, value)) for name, value in given.items())
            return " ".join([_format_program(config), *arguments])
        given |= missing
    raise RuntimeError(f"no command line for {given}")


def _find_differences(config: Config, other: Config) -> dict[str, Any]:
    """The values of `config` that differ in `other`; choices of groups before their options."""
    values, others = configuration.to_arguments(config), configuration.to_arguments(other)
    groups = {name: choice for name, choice in config.choices.items() if other.choices[name] != choice}
    return groups or {
        name: value
        for name, value in values.items()
        if name not in NOT_REPEATED and (name not in others or others[name] != value)
    }


def _compose(given: Mapping[str, Any]) -> Config:
    return parsing.compose([format_argument(name, value) for name, value in given.items()])


def _format_program(config: Config) -> str:
    """The start of the command, without this machine's interpreter, as pages are sent to others."""
    program = registered.find_program(config.choices["env"]).get(registered.PROGRAM)
    if program is None:
        return "python -m jaxpg.train"
    return f"python {program if program.startswith('-m ') else shlex.quote(program)} train"


def format_argument(name: str, value: Any) -> str:
    """An option as on the command line.

    >>> format_argument("network.widths", [64, 32]), format_argument("stop_return", None)
    ('network.widths=[64,32]', 'stop_return=null')
    """
    return f"{name}={_format_value(value)}"


def _format_value(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return "[" + ",".join(map(_format_value, value)) + "]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return _quote(value) if isinstance(value, str) else str(value)


def _quote(word: str) -> str:
    """The word, in quotes if the command line would not read it as itself."""
    plain = re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", word) and word.lower() not in YAML_VALUES
    return word if plain else json.dumps(word, ensure_ascii=False)
