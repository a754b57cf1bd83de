"""Commands in messages, as who reads them can type them."""

from __future__ import annotations

import shlex
import shutil
import sys
from pathlib import Path


def python() -> str:
    """The interpreter that runs this: by its name if the shell finds it by that, else by its path.

    The path is relative where the interpreter is below the working directory: `.venv/bin/python`.
    """
    path = Path(sys.executable or "python")
    if shutil.which(path.name) == str(path):
        return path.name
    if path.is_relative_to(Path.cwd()):
        path = path.relative_to(Path.cwd())
    return shlex.quote(str(path))


def pip_install(*packages: str) -> str:
    """The command that installs packages for this interpreter, and for no other that is on the machine."""
    return f"{python()} -m pip install {shlex.join(packages)}"
