"""Typed options: a default, one line of help and the allowed range, kept together in a dataclass field.

`option(...)` makes such a field; `build(Config, overrides)` makes the dataclass from names and values, and reports all
mistakes at once. Environments and commands declare their options this way, so a default, its range and its help are in
one place. A field without `option` is an option too, without range and help.

An option is a number, a switch or a string: int, float, bool, str, `Literal[...]`, a list or tuple of these, or a union
such as `... | None`. All of these can be written on a command line and in a file.
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
from typing import TYPE_CHECKING, Any, Literal, TypeVar

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Config = TypeVar("Config", bound="DataclassInstance")

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
      default: the default value.
      help: one line, with units in square brackets.
      above, at_least: exclusive and inclusive lower bound. In a list they hold for each element.
      below, at_most: exclusive and inclusive upper bound.
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
    if isinstance(default, list):  # dataclasses refuse it as a default, since all instances would share it
        return dataclasses.field(default_factory=lambda: list(default), metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def build(config_class: type[Config], overrides: Mapping[str, Any], prefix: str = "") -> Config:
    """Makes `config_class(**overrides)`, after checking every name, type and range.

    Args:
      config_class: a dataclass whose fields were made with `option`.
      overrides: values by field name; integral floats are accepted as integers, and integers as floats.
      prefix: prefix of the names in messages, for example `"env."`.

    Raises:
      OptionError: lists every unknown name (with the nearest one), wrong type and value out of range; or has the
        ValueError that the class itself raises.
    """
    fields = {field.name: field for field in dataclasses.fields(config_class)}
    hints = typing.get_type_hints(config_class)
    problems, values = [], {}
    for name, value in overrides.items():
        if name not in fields:
            problems.append(describe_unknown("option", prefix + name, [prefix + known for known in fields]))
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
    except ValueError as error:  # from its __post_init__
        raise OptionError([f"{prefix.removesuffix('.')}: {error}" if prefix else str(error)]) from error


def find_declaration_problems(config_class: Any) -> Iterator[str]:
    """The mistakes in a class of options, one line each."""
    if not (isinstance(config_class, type) and dataclasses.is_dataclass(config_class)):
        yield f"its config must be a dataclass of options, not {config_class!r}"
        return
    try:
        hints = typing.get_type_hints(config_class)
    except Exception as error:  # whatever evaluating an annotation raises
        yield f"an annotation of {config_class.__name__} cannot be evaluated ({error})"
        return
    for field in dataclasses.fields(config_class):
        yield from _find_field_problems(field, hints[field.name])


def _find_field_problems(field: dataclasses.Field, hint: Any) -> Iterator[str]:
    where = f"option '{field.name}'"
    if not field.init:
        yield f"{where} has init=False: derived values belong in the environment"
    elif not _is_supported(hint):
        expected = "int, float, bool, str, Literal, a list or tuple of these, or ... | None"
        yield f"{where} is {_format_hint(hint)}: expected {expected}"
    elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
        yield f"{where} has no default"
    elif not field.name.isascii():
        yield f"{where}: expected ASCII letters, digits and _ only"
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


def _format_hint(hint: Any) -> str:
    return hint.__name__ if isinstance(hint, type) and not typing.get_args(hint) else str(hint).removeprefix("typing.")


def describe_unknown(kind: str, name: str, known: Iterable[str]) -> str:
    """`unknown KIND 'NAME'` with the nearest known name, or else with all known names if they are few."""
    known = sorted(known)
    closest = find_nearest(name, known)
    if closest is not None:
        return f"unknown {kind} '{name}': did you mean '{closest}'?"
    group = name.rpartition(".")[0]
    known = [other for other in known if group and other.rpartition(".")[0] == group] or known
    return f"unknown {kind} '{name}': " + (f"known are {', '.join(known)}" if len(known) <= 20 else "see --help")


def find_nearest(name: str, known: Sequence[str]) -> str | None:
    """The known name that was probably meant; None if none is near.

    It is the same name in another group, such as algo.gamma for gamma; or else a name in the same group that is spelt
    alike, or that has the name as one of its words, such as actor_lr for lr. The group, which is everything before the
    last dot, does not count in the spelling.
    """
    group, _, leaf = name.rpartition(".")
    leaves = {other: other.rpartition(".")[2] for other in known}
    in_group = {other: end for other, end in leaves.items() if group and other.rpartition(".")[0] == group}
    same = [other for other, end in leaves.items() if end == leaf]
    alike = difflib.get_close_matches(leaf, (in_group or leaves).values(), n=1, cutoff=0.6)
    candidates = same or [
        other for other, end in (in_group or leaves).items() if end in alike or leaf in end.split("_")
    ]
    return min(candidates, key=lambda other: leaves[other] not in alike, default=None)


def convert(hint: Any, value: Any) -> Any:
    """`value` converted to the annotated type `hint` of an option.

    For a union such as `int | None`, the first type that fits.

    Raises:
      ValueError: says what was expected instead.
    """
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return _convert_to_one_of(arguments, value)
    if origin is Literal:
        return _convert_choice(arguments, value)
    if origin in (list, tuple):
        return origin(_convert_elements(origin, arguments, value))
    if hint in (int, float):
        return _convert_number(hint, value)
    if hint in (bool, str, type(None)) and isinstance(value, hint):
        return value
    raise ValueError(f"expected {_TYPE_NAMES[hint]}")


def _convert_number(kind: type, value: Any) -> Any:
    try:
        if _is_real(value):
            if kind is float:
                return float(value)
            if float(value).is_integer():
                return int(value)
    except OverflowError:
        raise ValueError("this number is too large") from None
    raise ValueError(f"expected {_TYPE_NAMES[kind]}")


def _is_real(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)  # includes numpy's numbers


def _convert_to_one_of(hints: Sequence[Any], value: Any) -> Any:
    expected = []
    for hint in hints:
        try:
            return convert(hint, value)
        except ValueError as error:
            if hint is not type(None):
                expected.append(str(error))
    raise ValueError(" or ".join([expected[0], *(text.removeprefix("expected ") for text in expected[1:])]))


def _convert_choice(choices: Sequence[Any], value: Any) -> Any:
    for choice in choices:
        if type(value) is type(choice) and value == choice:
            return choice
    raise ValueError(f"expected {' or '.join(map(str, choices))}")


def _convert_elements(origin: type, hints: Sequence[Any], value: Any) -> list[Any]:
    """The converted elements of a list or tuple, with one type for each element or one for all."""
    is_uniform = origin is list or hints[-1] is ...
    if not isinstance(value, (list, tuple)) or not (is_uniform or len(value) == len(hints)):
        raise ValueError("expected a list such as [64,64]" if is_uniform else f"expected a list of {len(hints)} values")
    types_of = [hints[0]] * len(value) if is_uniform else hints
    return [convert(hint, element) for hint, element in zip(types_of, value, strict=True)]


def describe(field: dataclasses.Field) -> str:
    """The field's help, with its allowed range in brackets, as far as they are given."""
    allowed = describe_range(field.metadata)
    return " ".join(filter(None, [field.metadata.get("help", ""), allowed and f"({allowed})"]))


def describe_range(metadata: Mapping[str, Any]) -> str:
    """The allowed range as text, such as `above 0, at most 1`; empty if there is none."""
    if metadata.get("choices"):
        return " or ".join(metadata["choices"])
    bounds = [(key, metadata.get(key)) for key in _BOUNDS]
    return ", ".join(f"{key.replace('_', ' ')} {bound}" for key, bound in bounds if bound is not None)


def _check_range(metadata: Mapping[str, Any], value: Any) -> None:
    for element in _iterate_elements(value):
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


def _iterate_elements(value: Any) -> Iterator[Any]:
    if isinstance(value, (list, tuple)):
        for element in value:
            yield from _iterate_elements(element)
    else:
        yield value
