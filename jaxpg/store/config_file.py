"""`config.yaml`, the options of a run in its folder."""

from __future__ import annotations

from pathlib import Path

from jaxpg.config.configuration import Config, from_yaml, make_unreadable_error
from jaxpg.store import files


def load(path: Path) -> Config:
    """The configuration in a `config.yaml`.

    Raises:
      UserError: the file cannot be read; OptionError: a name, type or range in it is wrong.
    """
    try:
        text = files.read(path).decode()
    except (OSError, ValueError) as error:  # ValueError: not UTF-8, or an invalid path
        raise make_unreadable_error(str(path), error) from error
    return from_yaml(text, str(path))
