"""The help of the commands, made from their options."""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Sequence
from typing import Any

from envs.options import describe
from jaxpg.config.configuration import flatten
from jaxpg.config.entries import GROUPS, find_option_fields
from jaxpg.config.parsing import compose
from jaxpg.config.schema import Run
from jaxpg.config.sweep import find_sweepable_options

SWEEP = (
    "sweep.NAME=[VALUE,VALUE,...] trains agents with each value of the option NAME, all in one program; several sweeps "
    "give all combinations of their values. NAME is one of"
)


def format_train_help(arguments: Sequence[str]) -> str:
    """All options of a training, with their defaults for the chosen environment and algorithm, ranges and help."""
    config = compose(arguments)
    values, fields = flatten(config), find_option_fields(config.choices)
    lines = [
        "usage: python -m jaxpg.train [group=member] [option=value] ...",
        "       python -m jaxpg.train resume=DIR [total_steps=N]",
        "       python -m jaxpg.train resume=auto run_dir=DIR [group=member] [option=value] ...",
        "",
        *(f"{group}={config.choices[group]}".ljust(28) + f"one of {', '.join(GROUPS[group])}" for group in GROUPS),
    ]
    for group in ("", *GROUPS):
        schema = GROUPS[group][config.choices[group]] if group else Run
        names = [name for name in fields if name.rpartition(".")[0] == group]
        about = (schema.__doc__ or schema.__name__).splitlines()[0]
        lines += ["", about, *(_format_line(name, values[name], fields[name]) for name in names)]
    names = ", ".join(find_sweepable_options(config.choices))
    lines += ["", *textwrap.wrap(f"{SWEEP} {names}.", width=120)]
    lines += ["", "The defaults are those of the environment and algorithm above; for others, add env=... or algo=..."]
    return "\n".join(lines)


def format_command_help(command: str, what: str, schema: type) -> str:
    """All options of a command; `what` is its subject, such as `run=DIR`."""
    lines = [f"usage: python -m jaxpg.{command} {what} [option=value] ...", "", schema.__doc__]
    return "\n".join(lines + [_format_line(field.name, field.default, field) for field in dataclasses.fields(schema)])


def _format_line(name: str, value: Any, field: dataclasses.Field) -> str:
    text = "" if value is None else str(value).replace(" ", "")
    if isinstance(value, bool):
        text = text.lower()
    return f"  {name}={text}".ljust(38) + describe(field)
