"""The lines of `metrics.jsonl`: one JSON object for each chunk of updates."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

LARGEST = 2**63  # below it are all counts


def json_line(line: Mapping[str, Any]) -> str:
    """A line as it is written; its values are finite numbers, None, or lists of these with one for each agent."""
    return json.dumps(line, allow_nan=False) + "\n"


def sound(text: str, agents: int | None = None) -> tuple[list[dict[str, Any]], list[int]]:
    """The lines of a run as they were written, and the numbers, from 1, of those that are damaged.

    Of a run all lines have the same number of agents and of steps per update, and their updates grow: a line that
    differs from most in that is damaged, too. A last line that is not whole is neither: a kill leaves it so.

    Args:
      text: the content of the file.
      agents: of the run; None: as many as in most lines.
    """
    *texts, torn = text.split("\n")
    lines = [_parsed(one) for one in texts + [torn] * (_parsed(torn) is not None)]
    lines = [line if line and agents in (None, _agents(line)) else None for line in lines]
    kinds = Counter(_kind(line) for line in lines if line)
    usual, last = max(kinds, key=kinds.__getitem__, default=None), 0
    found, damaged = [], []
    for number, line in enumerate(lines, 1):
        if line and _agents(line) and _kind(line) == usual and line["update"] > last:
            found.append(line)
            last = line["update"]
        else:
            damaged.append(number)
    return found, damaged


def up_to(lines: Iterable[dict[str, Any]], update: int) -> list[dict[str, Any]]:
    """The lines of the first updates: those that a checkpoint after `update` of them goes on from."""
    return [line for line in lines if line["update"] <= update]


def _parsed(text: str) -> dict[str, Any] | None:
    """The line, if it is one: an object of numbers with those that every line has."""
    try:
        line = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(line, dict) or not all(_is_count(line.get(name)) for name in ("update", "steps")):
        return None
    numbers = _is_number(line.get("seconds")) and all(map(_is_value, line.values()))
    return line if numbers else None


def _kind(line: Mapping[str, Any]) -> tuple[int, float]:
    """What all lines of a run have in common: how many agents, and steps per update."""
    return _agents(line), line["steps"] / line["update"]


def _agents(line: Mapping[str, Any]) -> int:
    """How many values there are of everything; 0 where the lists differ in that."""
    numbers = {len(value) for value in line.values() if isinstance(value, list)} or {1}
    return max(numbers) if len(numbers) == 1 else 0


def _is_count(value: Any) -> bool:
    return type(value) is int and 1 <= value < LARGEST


def _is_number(value: Any) -> bool:
    return (type(value) is int and abs(value) < LARGEST) or (type(value) is float and math.isfinite(value))


def _is_value(value: Any) -> bool:
    numbers = value if isinstance(value, list) else [value]
    return all(number is None or _is_number(number) for number in numbers)
