"""`python -m jaxpg.report run=DIR`: writes the page of a run again, as training does at its end."""

from __future__ import annotations

from collections.abc import Sequence

from jaxpg.commands.options import parse_run_options
from jaxpg.config.command_options import ReportOptions


def main(arguments: Sequence[str]) -> int:
    """The report command; returns its exit status."""
    options = parse_run_options("report", ReportOptions, arguments)
    if options is not None:
        from jaxpg.watch import run_page

        run_page.write_report(options.run, options.agent, options.cache, print)
    return 0
