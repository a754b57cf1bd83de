"""Typed options: a default, one line of help and the allowed range, kept together in a dataclass field.

`option(...)` makes such a field, `build(Config, overrides)` makes the dataclass from names and values and lists
everything that is wrong with them at once. Environments and the commands declare what they take in this way, so a
default, its range and its help stand in one place.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import operator
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

Config = TypeVar("Config")

_BOUNDS = {"above": operator.gt, "at_least": operator.ge, "below": operator.lt, "at_most": operator.le}
_TYPE_NAMES = {int: "a whole number", float: "a number", bool: "true or false", str: "a name"}


class OptionError(ValueError):
    """Options that cannot be used; `problems` holds one line for each."""

    def __init__(self, problems: Iterable[str]):
        self.problems = list(problems)
        super().__init__("; ".join(self.problems))


def option(
    default: Any,
    help: str,
    *,
    above: float | None = None,
    at_least: float | None = None,
    below: float | None = None,
    at_most: float | None = None,
    choices: tuple[str, ...] | None = None,
) -> Any:
    """A dataclass field with its help text and its allowed range.

    Args:
      default: the value when nothing is said.
      help: one line; units in square brackets.
      above, at_least: exclusive and inclusive lower end. For a list they hold for each element.
      below, at_most: exclusive and inclusive upper end.
      choices: the allowed strings.
    """
    metadata = {
        "help": help,
        "above": above,
        "at_least": at_least,
        "below": below,
        "at_most": at_most,
        "choices": choices,
    }
    if isinstance(default, list):
        return dataclasses.field(default_factory=lambda: list(default), metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def build(config_class: type[Config], overrides: Mapping[str, Any], prefix: str = "") -> Config:
    """`config_class(**overrides)`, once every name, type and range has been checked.

    Args:
      config_class: a dataclass whose fields were made with `option`.
      overrides: values by field name; integral floats are taken as integers and integers as floats.
      prefix: put before the names in messages, for example `"env."`.

    Raises:
      OptionError: lists every unknown name (with the nearest one), wrong type and value out of range.
    """
    fields = {field.name: field for field in dataclasses.fields(config_class)}
    hints = typing.get_type_hints(config_class)
    problems, values = [], {}
    for name, value in overrides.items():
        if name not in fields:
            problems.append(unknown("option", prefix + name, [prefix + known for known in fields]))
            continue
        try:
            values[name] = convert(hints[name], value)
            _check_range(fields[name].metadata, values[name])
        except ValueError as error:
            problems.append(f"{prefix}{name}={value}: {error}")
    if problems:
        raise OptionError(problems)
    return config_class(**values)


def unknown(kind: str, name: str, known: Iterable[str]) -> str:
    """`unknown KIND 'NAME'` with the nearest known name, or with all of them where none is near and they are few."""
    known = sorted(known)
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    if near:
        return f"unknown {kind} '{name}': did you mean '{near[0]}'?"
    return f"unknown {kind} '{name}': " + (f"known are {', '.join(known)}" if len(known) <= 20 else "see --help")


def convert(hint: Any, value: Any) -> Any:
    """`value` as the annotated type `hint` (int, float, bool, str, `list[...]` of these, or `... | None`).

    Raises:
      ValueError: what was expected instead.
    """
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        (hint,) = [arg for arg in typing.get_args(hint) if arg is not type(None)]
        return None if value is None else convert(hint, value)
    if typing.get_origin(hint) is list:
        if not isinstance(value, (list, tuple)):
            raise ValueError("expected a list such as [64,64]")
        return [convert(typing.get_args(hint)[0], element) for element in value]
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    try:
        if hint is int and is_number and float(value).is_integer():
            return int(value)
        if hint is float and is_number:
            return float(value)
    except OverflowError:
        raise ValueError("this number is too large") from None
    if hint in (bool, str) and isinstance(value, hint):
        return value
    raise ValueError(f"expected {_TYPE_NAMES[hint]}")


def describe(field: dataclasses.Field) -> str:
    """The field's help, with its allowed range in brackets."""
    allowed = describe_range(field.metadata)
    return field.metadata["help"] + (f" ({allowed})" if allowed else "")


def describe_range(metadata: Mapping[str, Any]) -> str:
    """The allowed range in words, such as `above 0, at most 1`; empty where anything goes."""
    if metadata.get("choices"):
        return " or ".join(metadata["choices"])
    bounds = [(key, metadata.get(key)) for key in _BOUNDS]
    return ", ".join(f"{key.replace('_', ' ')} {bound}" for key, bound in bounds if bound is not None)


def _check_range(metadata: Mapping[str, Any], value: Any) -> None:
    for element in value if isinstance(value, list) else [value]:
        if isinstance(element, str):
            allowed = not metadata.get("choices") or element in metadata["choices"]
        elif element is None or isinstance(element, bool):
            allowed = True
        else:
            if not math.isfinite(element):
                raise ValueError("must be finite")
            bounds = [(compare, metadata.get(key)) for key, compare in _BOUNDS.items()]
            allowed = all(compare(element, bound) for compare, bound in bounds if bound is not None)
        if not allowed:
            raise ValueError(f"must be {describe_range(metadata)}")
