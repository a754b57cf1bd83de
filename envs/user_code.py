"""Where an exception comes from when a user's own code raises it."""

from __future__ import annotations

import contextlib
import sys
import traceback
from collections.abc import Iterator
from typing import Any

from envs.options import OptionError
from envs.physics import MujocoModelError

# Through whose frames an exception passes on its way from a user's function.
PASSED_THROUGH = {"envs", "jaxpg", "jax", "jaxlib", "flax", "numpy", "mujoco", "brax"} | set(sys.stdlib_module_names)


@contextlib.contextmanager
def user_code(name: str, doing: str, code: Any) -> Iterator[None]:
    """An exception inside becomes one line that says what raised it and where; its traceback is the line's cause.

    Args:
      name: of the environment.
      doing: what is called, such as "step".
      code: what is called, or whose method it is. Of this package's own environments an exception is no mistake of the
        user, and stays what it is.

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
        said = (str(error).splitlines() or [""])[0]
        problem = f"env={name}: {doing} raises {type(error).__name__}{_place(error)}" + (f": {said}" if said else "")
        raise OptionError([problem]) from error


def _place(error: Exception) -> str:
    """` at FILE:LINE`, of the innermost frame that is neither a library's nor ours; empty where there is none."""
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        module = frame.f_globals.get("__name__", "").partition(".")[0]
        if module not in PASSED_THROUGH:
            return f" at {frame.f_code.co_filename}:{line}"
    return ""
