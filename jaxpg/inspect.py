"""`python -m jaxpg.inspect run=DIR`: what a run is, how far it is, and whether its checkpoints are sound."""

from jaxpg.commands.ending import run_command
from jaxpg.commands.inspect import main

__all__ = ["main"]

if __name__ == "__main__":
    run_command(main)
