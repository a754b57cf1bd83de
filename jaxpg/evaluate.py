"""`python -m jaxpg.evaluate run=DIR`: plays a trained policy, deterministically, from fixed starts."""

from jaxpg.commands.ending import run_command
from jaxpg.commands.evaluate import main

__all__ = ["main"]

if __name__ == "__main__":
    run_command(main)
