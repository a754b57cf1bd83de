"""Methods side by side for a paper: their curves as a vector figure, their table as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxpg.store.statistics import has_interval, interquartile_mean, seed_interval, seed_interval_name
from jaxpg.watch.curves import PANELS
from jaxpg.watch.figures import COLORS
from jaxpg.watch.methods import Method, standings

WIDTH, HEIGHT = 3.4, 2.6  # of a panel [inch]: one column of a paper
# A method is told by its dashes and marks as well, so that it can be read without colours.
DASHES = ("-", "--", "-.", ":")
MARKS = ("o", "s", "^", "D", "v", "P", "X")
MARKED = 8  # points of a curve with a mark
STYLE = {
    "pdf.fonttype": 42,  # whole TrueType fonts, as publishers ask for
    "svg.fonttype": "path",  # letters as outlines: the same everywhere
    "svg.hashsalt": "jaxpg",  # the same file from the same runs
    "font.size": 8,
    "legend.fontsize": 7,
}
NO_DATE = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}


def figure(found: Sequence[Method], form: str) -> bytes:
    """The learning curves as a vector figure with its fonts in it, readable without colours.

    Args:
      found: the methods; several seeds are drawn as their interquartile mean and `seed_interval`.
      form: "pdf" or "svg".
    """
    import matplotlib
    from matplotlib.figure import Figure

    shown = [metric for metric in PANELS if any(method.values(metric)[0].size for method in found)]
    buffer = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        drawn = Figure(figsize=(WIDTH * len(shown), HEIGHT), layout="constrained")
        for axes, metric in zip(drawn.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
            _draw(axes, found, metric)
        drawn.savefig(buffer, format=form, metadata=NO_DATE[form])
    return buffer.getvalue()


def _draw(axes: Any, found: Sequence[Method], metric: str) -> None:
    axes.set(xlabel="environment steps", ylabel=PANELS[metric])
    axes.grid(alpha=0.3, linewidth=0.5)
    for i, method in enumerate(found):
        steps, values = method.values(metric)
        if steps.size:
            _draw_method(axes, i, method.label, steps, values)
    axes.legend(frameon=False)


def _draw_method(axes: Any, i: int, label: str, steps: np.ndarray, values: np.ndarray) -> None:
    color, (number, size) = COLORS[i % len(COLORS)], values.shape
    (line,) = axes.plot(
        *(steps, interquartile_mean(values)),
        color=color,
        linestyle=DASHES[i % len(DASHES)],
        marker=MARKS[i % len(MARKS)],
        markevery=max(1, size // MARKED),
        markersize=3,
        linewidth=1.2,
    )
    line.set_label(f"{label}\n({number} seeds, {seed_interval_name(number)})" if number > 1 else f"{label} (1 seed)")
    if number > 1:
        axes.fill_between(steps, *seed_interval(values), color=color, alpha=0.15, linewidth=0)


def csv_table(found: Sequence[Method]) -> str:
    """A line for each method, the best first: interquartile means over its seeds, and their 95 % intervals.

    The ends of an interval are empty where the seeds are too few for one; success where the environment does not say.
    """
    names = [f"{metric}{end}" for metric in ("return", "success") for end in ("", "_low", "_high")]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["method", "seeds", "environment_steps", *names])
    for one in standings(found):
        numbers = [*_with_interval(one.returns), *_with_interval(one.success)]
        writer.writerow([one.method.label, len(one.method.agents), one.steps, *numbers])
    return text.getvalue()


def _with_interval(values: np.ndarray | None) -> list[float | str]:
    """Interquartile mean, lower and upper end."""
    if values is None:
        return ["", "", ""]
    ends = [float(end) for end in seed_interval(values)] if has_interval(len(values)) else ["", ""]
    return [float(interquartile_mean(values)), *ends]
