"""`python -m jaxpg.report run=DIR`: the page of a run, which training writes at its end, written anew."""

from __future__ import annotations

from collections.abc import Sequence

from jaxpg.commands.options import about_a_run
from jaxpg.config.command_options import ReportOptions


def main(arguments: Sequence[str]) -> int:
    """The report command; returns its exit status."""
    options = about_a_run("report", ReportOptions, arguments)
    if options is not None:
        from jaxpg.watch import report

        report.of_run(options.run, options.agent, options.cache, print)
    return 0
