"""`python -m jaxpg.report run=DIR`: the page of a run, which training writes at its end, written anew."""

from jaxpg.commands.ending import run_command
from jaxpg.commands.report import main

__all__ = ["main"]

if __name__ == "__main__":
    run_command(main)
