"""`python -m jaxpg.inspect run=DIR`: describes a run, its progress and the state of its checkpoints."""

from __future__ import annotations

import json
from collections.abc import Sequence

from jaxpg.commands.options import parse_run_options
from jaxpg.config.command_options import InspectOptions


def main(arguments: Sequence[str]) -> int:
    """The inspection command; returns its exit status."""
    options = parse_run_options("inspect", InspectOptions, arguments)
    if options is not None:
        from jaxpg.watch import inspection

        result = inspection.inspect(options.run)
        print(json.dumps(inspection.summarize(result)) if options.json else inspection.describe(result))
    return 0
