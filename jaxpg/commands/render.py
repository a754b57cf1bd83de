"""`python -m jaxpg.render run=DIR`: renders episodes of a trained policy as a video."""

from __future__ import annotations

from collections.abc import Sequence

from jaxpg.commands.options import parse_run_and_env_options
from jaxpg.config.command_options import RenderOptions


def main(arguments: Sequence[str]) -> int:
    """The render command; returns its exit status."""
    options, changes = parse_run_and_env_options("render", RenderOptions, arguments)
    if options is not None:
        from jaxpg.watch import video

        video.render(options, changes, print)
    return 0
