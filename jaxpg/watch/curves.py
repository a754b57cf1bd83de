"""Learning curves as plain values for the page."""

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
# Means over the updates between two lines of metrics, where the algorithm has such a thing.
DIAGNOSTICS = {
    "kl": "KL divergence of an update",
    "entropy": "entropy of the policy",
    "sigma": "standard deviation of the policy",
    "value_loss": "value loss",
    "gradient_norm": "norm of the gradient",
}
POLICY, TRAINING = "deterministic policy", "while training"


def curves(config: Config, lines: Sequence[Json], references: Mapping[str, float]) -> list[Json]:
    """A panel for return and success: of the settings of a sweep, or while training and of the deterministic policy.

    Args:
      config, lines: of the run.
      references: returns to compare with, by what they are.
    """
    panels = []
    for name, title in PANELS.items():
        drawn = [(label, name, chosen) for label, chosen in _agents(config, lines, POLICY).items()]
        if not config.sweep and name == "eval_return":
            drawn.append((TRAINING, "return", slice(None)))
        panels.append(_panel(title, [curve(label, *figures.series(lines, *which)) for label, *which in drawn]))
    panels[0]["references"] = [{"label": label, "value": value} for label, value in references.items()]
    return [panel for panel in panels if panel["series"]]


def diagnostics(config: Config, lines: Sequence[Json]) -> list[Json]:
    """A panel for each of `DIAGNOSTICS` that was measured: of the settings of a sweep, or of the one there is."""
    agents = _agents(config, lines, TRAINING)
    found = [
        _panel(title, [curve(label, *figures.series(lines, name, chosen)) for label, chosen in agents.items()])
        for name, title in DIAGNOSTICS.items()
    ]
    return [panel for panel in found if panel["series"]]


def _agents(config: Config, lines: Sequence[Json], otherwise: str) -> dict[str, slice]:
    """The agents of each curve by its label."""
    return results.select_curves(config, lines) if config.sweep else {otherwise: slice(None)}


def _panel(title: str, series: Sequence[Json]) -> Json:
    return {
        "title": title,
        "x": "environment steps",
        "references": [],
        "series": [one for one in series if one["steps"]],
    }


def curve(label: str, steps: np.ndarray, values: np.ndarray) -> Json:
    """One curve; of several agents, `[S, K]`, their interquartile mean and its `seed_interval`."""
    several = len(values) > 1 and len(steps)
    low, high = seed_interval(values) if several else (None, None)
    return {
        "label": label,
        "steps": steps.tolist(),
        "mean": numbers(interquartile_mean(values)),
        "low": numbers(low) if several else None,
        "high": numbers(high) if several else None,
        "band": f"{len(values)} seeds, {seed_interval_name(len(values))}" if several else None,
    }


def numbers(values: np.ndarray) -> list[Any]:
    """Nested lists of numbers with four digits: pictures need no more."""
    return np.vectorize(lambda x: float(f"{x:.4g}"), otypes=[float])(values).tolist()


def finite(value: Any) -> Any:
    """The same nested values, with None for every number that is not finite, as JSON has none."""
    if isinstance(value, dict):
        return {name: finite(x) for name, x in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(x) for x in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
