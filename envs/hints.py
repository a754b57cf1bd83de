"""Commands for messages, as the user can type them."""

from __future__ import annotations

import shlex
import shutil
import sys
from pathlib import Path


def python_command() -> str:
    """The running interpreter: its name if the shell finds it by that, else its path.

    The path is relative if the interpreter is below the working directory: `.venv/bin/python`.
    """
    path = Path(sys.executable or "python")
    if shutil.which(path.name) == str(path):
        return path.name
    if path.is_relative_to(Path.cwd()):
        path = path.relative_to(Path.cwd())
    return shlex.quote(str(path))


def pip_install(*packages: str) -> str:
    """The command that installs packages for exactly this interpreter."""
    return f"{python_command()} -m pip install {shlex.join(packages)}"
