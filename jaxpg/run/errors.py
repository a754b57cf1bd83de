"""How commands end: mistakes of the user in one clear line each and status 2; mistakes of ours with their traceback."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Sequence

from envs.options import OptionError
from envs.physics import MujocoModelError


class UserError(Exception):
    """Something that the user can put right; its text says what is wrong and what would be right."""


def run_command(main: Callable[[Sequence[str]], int | None]) -> None:
    """`sys.exit(main(arguments))`, where a user's mistake ends in its message and status 2."""
    try:
        status = main(sys.argv[1:])
    except OptionError as error:
        status = _report(error.problems)
    except (UserError, MujocoModelError) as error:
        status = _report([str(error)])
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        status = 130
    gc.freeze()  # the interpreter's last collections would look through all that jax has made: half a second
    sys.exit(status)


def _report(problems: Sequence[str]) -> int:
    for problem in problems:
        print(f"error: {problem}", file=sys.stderr)
    return 2
