"""`python -m jaxpg.export run=DIR`: the controller that a run has learned, for a robot."""

from __future__ import annotations

from collections.abc import Sequence

from jaxpg.commands.options import about_a_run
from jaxpg.config.schema import ExportOptions


def main(arguments: Sequence[str]) -> int:
    """The export command; returns its exit status."""
    options = about_a_run("export", ExportOptions, arguments)
    if options is not None:
        from jaxpg.deploy import exporter

        exporter.export(options, print)
    return 0
