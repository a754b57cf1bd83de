"""Claim: the default commands solve the pendulum and the arm in minutes on two cores.

    python experiments/default_runs.py [pendulum] [arm]

Pendulum: the default run for seeds 0 to 9, TD(lambda) and TD(0) for seeds 0 to 4, each evaluated over 200 and over
1,000 episodes of Gymnasium's own Pendulum-v1; from its first 200 starts the best possible mean return is -140.6, from
its first 1,000 -135.7 (dynamic programming on a grid of angle and speed). Arm: the default run for seeds 0 to 2, and
one run for each kind of control, plane and reward, each evaluated over 500 episodes. Writes
results/default_runs_pendulum.json and results/default_runs_arm.json.
"""

from __future__ import annotations

import itertools
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

from commands import Parser, evaluate, train, write_json

from envs.options import describe_unknown
from jaxpg.commands.ending import run_command

PENDULUM_RUNS = {"default": ((), 10), "TD": (("algo=td",), 5), "TD(0)": (("algo=td", "algo.lambda_=0"), 5)}  # seeds
ARM_RUNS = [{"seed": str(seed)} for seed in range(3)] + [
    {"env.control": control, "env.gravity": gravity, "env.reward": reward}
    for control, gravity, reward in itertools.product(("torque", "velocity"), ("false", "true"), ("lesson", "precise"))
    if (control, gravity, reward) != ("torque", "false", "precise")
]


def pendulum(folder: Path) -> None:
    rows = []
    for name, (options, seeds) in PENDULUM_RUNS.items():
        for seed in range(seeds):
            run = folder / f"pendulum-{name}-{seed}"
            seconds = train(run, "env=pendulum", f"seed={seed}", *options)
            found = evaluate(run, "episodes=200", "backend=gymnasium")
            more = evaluate(run, "episodes=1000", "backend=gymnasium")
            row = {"run": name, "seed": seed, "seconds": round(seconds, 1), **found}
            rows.append(row | {"mean_of_1000": more["mean"], "stderr_of_1000": more["stderr"]})
            print(rows[-1], flush=True)
    write_json("default_runs_pendulum.json", rows)


def arm(folder: Path) -> None:
    rows = []
    for number, options in enumerate(ARM_RUNS):
        run = folder / f"arm-{number}"
        seconds = train(run, "env=arm", *(f"{name}={value}" for name, value in options.items()))
        found = evaluate(run, "episodes=500")
        closer = evaluate(run, "episodes=500", "env.success_radius=0.02")
        success = {"within_5cm": found["success"], "within_2cm": closer["success"]}
        rows.append(
            {**options, "seconds": round(seconds, 1), **success, "mean": found["mean"], "stderr": found["stderr"]}
        )
        print(rows[-1], flush=True)
    write_json("default_runs_arm.json", rows)


TASKS = {"pendulum": pendulum, "arm": arm}


def main(arguments: Sequence[str]) -> None:
    parser = Parser(__doc__)
    parser.add_argument("tasks", nargs="*", metavar="TASK", help=" or ".join(TASKS))
    tasks = parser.parse_args(arguments).tasks or list(TASKS)
    for task in tasks:
        if task not in TASKS:
            parser.error(describe_unknown("task", task, TASKS))
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder  # the first run of each kind compiles, whatever was run before
        for task in tasks:
            TASKS[task](Path(folder))


if __name__ == "__main__":
    run_command(main)
