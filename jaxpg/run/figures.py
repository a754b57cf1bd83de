"""Pictures of a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxpg.run.statistics import bootstrap_interval, interquartile_mean


def learning_curve(lines: Sequence[dict[str, Any]], path: Path, title: str) -> None:
    """Return, and success where there is one, over environment steps.

    Args:
      lines: of `metrics.jsonl`; values of several agents are lists, drawn as interquartile mean and 95 % interval.
      path: the PNG to write.
      title: above the picture.
    """
    from matplotlib.figure import Figure

    panels = [("return", [("return", "while training"), ("eval_return", "deterministic policy")])]
    if any("eval_success" in line for line in lines):
        panels.append(("success rate", [("eval_success", "deterministic policy")]))
    figure = Figure(figsize=(6.4 * len(panels), 4.2), layout="constrained")
    for axes, (ylabel, curves) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        for name, label in curves:
            draw_curve(axes, *series(lines, name), label)
        axes.set(xlabel="environment steps", ylabel=ylabel)
        axes.grid(alpha=0.3)
        axes.legend()
    figure.suptitle(title)
    figure.savefig(path, dpi=120)


def series(lines: Sequence[dict[str, Any]], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps `[K]` and values `[S, K]` of the lines where every agent has a value."""
    points = [(line["steps"], np.atleast_1d(line[name])) for line in lines if name in line]
    points = [(steps, values) for steps, values in points if all(value is not None for value in values)]
    if not points:
        return np.zeros(0), np.zeros((1, 0))
    return np.array([steps for steps, _ in points]), np.array([values for _, values in points], float).T


def draw_curve(axes: Any, steps: np.ndarray, values: np.ndarray, label: str) -> None:
    """One curve; of several agents their interquartile mean with its 95 % bootstrap interval."""
    (line,) = axes.plot(steps, interquartile_mean(values), label=label)
    if len(values) > 1 and len(steps):
        line.set_label(f"{label}: interquartile mean of {len(values)} seeds, 95 % interval")
        axes.fill_between(steps, *bootstrap_interval(values), color=line.get_color(), alpha=0.2, linewidth=0)
