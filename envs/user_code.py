"""Reports exceptions in a user's own code, with their place."""

from __future__ import annotations

import contextlib
import sys
import traceback
from collections.abc import Iterator
from typing import Any

from envs.options import OptionError
from envs.physics import MujocoModelError

# Modules whose frames are skipped on the way to the user's function.
LIBRARIES = {"envs", "jaxpg", "jax", "jaxlib", "flax", "numpy", "mujoco", "brax"} | set(sys.stdlib_module_names)


@contextlib.contextmanager
def catch_user_errors(name: str, doing: str, code: Any) -> Iterator[None]:
    """Turns an exception in the block into one line that says what raised it and where, with the exception as cause.

    Args:
      name: name of the environment.
      doing: what is called, such as "step".
      code: the function that is called, or the object whose method it is. Exceptions of this package's own environments
        are not the user's mistake, and pass unchanged.

    Raises:
      OptionError: the line.
    """
    try:
        yield
    except (OptionError, MujocoModelError):
        raise
    except Exception as error:
        if (getattr(code, "__module__", None) or "").partition(".")[0] == "envs":
            raise
        text = (str(error).splitlines() or [""])[0]
        problem = f"env={name}: {doing} raises {type(error).__name__}{_find_place(error)}" + (
            f": {text}" if text else ""
        )
        raise OptionError([problem]) from error


def _find_place(error: Exception) -> str:
    """` at FILE:LINE` of the innermost frame outside of libraries and this package; empty if there is none."""
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        module = frame.f_globals.get("__name__", "").partition(".")[0]
        if module not in LIBRARIES:
            return f" at {frame.f_code.co_filename}:{line}"
    return ""
