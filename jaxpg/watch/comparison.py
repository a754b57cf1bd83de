"""Several runs side by side, as a page, a figure or a table: which method is better, and how sure that is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from jaxpg.errors import UserError
from jaxpg.store import folder, results
from jaxpg.store.statistics import (
    has_interval,
    improvement_interval,
    min_seeds,
    probability_of_improvement,
    seed_interval_name,
)
from jaxpg.watch import publication
from jaxpg.watch.curves import PANELS, curve, finite
from jaxpg.watch.methods import SAME_METHOD, Method, compared_at, methods, standings, task
from jaxpg.watch.page import page

Json = dict[str, Any]
MOST = 10  # methods with a colour of their own
COLUMNS = ["method", "return", "success rate", "seeds", "environment steps"]


def write(paths: Sequence[str], out: Path, say: Callable[[str], None]) -> None:
    """Writes these run folders side by side, in the form that the ending of `out` says, and says what the table says.

    Raises:
      UserError: as `methods`; another ending; or the file cannot be written.
    """
    form = _form(out)
    found = methods(paths)
    folder.replace(out, form(found))
    rows = [columns(found), *table(found)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        say("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    for line in notes(found):
        say(f"note: {line}")
    say(str(out))


def _form(out: Path) -> Callable[[Sequence[Method]], str | bytes]:
    """What writes methods down as the ending says."""
    forms: dict[str, Callable[[Sequence[Method]], str | bytes]] = {
        ".html": lambda found: page(comparison(found)),
        ".pdf": lambda found: publication.figure(found, "pdf"),
        ".svg": lambda found: publication.figure(found, "svg"),
        ".csv": publication.csv_table,
    }
    if out.suffix.lower() not in forms:
        raise UserError(f"out={out}: must end in {', '.join(forms)}: a page, a figure or a table")
    return forms[out.suffix.lower()]


def comparison(found: Sequence[Method]) -> Json:
    """What the page shows of some methods, as plain values."""
    shown, whose = found[:MOST], f"{len(found)} methods" if len(found) > 1 else found[0].label
    rows = [{"title": "methods, the best first", "columns": columns(found), "rows": table(found), "note": None}]
    data = {
        "kind": "comparison",
        "title": f"{whose} on {task(found[0].agents[0])}",
        "facts": [["score", f"return of the evaluation at {compared_at(found):,} environment steps"]],
        "head": None,
        "notes": notes(found),
        "curves": [panel for panel in (_panel(shown, *metric) for metric in PANELS.items()) if panel["series"]],
        "diagnostics": [],
        "tables": rows,
        "improvement": improvement(shown) if len(shown) > 1 else None,
        **{"player": None, "portrait": None, "workspace": None, "command": None},
        "configuration": _common(found),
        "versions": [],
    }
    return finite(data)


def columns(found: Sequence[Method]) -> list[str]:
    """The titles of `table`."""
    return [name for name in COLUMNS if name != "success rate" or _has_success(found)]


def table(found: Sequence[Method]) -> list[list[str]]:
    """A row for each method: what `columns` says, with several seeds as `results.format_score` shows them."""
    rows = []
    for one in standings(found):
        rate = "" if one.success is None else results.format_score(100 * one.success) + " %"
        number = str(len(one.method.agents))
        rows.append([one.method.label, results.format_score(one.returns), rate, number, f"{one.steps:,}"])
    return rows if _has_success(found) else [[*row[:2], *row[3:]] for row in rows]


def _has_success(found: Sequence[Method]) -> bool:
    return any(method.values("eval_success")[0].size for method in found)


def notes(found: Sequence[Method]) -> list[str]:
    """What one has to know of the table, a line each: steps that are not equal, seeds that carry no interval."""
    lines, steps = [], compared_at(found)
    longer = [f"{method.label} went on to {method.longest:,}" for method in found if method.longest > steps]
    if longer:
        lines.append(f"compared at {steps:,} environment steps, the most that all have reached; {', '.join(longer)}")
    apart = [f"{one.method.label} at {one.steps:,}" for one in standings(found) if one.steps != steps]
    if apart:
        lines.append(f"not evaluated at {steps:,} steps, but near it: {', '.join(apart)}")
    if any(not has_interval(len(method.agents)) for method in found):
        around = f"; in parentheses: {seed_interval_name(2)}" if any(_is_few(len(one.agents)) for one in found) else ""
        lines.append(f"fewer than {min_seeds()} seeds carry no 95 % interval{around}")
    return lines


def _is_few(number: int) -> bool:
    """Whether so many seeds differ, but carry no interval."""
    return number > 1 and not has_interval(number)


def _panel(found: Sequence[Method], metric: str, title: str) -> Json:
    series = [curve(method.label, *method.values(metric)) for method in found if method.values(metric)[0].size]
    return {"title": title, "x": "environment steps", "references": [], "series": series}


def improvement(found: Sequence[Method]) -> Json:
    """How probable it is that a run of the method of a row is better than one of the column's, with 95 % intervals.

    An interval is NaN where the seeds are too few for one.
    """
    scores = [one.returns for one in standings(found)]
    pairs = [[None if a is b else (a, b) for b in scores] for a in scores]
    intervals = [[pair and improvement_interval(*pair) for pair in row] for row in pairs]
    return {
        "labels": [method.label for method in found],
        "probability": [[pair and probability_of_improvement(*pair) for pair in row] for row in pairs],
        "low": [[interval and interval[0] for interval in row] for row in intervals],
        "high": [[interval and interval[1] for interval in row] for row in intervals],
    }


def _common(found: Sequence[Method]) -> list[list[str]]:
    """The options that are the same in all methods."""
    every = [method.agents[0].options for method in found]
    return [
        [name, str(value)]
        for name, value in every[0].items()
        if name not in SAME_METHOD and all(name in one and one[name] == value for one in every)
    ]
