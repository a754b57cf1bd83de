"""The lines of `metrics.jsonl`: one JSON object for each chunk of updates."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

MAX_COUNT = 2**63  # exclusive


def format_line(line: Mapping[str, Any]) -> str:
    """The line as text; its values are finite numbers, None, or lists of these with one per agent."""
    return json.dumps(line, allow_nan=False) + "\n"


def parse_lines(text: str, agents: int | None = None) -> tuple[list[dict[str, Any]], list[int]]:
    """Parses metrics; returns the sound lines and the numbers, from 1, of the damaged ones.

    All lines of a run have the same number of agents and of steps per update, and their updates increase. A line that
    differs from the majority in these is damaged too. An incomplete last line, as a kill leaves it, is ignored.

    Args:
      text: the content of the file.
      agents: number of agents of the run; None: that of most lines.
    """
    *texts, rest = text.split("\n")
    lines = [_parse_line(one) for one in texts + [rest] * (_parse_line(rest) is not None)]
    lines = [line if line and agents in (None, _count_agents(line)) else None for line in lines]
    kinds = Counter(_kind(line) for line in lines if line)
    usual, last = max(kinds, key=kinds.__getitem__, default=None), 0
    sound, damaged = [], []
    for number, line in enumerate(lines, 1):
        if line and _count_agents(line) and _kind(line) == usual and line["update"] > last:
            sound.append(line)
            last = line["update"]
        else:
            damaged.append(number)
    return sound, damaged


def select_until(lines: Iterable[dict[str, Any]], update: int) -> list[dict[str, Any]]:
    """The lines up to `update`: those that a run resumed from that checkpoint keeps."""
    return [line for line in lines if line["update"] <= update]


def _parse_line(text: str) -> dict[str, Any] | None:
    """The line, or None if the text is not an object of numbers with the required entries."""
    try:
        line = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(line, dict) or not all(_is_count(line.get(name)) for name in ("update", "steps")):
        return None
    numbers = _is_number(line.get("seconds")) and all(map(_is_value, line.values()))
    return line if numbers else None


def _kind(line: Mapping[str, Any]) -> tuple[int, float]:
    """Number of agents and steps per update, which all lines of a run share."""
    return _count_agents(line), line["steps"] / line["update"]


def _count_agents(line: Mapping[str, Any]) -> int:
    """Number of agents in a line; 0 if its lists differ in length."""
    numbers = {len(value) for value in line.values() if isinstance(value, list)} or {1}
    return max(numbers) if len(numbers) == 1 else 0


def _is_count(value: Any) -> bool:
    return type(value) is int and 1 <= value < MAX_COUNT


def _is_number(value: Any) -> bool:
    return (type(value) is int and abs(value) < MAX_COUNT) or (type(value) is float and math.isfinite(value))


def _is_value(value: Any) -> bool:
    numbers = value if isinstance(value, list) else [value]
    return all(number is None or _is_number(number) for number in numbers)
