"""Prints what the commands say to every mistake in training options: `python tests/faults/table.py`, as Markdown."""

import contextlib
import io
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from test_bad_input import MISTAKES

from jaxpg import train
from jaxpg.commands.ending import run_command


def answer(arguments):
    """Exit status and what is printed on standard error."""
    error, sys.argv = io.StringIO(), ["jaxpg", *arguments]
    try:
        with contextlib.redirect_stderr(error), contextlib.redirect_stdout(io.StringIO()):
            run_command(train.main)
    except SystemExit as ending:
        return ending.code, error.getvalue().strip()


def main():
    print("| mistake | input | status | what is said |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for mistake, (arguments, _) in MISTAKES.items():
            where = [] if arguments[0].startswith("resume=") else [f"run_dir={folder}/run"]
            status, said = answer([*arguments, *where])
            assert not (Path(folder) / "run").exists(), mistake
            print(f"| {mistake} | `{' '.join(arguments)}` | {status} | {said.replace('|', chr(92) + '|')} |")


if __name__ == "__main__":
    main()
