"""`python -m jaxpg.render run=DIR`: episodes of a trained policy as a video."""

from __future__ import annotations

from collections.abc import Sequence

from jaxpg.run import config
from jaxpg.run.commands import about_a_run
from jaxpg.run.errors import run_command
from jaxpg.run.schema import RenderOptions


def main(arguments: Sequence[str]) -> int:
    """The render command; returns its exit status."""
    of_env = [argument for argument in arguments if argument.startswith("env.")]
    options = about_a_run("render", RenderOptions, [argument for argument in arguments if argument not in of_env])
    if options is not None:
        from jaxpg.watch import video

        video.render(options, config.parse(of_env), print)
    return 0


if __name__ == "__main__":
    run_command(main)
