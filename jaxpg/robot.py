"""`python -m jaxpg.robot PATH`: what a robot is, whether it can be trained as it is, and what to change in it."""

from jaxpg.commands.ending import run_command
from jaxpg.commands.robot import main

__all__ = ["main"]

if __name__ == "__main__":
    run_command(main)
