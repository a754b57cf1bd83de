"""Drawing must not fail a trained run: what cannot be drawn is skipped, with a note that says why.

Drawing errors are caught only here. If an environment cannot be drawn, `DrawingError` gives a note. Any other exception
is a bug: the user gets a note that names it, and with JAXPG_RAISE=1 in the environment, as in the tests, it is raised.
"""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from jaxpg.errors import UserError

RAISE = "JAXPG_RAISE"
Result = TypeVar("Result")


class DrawingError(Exception):
    """Something of an environment cannot be drawn; the text says what and why."""


def attempt(what: str, draw: Callable[[], Result], say: Callable[[str], None]) -> Result | None:
    """Returns `draw()`, or None with a line for the user if it cannot be drawn.

    Args:
      what: what is drawn, such as "report".
      draw: draws it.
      say: takes the line, such as "no workspace: the metric distance is missing".
    """
    try:
        return draw()
    except (DrawingError, UserError) as error:
        say(f"no {what}: {error}")
    except Exception as error:
        if os.environ.get(RAISE):
            raise
        say(f"no {what}: {describe_error(error)}; {RAISE}=1 shows where it comes from")
    return None


def describe_error(error: Exception) -> str:
    """An exception in one line, such as `KeyError: 'x' (player.py, line 144)`, with its place outside libraries."""
    name = type(error).__name__
    text = " ".join(str(error).split())
    frames = traceback.extract_tb(error.__traceback__)
    frames_outside = [frame for frame in frames if "site-packages" not in frame.filename] or frames
    place = f" ({Path(frames_outside[-1].filename).name}, line {frames_outside[-1].lineno})" if frames_outside else ""
    return f"{name}: {text}{place}" if text else f"{name}{place}"
