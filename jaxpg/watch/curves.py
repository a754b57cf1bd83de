"""Data of learning curves for the page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxpg.config.configuration import Config
from jaxpg.store import results
from jaxpg.store.statistics import interquartile_mean, seed_interval, seed_interval_name
from jaxpg.watch import figures

Json = dict[str, Any]
PANELS = {"eval_return": "return", "eval_success": "success rate"}  # metric -> title
# Means over the updates between two lines of metrics, if the algorithm reports them.
DIAGNOSTICS = {
    "kl": "KL divergence of an update",
    "entropy": "entropy of the policy",
    "sigma": "standard deviation of the policy",
    "value_loss": "value loss",
    "gradient_norm": "norm of the gradient",
}
POLICY, TRAINING = "deterministic policy", "while training"


def make_curves(config: Config, lines: Sequence[Json], references: Mapping[str, float]) -> list[Json]:
    """Panels for return and success: for the settings of a sweep, or during training and of the deterministic policy.

    Args:
      config, lines: configuration and metrics of the run.
      references: label -> return to compare with.
    """
    panels = []
    for name, title in PANELS.items():
        entries = [(label, (name, agents)) for label, agents in _select_agents(config, lines, POLICY).items()]
        if not config.sweep and name == "eval_return":
            entries.append((TRAINING, ("return", slice(None))))
        panels.append(
            _make_panel(title, [make_curve(label, *figures.select_series(lines, *which)) for label, which in entries])
        )
    panels[0]["references"] = [{"label": label, "value": value} for label, value in references.items()]
    return [panel for panel in panels if panel["series"]]


def make_diagnostics(config: Config, lines: Sequence[Json]) -> list[Json]:
    """A panel for each of the `DIAGNOSTICS` in the metrics, with a curve for each setting of a sweep."""
    agents = _select_agents(config, lines, TRAINING)
    panels = [
        _make_panel(
            title,
            [make_curve(label, *figures.select_series(lines, name, selected)) for label, selected in agents.items()],
        )
        for name, title in DIAGNOSTICS.items()
    ]
    return [panel for panel in panels if panel["series"]]


def _select_agents(config: Config, lines: Sequence[Json], label: str) -> dict[str, slice]:
    """The agents of each curve by its label."""
    return results.select_curves(config, lines) if config.sweep else {label: slice(None)}


def _make_panel(title: str, series: Sequence[Json]) -> Json:
    return {
        "title": title,
        "x": "environment steps",
        "references": [],
        "series": [one for one in series if one["steps"]],
    }


def make_curve(label: str, steps: np.ndarray, values: np.ndarray) -> Json:
    """One curve; for several agents, `[S, K]`, their interquartile mean and its `seed_interval`."""
    interval = seed_interval(values) if len(values) > 1 and len(steps) else None
    return {
        "label": label,
        "steps": steps.tolist(),
        "mean": round_numbers(interquartile_mean(values)),
        "low": round_numbers(interval[0]) if interval else None,
        "high": round_numbers(interval[1]) if interval else None,
        "band": f"{len(values)} seeds, {seed_interval_name(len(values))}" if interval else None,
    }


def round_numbers(values: np.ndarray) -> list[Any]:
    """Nested lists of numbers rounded to four digits, enough for pictures."""
    return np.vectorize(lambda x: float(f"{x:.4g}"), otypes=[float])(values).tolist()


def replace_nonfinite(value: Any) -> Any:
    """The nested values with None for numbers that are not finite, which JSON lacks."""
    if isinstance(value, dict):
        return {name: replace_nonfinite(x) for name, x in value.items()}
    if isinstance(value, (list, tuple)):
        return [replace_nonfinite(x) for x in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
