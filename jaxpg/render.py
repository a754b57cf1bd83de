"""`python -m jaxpg.render run=DIR`: episodes of a trained policy as a video."""

from jaxpg.commands.ending import run_command
from jaxpg.commands.render import main

__all__ = ["main"]

if __name__ == "__main__":
    run_command(main)
