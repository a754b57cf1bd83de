"""Compares methods for a paper: curves as a vector figure, a table as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxpg.store.statistics import has_interval, interquartile_mean, seed_interval, seed_interval_name
from jaxpg.watch.curves import PANELS
from jaxpg.watch.figures import COLORS
from jaxpg.watch.methods import Method, compute_standings

if TYPE_CHECKING:
    from matplotlib.typing import RcKeyType

WIDTH, HEIGHT = 3.4, 2.6  # of a panel [inch]: one column of a paper
# Methods also differ in dashes and marks, so that the figure can be read without colours.
DASHES = ("-", "--", "-.", ":")
MARKS = ("o", "s", "^", "D", "v", "P", "X")
NUM_MARKS = 8  # on a curve
STYLE: dict[RcKeyType, Any] = {
    "pdf.fonttype": 42,  # TrueType fonts, as publishers require
    "svg.fonttype": "path",  # letters as outlines: the same everywhere
    "svg.hashsalt": "jaxpg",  # the same file from the same runs
    "font.size": 8,
    "legend.fontsize": 7,
}
NO_DATE = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}


def draw_figure(methods: Sequence[Method], form: str) -> bytes:
    """The learning curves as a vector figure with embedded fonts, readable without colours.

    Args:
      methods: the methods; several seeds are drawn as interquartile mean and `seed_interval`.
      form: "pdf" or "svg".
    """
    import matplotlib
    from matplotlib.figure import Figure

    metrics = [metric for metric in PANELS if any(method.values(metric)[0].size for method in methods)]
    buffer = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH * len(metrics), HEIGHT), layout="constrained")
        for axes, metric in zip(figure.subplots(1, len(metrics), squeeze=False)[0], metrics, strict=True):
            _draw(axes, methods, metric)
        figure.savefig(buffer, format=form, metadata=NO_DATE[form])
    return buffer.getvalue()


def _draw(axes: Any, methods: Sequence[Method], metric: str) -> None:
    axes.set(xlabel="environment steps", ylabel=PANELS[metric])
    axes.grid(alpha=0.3, linewidth=0.5)
    for i, method in enumerate(methods):
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
        markevery=max(1, size // NUM_MARKS),
        markersize=3,
        linewidth=1.2,
    )
    line.set_label(f"{label}\n({number} seeds, {seed_interval_name(number)})" if number > 1 else f"{label} (1 seed)")
    if number > 1:
        axes.fill_between(steps, *seed_interval(values), color=color, alpha=0.15, linewidth=0)


def format_csv(methods: Sequence[Method]) -> str:
    """A line for each method, best first: interquartile means over its seeds, and their 95 % intervals.

    An interval is empty if there are too few seeds for one, and success if the environment does not report it.
    """
    names = [f"{metric}{end}" for metric in ("return", "success") for end in ("", "_low", "_high")]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["method", "seeds", "environment_steps", *names])
    for one in compute_standings(methods):
        numbers = [*_list_interval(one.returns), *_list_interval(one.success)]
        writer.writerow([one.method.label, len(one.method.agents), one.steps, *numbers])
    return text.getvalue()


def _list_interval(values: np.ndarray | None) -> list[float | str]:
    """Interquartile mean, lower and upper end."""
    if values is None:
        return ["", "", ""]
    ends = [float(end) for end in seed_interval(values)] if has_interval(len(values)) else ["", ""]
    return [float(interquartile_mean(values)), *ends]
