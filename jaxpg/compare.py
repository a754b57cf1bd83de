"""`python -m jaxpg.compare runs/*`: several runs side by side, as a page, a figure or a table."""

from jaxpg.commands.compare import main
from jaxpg.commands.ending import run_command

__all__ = ["main"]

if __name__ == "__main__":
    run_command(main)
