"""What can be wrong with a checkpoint."""

from __future__ import annotations

import os
import re

from jaxpg.errors import UserError


class CheckpointError(UserError):
    """A checkpoint that is missing, damaged, or of another program."""

    word = "damaged"  # in a list of checkpoints


class OtherRunError(CheckpointError):
    """A sound checkpoint, of another run."""

    word = "of another run"


class SaveError(Exception):
    """A checkpoint that could not be written: where and why."""


def reason(error: BaseException) -> str:
    r"""The operating system's words, if it has refused something, and else the first line of the message.

    >>> reason(ValueError("first\nsecond"))
    'first'
    """
    cause: BaseException | None = error
    while cause is not None:
        code = re.search(r"os_error_code='(\d+)'", str(cause))  # tensorstore's, in a ValueError
        if code:
            return os.strerror(int(code[1]))
        if isinstance(cause, OSError) and cause.errno:
            return cause.strerror or os.strerror(cause.errno)
        cause = cause.__cause__ or cause.__context__
    return (str(error).splitlines() or [type(error).__name__])[0]
