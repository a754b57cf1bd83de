"""`python -m jaxpg.export run=DIR`: the controller that a run has learned, for a robot."""

from __future__ import annotations

from collections.abc import Sequence

from envs.options import build
from jaxpg.run import config, help
from jaxpg.run.errors import UserError, run_command
from jaxpg.run.schema import ExportOptions


def main(arguments: Sequence[str]) -> int:
    """The export command; returns its exit status."""
    if {"--help", "-h"} & set(arguments):
        print(help.run_help("export", ExportOptions))
        return 0
    from jaxpg.deploy import export

    options = build(ExportOptions, config.parse(arguments))
    if options.run is None:
        raise UserError("run=DIR is missing: the folder of the run whose policy is exported")
    export.export(options, print)
    return 0


if __name__ == "__main__":
    run_command(main)
