"""Commands run in the process of the tests, and what they may not touch."""

import contextlib
import io
import sys

from jaxpg.commands.ending import run_command


def ended(main, arguments):
    """Exit status, output and errors of a command; what it raises besides is a failure of the test."""
    before, sys.argv = sys.argv, ["jaxpg", *map(str, arguments)]
    out, error = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
            run_command(main)
    except SystemExit as ending:
        return ending.code, out.getvalue(), error.getvalue()
    finally:
        sys.argv = before


def contents(folder):
    """Everything below a folder, with what would show that it was written: bytes or target, and time."""
    return {
        str(path.relative_to(folder)): (
            path.readlink() if path.is_symlink() else path.read_bytes() if path.is_file() else None,
            path.lstat().st_mtime_ns,
        )
        for path in folder.rglob("*")
    }
