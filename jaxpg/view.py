"""`python -m jaxpg.view run=DIR`: a trained policy in MuJoCo's interactive viewer."""

from jaxpg.commands.ending import run_command
from jaxpg.commands.view import main

__all__ = ["main"]

if __name__ == "__main__":
    run_command(main)
