"""`python -m jaxpg.train`: trains an agent and leaves a run folder behind; `--help` lists every option."""

from jaxpg.commands.ending import run_command
from jaxpg.commands.train import main

__all__ = ["main"]

if __name__ == "__main__":
    run_command(main)
