"""Parses the arguments of the commands about a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from envs.options import build
from jaxpg.config import parsing
from jaxpg.config.help import format_command_help
from jaxpg.errors import UserError


def print_help_if_asked(command: str, what: str, schema: type, arguments: Sequence[str]) -> bool:
    """Prints the help if the arguments ask for it; returns whether they do.

    Args:
      command: such as `export`.
      what: its subject, such as `run=DIR`.
      schema: dataclass of its options.
      arguments: arguments of the command line.
    """
    is_asked = bool({"--help", "-h"} & set(arguments))
    if is_asked:
        print(format_command_help(command, what, schema))
    return is_asked


def parse_run_options(command: str, schema: type, arguments: Sequence[str]) -> Any:
    """The options of a command about a run; None if help was printed instead.

    Args:
      command, schema, arguments: as in `print_help_if_asked`; the option `run` is required.

    Raises:
      OptionError, UserError: mistakes in the arguments, or no run.
    """
    if print_help_if_asked(command, "run=DIR", schema, arguments):
        return None
    check_option_named("run", arguments)
    options = build(schema, parsing.parse(arguments))
    if options.run is None:
        raise UserError("run=DIR is missing: the folder of a run, such as runs/pendulum")
    return options


def parse_run_and_env_options(command: str, schema: type, arguments: Sequence[str]) -> tuple[Any, dict[str, Any]]:
    """As `parse_run_options`, and separately the changes to the run's environment, `env.NAME=VALUE`."""
    env_arguments = [argument for argument in arguments if argument.startswith("env.")]
    options = parse_run_options(command, schema, [argument for argument in arguments if argument not in env_arguments])
    return options, parsing.parse(env_arguments)


def check_option_named(option: str, arguments: Sequence[str]) -> None:
    """Raises UserError if a run folder is given without `option=`, which only the comparison allows."""
    for argument in arguments:
        if "=" not in argument and not argument.startswith("-") and ("/" in argument or Path(argument).is_dir()):
            raise UserError(f"'{argument}': expected {option}={argument}")
