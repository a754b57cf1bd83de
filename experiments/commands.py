"""The project's commands as the experiments run them."""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxpg.errors import UserError
from jaxpg.store.folder import RunFolder, read_metrics
from jaxpg.store.statistics import bootstrap_interval, interquartile_mean
from jaxpg.watch.figures import draw_curve, select_series

RESULTS = Path(__file__).parent / "results"


class Parser(argparse.ArgumentParser):
    """Of an experiment's arguments. `--help` prints what the script says of itself; a mistake is one line.

    Args:
      doc: the script's docstring.
    """

    def __init__(self, doc: str):
        form = argparse.RawDescriptionHelpFormatter
        super().__init__(description=doc, formatter_class=form, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        """Raises UserError, of which `run_command` makes the line."""
        raise UserError(f"{message}; {self.prog} --help says more")


def count(text: str) -> int:
    """A whole number from 1 on, as the type of an argument."""
    if not (text.isascii() and text.isdigit() and int(text)):
        raise argparse.ArgumentTypeError(f"{text}: expected a whole number, at least 1")
    return int(text)


def duration(text: str) -> float:
    """Seconds, as the type of an argument."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0 < seconds < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: expected seconds, above 0")
    return seconds


def largest_difference(found: np.ndarray, expected: np.ndarray) -> float:
    """max |a - b| / max(1, |b|): absolute for small commands, relative for large ones; NaN if there is one.

    >>> largest_difference(np.array([1.5, 200.0]), np.array([1.0, 100.0]))
    1.0
    """
    return float(np.max(np.abs(found - expected) / np.maximum(1, np.abs(expected))))


def train(folder: Path, *arguments: str, environment: dict[str, str] | None = None) -> float:
    """Runs `python -m jaxpg.train` into `folder`; returns the seconds from start to end of the process."""
    began = time.monotonic()
    command = [sys.executable, "-m", "jaxpg.train", *arguments, f"run_dir={folder}"]
    subprocess.run(command, check=True, env=environment)
    return time.monotonic() - began


def evaluate(folder: Path, *arguments: str) -> dict[str, Any]:
    """Runs `python -m jaxpg.evaluate` on `folder`; returns what it found."""
    command = [sys.executable, "-m", "jaxpg.evaluate", f"run={folder}", "json=true", *arguments]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return json.loads(output.splitlines()[-1])


def learning_curve(axes: Axes, folder: Path, metric: str, label: str) -> dict[str, Any]:
    """Draws a metric of the run in `folder` over its steps; returns what was drawn, for `write_json`."""
    steps, values = select_series(read_metrics(RunFolder(folder)), metric)
    draw_curve(axes, steps, values, label)
    low, high = bootstrap_interval(values)
    return {
        "metric": metric,
        "seeds": len(values),
        "steps": steps.tolist(),
        "interquartile_mean": interquartile_mean(values).round(3).tolist(),
        "low": low.round(3).tolist(),
        "high": high.round(3).tolist(),
    }


def write_figure(name: str, figure: Figure) -> None:
    RESULTS.mkdir(exist_ok=True)
    figure.savefig(RESULTS / name, dpi=110)


def write_json(name: str, content: Any) -> None:
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / name).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
