"""What the commands about finished and unfinished runs have in common."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from envs.options import build
from jaxpg.config import parsing
from jaxpg.config.help import command_help
from jaxpg.errors import UserError


def asks_for_help(command: str, what: str, schema: type, arguments: Sequence[str]) -> bool:
    """Whether help is asked for, which then is printed.

    Args:
      command: such as `export`.
      what: it is about, such as `run=DIR`.
      schema: of its options.
      arguments: of the command line.
    """
    asked = bool({"--help", "-h"} & set(arguments))
    if asked:
        print(command_help(command, what, schema))
    return asked


def about_a_run(command: str, schema: type, arguments: Sequence[str]) -> Any:
    """The options of a command about a run; None where help was asked for.

    Args:
      command, schema, arguments: as above; the options have a `run`, which must be given.

    Raises:
      OptionError, UserError: mistakes in the arguments, or no run.
    """
    if asks_for_help(command, "run=DIR", schema, arguments):
        return None
    check_named("run", arguments)
    options = build(schema, parsing.parse(arguments))
    if options.run is None:
        raise UserError("run=DIR is missing: the folder of a run, such as runs/pendulum")
    return options


def about_a_run_in(command: str, schema: type, arguments: Sequence[str]) -> tuple[Any, dict[str, Any]]:
    """As `about_a_run`, with the changes to the run's environment, `env.NAME=VALUE`, apart."""
    of_env = [argument for argument in arguments if argument.startswith("env.")]
    options = about_a_run(command, schema, [argument for argument in arguments if argument not in of_env])
    return options, parsing.parse(of_env)


def check_named(option: str, arguments: Sequence[str]) -> None:
    """Raises UserError where a run's folder is given without its option's name, as only the comparison takes them."""
    for argument in arguments:
        if "=" not in argument and not argument.startswith("-") and ("/" in argument or Path(argument).is_dir()):
            raise UserError(f"'{argument}': expected {option}={argument}")
