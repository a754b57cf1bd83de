"""Claim: REINFORCE with a learned value as baseline learns both tasks; TD does so from fewer steps.

    python experiments/reinforce_and_td.py

Five seeds of each algorithm on the pendulum and on the arm, with the tuned defaults of each and the same number of
environment steps. Writes results/reinforce_and_td.png (interquartile mean and 95 % bootstrap interval of the
deterministic policy) and results/reinforce_and_td.json.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from commands import Parser, learning_curve, train, write_figure, write_json
from matplotlib.figure import Figure

from jaxpg.commands.ending import run_command

NUM_SEEDS = 5
ALGORITHMS = {"td": "TD(lambda)", "reinforce": "REINFORCE, value baseline"}
TASKS = {
    "pendulum": ("eval_return", "return", 6_000_000),
    "arm": ("eval_success", "success within 5 cm", 8_000_000),
}


def main(arguments: Sequence[str] = ()) -> None:
    Parser(__doc__).parse_args(arguments)
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    summary = {}
    with tempfile.TemporaryDirectory() as folder:
        for axes, (task, (metric, ylabel, total_steps)) in zip(
            figure.subplots(1, len(TASKS), squeeze=False)[0], TASKS.items(), strict=True
        ):
            for algo, label in ALGORITHMS.items():
                run = Path(folder) / f"{task}-{algo}"
                train(run, f"env={task}", f"algo={algo}", f"num_seeds={NUM_SEEDS}", f"total_steps={total_steps}")
                summary[f"{task} {algo}"] = learning_curve(axes, run, metric, label)
            axes.set(title=task, xlabel="environment steps", ylabel=ylabel)
            axes.grid(alpha=0.3)
            axes.legend(loc="lower right", fontsize=8)
    write_figure("reinforce_and_td.png", figure)
    write_json("reinforce_and_td.json", summary)


if __name__ == "__main__":
    run_command(main)
