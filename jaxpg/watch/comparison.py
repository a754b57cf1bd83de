"""Compares runs, as a page, a figure or a table: which method is better, and how certain that is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from jaxpg.errors import UserError
from jaxpg.store import results, run_files
from jaxpg.store.statistics import (
    has_interval,
    improvement_interval,
    min_seeds,
    probability_of_improvement,
    seed_interval_name,
)
from jaxpg.watch import publication
from jaxpg.watch.curves import PANELS, make_curve, replace_nonfinite
from jaxpg.watch.methods import SAME_METHOD, Method, common_steps, compute_standings, read_methods, task_name
from jaxpg.watch.page import make_page

Json = dict[str, Any]
MAX_METHODS = 10  # in the curves: as many as there are colours
COLUMNS = ["method", "return", "success rate", "seeds", "environment steps"]


def write(paths: Sequence[str], out: Path, say: Callable[[str], None]) -> None:
    """Writes the comparison of run folders in the format of the ending of `out`, and prints its table.

    Raises:
      UserError: as in `read_methods`; the ending is unknown; or the file cannot be written.
    """
    writer = _find_writer(out)
    methods = read_methods(paths)
    run_files.replace(out, writer(methods))
    rows = [list_columns(methods), *make_table(methods)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        say("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    for line in write_notes(methods):
        say(f"note: {line}")
    say(str(out))


def _find_writer(out: Path) -> Callable[[Sequence[Method]], str | bytes]:
    """The function that writes methods in the format of the ending."""
    writers: dict[str, Callable[[Sequence[Method]], str | bytes]] = {
        ".html": lambda methods: make_page(build_comparison(methods)),
        ".pdf": lambda methods: publication.draw_figure(methods, "pdf"),
        ".svg": lambda methods: publication.draw_figure(methods, "svg"),
        ".csv": publication.format_csv,
    }
    if out.suffix.lower() not in writers:
        raise UserError(f"out={out}: must end in {', '.join(writers)}: a page, a figure or a table")
    return writers[out.suffix.lower()]


def build_comparison(methods: Sequence[Method]) -> Json:
    """The data of the page for some methods, as plain values."""
    first, subject = methods[:MAX_METHODS], f"{len(methods)} methods" if len(methods) > 1 else methods[0].label
    rows = [
        {
            "title": "methods, best first",
            "columns": list_columns(methods),
            "rows": make_table(methods),
            "note": None,
        }
    ]
    data = {
        "kind": "comparison",
        "title": f"{subject} on {task_name(methods[0].agents[0])}",
        "facts": [["score", f"return of the evaluation at {common_steps(methods):,} environment steps"]],
        "head": None,
        "notes": write_notes(methods),
        "curves": [panel for panel in (_make_panel(first, *metric) for metric in PANELS.items()) if panel["series"]],
        "diagnostics": [],
        "tables": rows,
        "improvement": compare_methods(first) if len(first) > 1 else None,
        **{"player": None, "portrait": None, "workspace": None, "command": None},
        "configuration": _list_common_options(methods),
        "versions": [],
    }
    return replace_nonfinite(data)


def list_columns(methods: Sequence[Method]) -> list[str]:
    """The column titles of `make_table`."""
    return [name for name in COLUMNS if name != "success rate" or _has_success(methods)]


def make_table(methods: Sequence[Method]) -> list[list[str]]:
    """A row for each method, with the columns of `list_columns`; several seeds as in `results.format_score`."""
    rows = []
    for one in compute_standings(methods):
        rate = "" if one.success is None else results.format_score(100 * one.success) + " %"
        number = str(len(one.method.agents))
        rows.append([one.method.label, results.format_score(one.returns), rate, number, f"{one.steps:,}"])
    return rows if _has_success(methods) else [[*row[:2], *row[3:]] for row in rows]


def _has_success(methods: Sequence[Method]) -> bool:
    return any(method.values("eval_success")[0].size for method in methods)


def write_notes(methods: Sequence[Method]) -> list[str]:
    """Notes on the table: unequal numbers of steps, and too few seeds for an interval."""
    lines, steps = [], common_steps(methods)
    longer = [f"{method.label} trained until {method.max_steps:,}" for method in methods if method.max_steps > steps]
    if longer:
        lines.append(f"compared at {steps:,} environment steps, which all have reached; {', '.join(longer)}")
    nearby = [f"{one.method.label} at {one.steps:,}" for one in compute_standings(methods) if one.steps != steps]
    if nearby:
        lines.append(f"not evaluated at {steps:,} steps, but nearby: {', '.join(nearby)}")
    if any(not has_interval(len(method.agents)) for method in methods):
        has_range = any(_is_few(len(method.agents)) for method in methods)
        range_note = f"; in parentheses: {seed_interval_name(2)}" if has_range else ""
        lines.append(f"a 95 % interval needs at least {min_seeds()} seeds{range_note}")
    return lines


def _is_few(number: int) -> bool:
    """Whether there are several seeds, but too few for an interval."""
    return number > 1 and not has_interval(number)


def _make_panel(methods: Sequence[Method], metric: str, title: str) -> Json:
    series = [make_curve(method.label, *method.values(metric)) for method in methods if method.values(metric)[0].size]
    return {"title": title, "x": "environment steps", "references": [], "series": series}


def compare_methods(methods: Sequence[Method]) -> Json:
    """The probability that a run of the row's method is better than one of the column's, with 95 % intervals.

    An interval is NaN if there are too few seeds for one.
    """
    scores = [one.returns for one in compute_standings(methods)]
    pairs = [[None if a is b else (a, b) for b in scores] for a in scores]
    intervals = [[pair and improvement_interval(*pair) for pair in row] for row in pairs]
    return {
        "labels": [method.label for method in methods],
        "probability": [[pair and probability_of_improvement(*pair) for pair in row] for row in pairs],
        "low": [[interval and interval[0] for interval in row] for row in intervals],
        "high": [[interval and interval[1] for interval in row] for row in intervals],
    }


def _list_common_options(methods: Sequence[Method]) -> list[list[str]]:
    """The options that all methods share."""
    options = [method.agents[0].options for method in methods]
    return [
        [name, str(value)]
        for name, value in options[0].items()
        if name not in SAME_METHOD and all(name in one and one[name] == value for one in options)
    ]
