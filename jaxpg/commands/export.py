"""`python -m jaxpg.export run=DIR`: exports a trained policy as a controller for a robot."""

from __future__ import annotations

from collections.abc import Sequence

from jaxpg.commands.options import parse_run_options
from jaxpg.config.command_options import ExportOptions


def main(arguments: Sequence[str]) -> int:
    """The export command; returns its exit status."""
    options = parse_run_options("export", ExportOptions, arguments)
    if options is not None:
        from jaxpg.deploy import exporter

        exporter.export(options, print)
    return 0
