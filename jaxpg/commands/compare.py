"""`python -m jaxpg.compare runs/*`: compares several runs, as a page, a figure or a table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from envs.hints import python_command
from envs.options import build
from jaxpg.commands.options import print_help_if_asked
from jaxpg.config import parsing
from jaxpg.config.command_options import CompareOptions
from jaxpg.errors import UserError


def main(arguments: Sequence[str]) -> int:
    """The comparison command; returns its exit status."""
    if print_help_if_asked("compare", "DIR DIR ...", CompareOptions, arguments):
        return 0
    from jaxpg.watch import comparison

    folders = [argument for argument in arguments if "=" not in argument or Path(argument).is_dir()]
    options = build(CompareOptions, parsing.parse([argument for argument in arguments if argument not in folders]))
    if not folders:
        raise UserError(f"run folders are missing: {python_command()} -m jaxpg.compare runs/a runs/b")
    comparison.write(_select_runs(folders, print), Path(options.out), print)
    return 0


def _select_runs(paths: Sequence[str], say: Callable[[str], None]) -> list[str]:
    """The paths that are run folders, as a pattern such as `runs/*` may match others too.

    Raises:
      UserError: none of the paths is a run folder.
    """
    others = [path for path in paths if Path(path).exists() and not Path(path, "config.yaml").exists()]
    runs = [path for path in paths if path not in others]
    if not runs:
        raise UserError(f"{others[0]} is not a run folder: it has no config.yaml")
    if others:
        say(f"note: skipped, not a run folder: {', '.join(others)}")
    return runs
