"""Drawing must not fail a run that has been trained: what cannot be drawn is left out, with a note that says why.

The one place where errors of drawing are caught. That an environment cannot be drawn is `NotDrawn`, and no more than a
note. Any other exception is a bug: users have a note that names it, and with JAXPG_RAISE=1 in the environment, as in
the tests, it is raised.
"""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from jaxpg.errors import UserError

RAISE = "JAXPG_RAISE"
Drawn = TypeVar("Drawn")


class NotDrawn(Exception):
    """What an environment does not have, or not in a form that can be drawn; its text says what and why."""


def attempt(what: str, draw: Callable[[], Drawn], say: Callable[[str], None]) -> Drawn | None:
    """`draw()`; None where it cannot be drawn, with a line that says so.

    Args:
      what: is drawn, such as "report".
      draw: draws it.
      say: takes the line, such as "no workspace: the metric distance is not there".
    """
    try:
        return draw()
    except (NotDrawn, UserError) as error:
        say(f"no {what}: {error}")
    except Exception as error:
        if os.environ.get(RAISE):
            raise
        say(f"no {what}: {described(error)}; {RAISE}=1 shows where it comes from")
    return None


def described(error: Exception) -> str:
    """An exception in one line, such as `KeyError: 'x' (player.py, line 144)`: the place outside of libraries."""
    name = type(error).__name__
    text = " ".join(str(error).split())
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "site-packages" not in frame.filename] or frames
    place = f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else ""
    return f"{name}: {text}{place}" if text else f"{name}{place}"
