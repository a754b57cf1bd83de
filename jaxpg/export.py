"""`python -m jaxpg.export run=DIR`: the controller that a run has learned, for a robot."""

from jaxpg.commands.ending import run_command
from jaxpg.commands.export import main

__all__ = ["main"]

if __name__ == "__main__":
    run_command(main)
