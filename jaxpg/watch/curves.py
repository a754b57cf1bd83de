"""Learning curves as plain values for the page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxpg.run import figures, results
from jaxpg.run.config import Config
from jaxpg.run.statistics import bootstrap_interval, interquartile_mean

Json = dict[str, Any]
PANELS = {"eval_return": "return", "eval_success": "success rate"}  # metric -> title


def curves(config: Config, lines: Sequence[Json]) -> list[Json]:
    """A panel for return and success: of the settings of a sweep, or while training and of the deterministic policy."""
    panels = []
    for name, title in PANELS.items():
        if config.sweep:
            drawn = [(label, name, chosen) for label, chosen in results.curves(config, lines).items()]
        else:
            drawn = [("deterministic policy", name, slice(None))]
            drawn += [("while training", "return", slice(None))] if name == "eval_return" else []
        found = [curve(label, *figures.series(lines, metric, chosen)) for label, metric, chosen in drawn]
        panels.append({"title": title, "x": "environment steps", "series": [one for one in found if one["steps"]]})
    return [panel for panel in panels if panel["series"]]


def curve(label: str, steps: np.ndarray, values: np.ndarray) -> Json:
    """One curve; of several agents, `[S, K]`, their interquartile mean and its 95 % interval."""
    several = len(values) > 1 and len(steps)
    low, high = bootstrap_interval(values) if several else (None, None)
    return {
        "label": label,
        "steps": steps.tolist(),
        "mean": numbers(interquartile_mean(values)),
        "low": numbers(low) if several else None,
        "high": numbers(high) if several else None,
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
