"""`python -m jaxpg.inspect run=DIR`: what a run is, how far it is, and whether its checkpoints are sound."""

from __future__ import annotations

import json
from collections.abc import Sequence

from jaxpg.commands.options import about_a_run
from jaxpg.config.command_options import InspectOptions


def main(arguments: Sequence[str]) -> int:
    """The inspection command; returns its exit status."""
    options = about_a_run("inspect", InspectOptions, arguments)
    if options is not None:
        from jaxpg.watch import inspection

        found = inspection.inspect(options.run)
        print(json.dumps(inspection.summary(found)) if options.json else inspection.described(found))
    return 0
