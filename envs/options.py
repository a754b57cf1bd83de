"""Typed options: a default, one line of help and the allowed range, kept together in a dataclass field.

`option(...)` makes such a field, `build(Config, overrides)` makes the dataclass from names and values and lists
everything that is wrong with them at once. Environments and the commands declare what they take in this way, so a
default, its range and its help stand in one place. A field without `option` is one too, with neither range nor help.

An option is a number, a switch or a text: int, float, bool, str, `Literal[...]`, a list or tuple of these, or several
of them, `... | None`. They are what a command line and a file can say.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import numbers
import operator
import types
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, TypeVar

Config = TypeVar("Config")

_BOUNDS = {"above": operator.gt, "at_least": operator.ge, "below": operator.lt, "at_most": operator.le}
_TYPE_NAMES = {int: "a whole number", float: "a number", bool: "true or false", str: "a name", type(None): "null"}


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
    if isinstance(default, list):  # which dataclasses refuse as a default, since all would share it
        return dataclasses.field(default_factory=lambda: list(default), metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def build(config_class: type[Config], overrides: Mapping[str, Any], prefix: str = "") -> Config:
    """`config_class(**overrides)`, once every name, type and range has been checked.

    Args:
      config_class: a dataclass whose fields were made with `option`.
      overrides: values by field name; integral floats are taken as integers and integers as floats.
      prefix: put before the names in messages, for example `"env."`.

    Raises:
      OptionError: lists every unknown name (with the nearest one), wrong type and value out of range; or says what the
        class itself, in a ValueError, refuses.
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
    try:
        return config_class(**values)
    except OptionError:
        raise
    except ValueError as error:  # of its own __post_init__
        raise OptionError([f"{prefix.removesuffix('.')}: {error}" if prefix else str(error)]) from error


def declaration_problems(config_class: Any) -> Iterator[str]:
    """What keeps a class from being one of options: a line for each, none where it is."""
    if not (isinstance(config_class, type) and dataclasses.is_dataclass(config_class)):
        yield f"its config must be a dataclass of options, not {config_class!r}"
        return
    try:
        hints = typing.get_type_hints(config_class)
    except Exception as error:  # whatever evaluating an annotation raises
        yield f"an annotation of {config_class.__name__} means nothing ({error})"
        return
    for field in dataclasses.fields(config_class):
        yield from _field_problems(field, hints[field.name])


def _field_problems(field: dataclasses.Field, hint: Any) -> Iterator[str]:
    where = f"option '{field.name}'"
    if not field.init:
        yield f"{where} has init=False: what follows from the options belongs to the environment"
    elif not _is_supported(hint):
        expected = "int, float, bool, str, Literal, a list or tuple of these, or ... | None"
        yield f"{where} is {_shown(hint)}: expected {expected}"
    elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
        yield f"{where} has no default"
    elif not field.name.isascii():
        yield f"{where}: a command line can say ASCII letters, digits and _ only"
    else:
        default = field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
        try:
            _check_range(field.metadata, convert(hint, default))
        except ValueError as error:
            yield f"{where}: its default {default!r}: {error}"


def _is_supported(hint: Any) -> bool:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return all(type(value) in _TYPE_NAMES for value in arguments)
    if origin in (list, tuple, typing.Union, types.UnionType):
        return bool(arguments) and all(_is_supported(argument) for argument in arguments if argument is not ...)
    return hint in _TYPE_NAMES


def _shown(hint: Any) -> str:
    return hint.__name__ if isinstance(hint, type) and not typing.get_args(hint) else str(hint).removeprefix("typing.")


def unknown(kind: str, name: str, known: Iterable[str]) -> str:
    """`unknown KIND 'NAME'` with the nearest known name, or with all of them where none is near and they are few."""
    known = sorted(known)
    near = nearest(name, known)
    if near is not None:
        return f"unknown {kind} '{name}': did you mean '{near}'?"
    group = name.rpartition(".")[0]
    known = [other for other in known if group and other.rpartition(".")[0] == group] or known
    return f"unknown {kind} '{name}': " + (f"known are {', '.join(known)}" if len(known) <= 20 else "see --help")


def nearest(name: str, known: Sequence[str]) -> str | None:
    """The known name that was meant; None where none is near.

    It is the same name in another group, as algo.gamma is for gamma; or else one of the same group that is spelt alike,
    or that has it among its words, as actor_lr has lr. What is before the last dot, which all of a group share, says
    nothing of how near they are.
    """
    group, _, leaf = name.rpartition(".")
    leaves = {other: other.rpartition(".")[2] for other in known}
    in_group = {other: end for other, end in leaves.items() if group and other.rpartition(".")[0] == group}
    same = [other for other, end in leaves.items() if end == leaf]
    alike = difflib.get_close_matches(leaf, (in_group or leaves).values(), n=1, cutoff=0.6)
    found = same or [other for other, end in (in_group or leaves).items() if end in alike or leaf in end.split("_")]
    return min(found, key=lambda other: leaves[other] not in alike, default=None)


def convert(hint: Any, value: Any) -> Any:
    """`value` as the annotated type `hint`: one of those that an option can have.

    Of several types, `int | None`, it is the first that the value is of.

    Raises:
      ValueError: what was expected instead.
    """
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return _convert_to_one_of(arguments, value)
    if origin is Literal:
        return _chosen(arguments, value)
    if origin in (list, tuple):
        return origin(_convert_elements(origin, arguments, value))
    if hint in (int, float):
        return _convert_number(hint, value)
    if hint in (bool, str, type(None)) and isinstance(value, hint):
        return value
    raise ValueError(f"expected {_TYPE_NAMES[hint]}")


def _convert_number(kind: type, value: Any) -> Any:
    try:
        if isinstance(value, numbers.Real) and not isinstance(value, bool):  # numpy's are such numbers too
            if kind is float:
                return float(value)
            if float(value).is_integer():
                return int(value)
    except OverflowError:
        raise ValueError("this number is too large") from None
    raise ValueError(f"expected {_TYPE_NAMES[kind]}")


def _convert_to_one_of(hints: Sequence[Any], value: Any) -> Any:
    expected = []
    for hint in hints:
        try:
            return convert(hint, value)
        except ValueError as error:
            if hint is not type(None):
                expected.append(str(error))
    raise ValueError(" or ".join([expected[0], *(text.removeprefix("expected ") for text in expected[1:])]))


def _chosen(choices: Sequence[Any], value: Any) -> Any:
    for choice in choices:
        if type(value) is type(choice) and value == choice:
            return choice
    raise ValueError(f"expected {' or '.join(map(str, choices))}")


def _convert_elements(origin: type, hints: Sequence[Any], value: Any) -> list[Any]:
    """Those of a list or tuple: with as many types as it has elements, or with one for all of them."""
    each = origin is list or hints[-1] is ...
    if not isinstance(value, (list, tuple)) or not (each or len(value) == len(hints)):
        raise ValueError("expected a list such as [64,64]" if each else f"expected a list of {len(hints)} values")
    types_of = [hints[0]] * len(value) if each else hints
    return [convert(hint, element) for hint, element in zip(types_of, value, strict=True)]


def describe(field: dataclasses.Field) -> str:
    """The field's help, with its allowed range in brackets; what was not said is left out."""
    allowed = describe_range(field.metadata)
    return " ".join(filter(None, [field.metadata.get("help", ""), allowed and f"({allowed})"]))


def describe_range(metadata: Mapping[str, Any]) -> str:
    """The allowed range in words, such as `above 0, at most 1`; empty where anything goes."""
    if metadata.get("choices"):
        return " or ".join(metadata["choices"])
    bounds = [(key, metadata.get(key)) for key in _BOUNDS]
    return ", ".join(f"{key.replace('_', ' ')} {bound}" for key, bound in bounds if bound is not None)


def _check_range(metadata: Mapping[str, Any], value: Any) -> None:
    for element in _elements(value):
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


def _elements(value: Any) -> Iterator[Any]:
    if isinstance(value, (list, tuple)):
        for element in value:
            yield from _elements(element)
    else:
        yield value
