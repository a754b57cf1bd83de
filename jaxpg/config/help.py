"""The help of the commands, made from the options themselves."""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Sequence
from typing import Any

from envs.options import describe
from jaxpg.config.configuration import flatten
from jaxpg.config.entries import GROUPS, option_fields
from jaxpg.config.parsing import compose
from jaxpg.config.schema import Run
from jaxpg.config.sweep import sweepable

SWEEP = (
    "sweep.NAME=[VALUE,VALUE,...] trains agents with each value of the option NAME, all in one program; with several "
    "NAMEs all combinations of their values. NAME is one of"
)


def train_help(arguments: Sequence[str]) -> str:
    """Every option with its default for the chosen environment and algorithm, its range and its meaning."""
    config = compose(arguments)
    values, fields = flatten(config), option_fields(config.choices)
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
        lines += ["", about, *(_line(name, values[name], fields[name]) for name in names)]
    names = ", ".join(sweepable(config.choices))
    lines += ["", *textwrap.wrap(f"{SWEEP} {names}.", width=120)]
    lines += ["", "Shown are the defaults for the environment and the algorithm named above; add env=... or algo=..."]
    return "\n".join(lines)


def command_help(command: str, what: str, schema: type) -> str:
    """Every option of a command about `what`, such as `run=DIR`."""
    lines = [f"usage: python -m jaxpg.{command} {what} [option=value] ...", "", schema.__doc__]
    return "\n".join(lines + [_line(field.name, field.default, field) for field in dataclasses.fields(schema)])


def _line(name: str, value: Any, field: dataclasses.Field) -> str:
    shown = "" if value is None else str(value).replace(" ", "")
    if isinstance(value, bool):
        shown = shown.lower()
    return f"  {name}={shown}".ljust(38) + describe(field)
