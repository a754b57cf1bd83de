"""Figures of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, BinaryIO

import numpy as np

from jaxpg.store.statistics import interquartile_mean, seed_interval, seed_interval_name

# Colours of the curves, the same as on the page of the run (jaxpg/watch/page/page.css).
COLORS = ("#0072b2", "#d55e00", "#009e73", "#b35c93", "#c78500", "#3f9fd8", "#4a525c")


def draw_learning_curve(lines: Sequence[dict[str, Any]], file: BinaryIO, title: str) -> None:
    """Draws the return, and the success rate if there is one, over environment steps.

    Args:
      lines: lines of `metrics.jsonl`; lists, one value per agent, are drawn as interquartile mean and `seed_interval`.
      file: takes the PNG.
      title: title of the figure.
    """
    figure, panels = _make_panels(lines, title)
    for name, axes in panels.items():
        draw_curve(axes, *select_series(lines, name), "deterministic policy")
    draw_curve(panels["eval_return"], *select_series(lines, "return"), "while training")
    for axes in panels.values():
        axes.legend()
    figure.savefig(file, dpi=120)


def draw_sweep_curves(
    lines: Sequence[dict[str, Any]], file: BinaryIO, title: str, settings: Mapping[str, slice]
) -> None:
    """As `draw_learning_curve`, for the deterministic policies of a sweep: one curve per setting.

    Args:
      lines, file, title: as in `draw_learning_curve`.
      settings: label -> agents, in the order of the legend.
    """
    figure, panels = _make_panels(lines, f"{title}, deterministic policy")
    for name, axes in panels.items():
        for label, agents in settings.items():
            _draw(axes, *select_series(lines, name, agents), label)
    number = max(agents.stop - agents.start for agents in settings.values())
    handles, labels = panels["eval_return"].get_legend_handles_labels()
    caption = f"interquartile mean of {number} seeds,\n{seed_interval_name(number)}" if number > 1 else None
    legend = figure.legend(handles, labels, loc="outside right center", title=caption, fontsize=8, title_fontsize=8)
    # The legend goes next to the panels, which keep their size.
    figure.set_figwidth(figure.get_figwidth() + legend.get_window_extent().width / figure.dpi)
    figure.savefig(file, dpi=120)


def _make_panels(lines: Sequence[dict[str, Any]], title: str) -> tuple[Any, dict[str, Any]]:
    """An empty figure, and its axes by metric."""
    from matplotlib.figure import Figure

    ylabels = {"eval_return": "return"}
    if any("eval_success" in line for line in lines):
        ylabels["eval_success"] = "success rate"
    figure = Figure(figsize=(6.4 * len(ylabels), 4.2), layout="constrained")
    panels = dict(zip(ylabels, figure.subplots(1, len(ylabels), squeeze=False)[0], strict=True))
    for name, axes in panels.items():
        axes.set(xlabel="environment steps", ylabel=ylabels[name])
        axes.set_prop_cycle(linestyle=["-"] * len(COLORS) + ["--"] * len(COLORS), color=2 * COLORS)
        axes.grid(alpha=0.3)
    figure.suptitle(title)
    return figure, panels


def select_series(
    lines: Sequence[dict[str, Any]], name: str, agents: slice = slice(None)
) -> tuple[np.ndarray, np.ndarray]:
    """Steps `[K]` and values `[S, K]` of the lines in which all of the agents have a value."""
    points = [(line["steps"], np.atleast_1d(line[name])[agents]) for line in lines if name in line]
    points = [(steps, values) for steps, values in points if all(value is not None for value in values)]
    if not points:
        return np.zeros(0), np.zeros((1, 0))
    return np.array([steps for steps, _ in points]), np.array([values for _, values in points], float).T


def draw_curve(axes: Any, steps: np.ndarray, values: np.ndarray, label: str) -> None:
    """Draws one curve; for several agents, their interquartile mean with its `seed_interval`."""
    _draw(axes, steps, values, f"{label}: {_describe_seeds(len(values))}" if len(values) > 1 and len(steps) else label)


def _draw(axes: Any, steps: np.ndarray, values: np.ndarray, label: str) -> None:
    (line,) = axes.plot(steps, interquartile_mean(values), label=label)
    if len(values) > 1 and len(steps):
        axes.fill_between(steps, *seed_interval(values), color=line.get_color(), alpha=0.2, linewidth=0)


def _describe_seeds(number: int) -> str:
    return f"interquartile mean of {number} seeds, {seed_interval_name(number)}"
