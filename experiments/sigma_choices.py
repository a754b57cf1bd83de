"""What sigma may be: a constant, a parameter that is learned, a function of the state.

    python experiments/sigma_choices.py

TD(lambda) on the pendulum with its tuned defaults, five seeds of each choice. Left: return of the deterministic policy
(interquartile mean and 95 % bootstrap interval). Right: the mean of sigma over the states that were visited.

Writes results/sigma_choices.png and results/sigma_choices.json.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from commands import Parser, learning_curve, train, write_figure, write_json
from matplotlib.figure import Figure

from jaxpg.commands.ending import run_command

TASK = "pendulum"
NUM_SEEDS = 5
TOTAL_STEPS = 5_000_000
CHOICES = {
    "fixed, 1": ("network.sigma_is=fixed", "network.sigma=1.0"),
    "fixed, 0.3": ("network.sigma_is=fixed", "network.sigma=0.3"),
    "learned, from 1": ("network.sigma_is=learned", "network.sigma=1.0"),
    "learned, from 0.3": ("network.sigma_is=learned", "network.sigma=0.3"),
    "of the state, from 1": ("network.sigma_is=state", "network.sigma=1.0"),
}


def main(arguments: Sequence[str] = ()) -> None:
    Parser(__doc__).parse_args(arguments)
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    summary = {}
    with tempfile.TemporaryDirectory() as folder:
        for number, (label, options) in enumerate(CHOICES.items()):
            run = Path(folder) / str(number)
            train(run, f"env={TASK}", "algo=td", f"num_seeds={NUM_SEEDS}", f"total_steps={TOTAL_STEPS}", *options)
            summary[label] = {
                "return": learning_curve(left, run, "eval_return", label),
                "sigma": learning_curve(right, run, "sigma", label),
            }
    left.set(ylabel="return of the deterministic policy")
    right.set(ylabel="sigma", yscale="log")
    for axes in (left, right):
        axes.set(xlabel="environment steps")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    write_figure("sigma_choices.png", figure)
    write_json("sigma_choices.json", summary)


if __name__ == "__main__":
    run_command(main)
