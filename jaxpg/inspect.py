"""`python -m jaxpg.inspect run=DIR`: what a run is, how far it is, and whether its checkpoints are sound."""

from __future__ import annotations

import json
from collections.abc import Sequence

from envs.options import build
from jaxpg.run import config, help
from jaxpg.run.errors import UserError, run_command
from jaxpg.run.schema import InspectOptions


def main(arguments: Sequence[str]) -> int:
    """The inspection command; returns its exit status."""
    if {"--help", "-h"} & set(arguments):
        print(help.run_help("inspect", InspectOptions))
        return 0
    from jaxpg.run import inspection

    options = build(InspectOptions, config.parse(arguments))
    if options.run is None:
        raise UserError("run=DIR is missing: the folder of the run to inspect")
    found = inspection.inspect(options.run)
    print(json.dumps(inspection.summary(found)) if options.json else inspection.described(found))
    return 0


if __name__ == "__main__":
    run_command(main)
