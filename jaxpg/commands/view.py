"""`python -m jaxpg.view run=DIR`: a trained policy in MuJoCo's interactive viewer."""

from __future__ import annotations

from collections.abc import Sequence

from jaxpg.commands.options import parse_run_and_env_options
from jaxpg.config.command_options import ViewOptions


def main(arguments: Sequence[str]) -> int:
    """The view command; returns its exit status."""
    options, changes = parse_run_and_env_options("view", ViewOptions, arguments)
    if options is not None:
        from jaxpg.watch import live

        live.show(options, changes, print)
    return 0
