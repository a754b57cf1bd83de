"""Time to solve the pendulum: jaxpg and other libraries, turn by turn on the same machine, played by the same rule.

    python experiments/time_to_solve.py [--seeds 3] [--only NAME ...] [--venvs DIR]
    python experiments/time_to_solve.py --install | sh

Each contestant trains from a cold process (experiments/peers/*.py) and shows its deterministic policy every half second
of training, later every 2 % of its time. The figure of all is the mean return over 200 fixed starts of Gymnasium's
Pendulum-v1, `reset(seed=i)` for i = 0 to 199, from which the best possible is -140.6 (dynamic programming on a grid).
Evaluations are off the clock.

    stable-baselines3  PPO and A2C with RL Zoo's tuned settings for Pendulum-v1
    rejax              PPO with its repository's settings for Pendulum-v1
    brax               PPO on this repository's MJX pendulum, with settings found by hand: brax ships none for it
    RLtools            SAC, the example of its Python package, with MKL; needs g++ and Python's headers

jaxpg keeps what XLA compiles; its row "second time" is a process that finds it. The others keep nothing by themselves.
Their dependencies conflict: each has its own virtual environment, made by what the second command prints; a contestant
without one is left out. Training ends with the contestant's own number of steps or after its `budget` of seconds.
All take turns: seed 0 of everyone, seed 1 of everyone, ...; then the plain command `python -m jaxpg.train` is run once
for each row of jaxpg's, and its last policy evaluated in Gymnasium itself, to be compared with the end of the curve.

Prints a table (median over seeds) and writes results/time_to_solve.json and results/time_to_solve.png.
"""

from __future__ import annotations

import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from commands import Parser, count, evaluate, train, write_figure, write_json
from matplotlib.figure import Figure

from jaxpg.commands.ending import run_command

ROOT = Path(__file__).parents[1]
PEERS = Path(__file__).parent / "peers"
TARGETS = (-200, -160, -150, -145)
BEST_POSSIBLE = -140.6  # from the 200 starts
JAXPG = {"PPO": ("algo=ppo",), "TD": ("algo=td",)}


@dataclass(frozen=True)
class Contestant:
    """One row of the table.

    Attributes:
      name: in table and figure.
      script: in experiments/peers.
      budget: seconds from the start of the process after which it stops, evaluations not counted.
      venv: its virtual environment and requirements file; None is the interpreter that runs this.
      options: of the script.
      again: the process finds what an earlier one of the same kind has compiled; else its cache folder is empty.
    """

    name: str
    script: str
    budget: float
    venv: str | None = None
    options: tuple[str, ...] = ()
    again: bool = False


CONTESTANTS = [
    *(Contestant(f"jaxpg {name}", "own.py", 60, options=options) for name, options in JAXPG.items()),
    Contestant("jaxpg PPO, second time", "own.py", 60, options=JAXPG["PPO"], again=True),
    Contestant("RLtools SAC", "rltools_sac.py", 60, "rltools"),
    Contestant("SB3 PPO", "sb3.py", 90, "sb3", ("algo=ppo",)),
    Contestant("SB3 A2C", "sb3.py", 120, "sb3", ("algo=a2c",)),
    Contestant("brax PPO", "brax_ppo.py", 100, "brax"),
    Contestant("rejax PPO", "rejax_ppo.py", 50, "rejax"),
]


def interpreter(contestant: Contestant, venvs: Path) -> Path:
    """Its Python; where there is none, it has not been installed."""
    return Path(sys.executable) if contestant.venv is None else venvs / contestant.venv / "bin" / "python"


def install_command(venv: str, venvs: Path) -> str:
    folder = venvs / venv
    return f"{sys.executable} -m venv {folder} && {folder}/bin/pip install -q -r {PEERS / venv}.txt"


def run(contestant: Contestant, python: Path, seed: int) -> list[dict[str, float]]:
    """One training from a cold process; returns its learning curve, empty where it failed."""
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"XDG_CACHE_HOME": folder}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        out = Path(folder) / "curve.json"
        if contestant.again:
            train(Path(folder) / "before", "env=pendulum", *contestant.options, environment=environment)
        options = [f"seed={seed}", f"budget={contestant.budget}", f"out={out}", *contestant.options]
        command = [python, PEERS / contestant.script, *options, f"started={time.time()}"]
        try:
            limit = 3 * contestant.budget + 60  # real time, evaluations included
            done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=limit, check=False)
            if done.returncode:
                print(f"{contestant.name}, seed {seed}: failed, {(done.stderr.splitlines() or ['?'])[-1]}")
        except subprocess.TimeoutExpired:
            print(f"{contestant.name}, seed {seed}: stopped after {limit:.0f} s of real time")
        return json.loads(out.read_text(encoding="utf-8")) if out.exists() else []


def reached(curve: list[dict[str, float]], target: float) -> dict[str, float]:
    """The first point of the curve that is as good as the target; infinitely far where there is none."""
    missing = dict.fromkeys(("steps", "seconds_training", "seconds_since_process_start"), math.inf)
    return next((point for point in curve if point["return"] >= target), missing)


def median(curves: list[list[dict[str, float]]], target: float, name: str) -> float:
    return statistics.median(reached(curve, target)[name] for curve in curves)


def cell(curves: list[list[dict[str, float]]], target: float) -> str:
    seconds = median(curves, target, "seconds_since_process_start")
    if math.isinf(seconds):
        return f"not within {statistics.median(curve[-1]['seconds_since_process_start'] for curve in curves):.0f} s"
    training, steps = median(curves, target, "seconds_training"), median(curves, target, "steps")
    return f"{seconds:.1f} s ({training:.1f} s), {steps:,.0f} steps"


def table(results: dict[Contestant, list[list[dict[str, float]]]]) -> str:
    """Markdown: seconds from the start of the process, in brackets of training alone, and environment steps."""
    lines = ["| | start-up | " + " | ".join(map(str, TARGETS)) + " | best |", "|---" * (len(TARGETS) + 3) + "|"]
    for contestant, curves in results.items():
        if curves:
            startup = statistics.median(curve[0]["compile_seconds"] for curve in curves)
            best = statistics.median(max(point["return"] for point in curve) for curve in curves)
            cells = [cell(curves, target) for target in TARGETS]
            lines.append(f"| {contestant.name} | {startup:.1f} s | " + " | ".join(cells) + f" | {best:.1f} |")
    return "\n".join(lines)


def draw(results: dict[Contestant, list[list[dict[str, float]]]]) -> Figure:
    """Return against seconds from the start of the process: median and range of the seeds."""
    figure = Figure(figsize=(8, 4.6), layout="constrained")
    axes = figure.subplots()
    for contestant, curves in results.items():
        if curves:
            seconds, values = on_common_times(curves)
            (line,) = axes.plot(seconds, np.median(values, axis=0), label=contestant.name)
            axes.fill_between(seconds, values.min(0), values.max(0), color=line.get_color(), alpha=0.2, linewidth=0)
    axes.axhline(BEST_POSSIBLE, color="black", linestyle=":", linewidth=1, label="best possible")
    axes.set(xscale="log", ylim=(-420, -130), xlabel="seconds from the start of the process, compiling included")
    axes.set_ylabel("mean return from 200 starts, Pendulum-v1")
    axes.grid(alpha=0.3, which="both")
    axes.legend(loc="lower left", fontsize=8)
    return figure


def on_common_times(curves: list[list[dict[str, float]]], number: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Times `[number]` at which all seeds have been seen, and each seed's last return until then, `[S, number]`."""
    times = [np.array([point["seconds_since_process_start"] for point in curve]) for curve in curves]
    seconds = np.geomspace(max(t[0] for t in times), max(t[-1] for t in times), number)
    latest = [np.searchsorted(t, seconds, "right") - 1 for t in times]
    values = [np.array([point["return"] for point in curve]) for curve in curves]
    return seconds, np.stack([value[index] for value, index in zip(values, latest, strict=True)])


def plain_commands() -> dict[str, dict[str, Any]]:
    """`python -m jaxpg.train` with seed 0 as a user runs it, and its last policy in Gymnasium."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, options in JAXPG.items():
            place = Path(folder) / name
            seconds = train(place, "env=pendulum", "seed=0", *options)
            last = evaluate(place, "episodes=200", "backend=gymnasium", "checkpoint=last")
            found[f"jaxpg {name}"] = {"seconds": round(seconds, 1), "mean": last["mean"], "stderr": last["stderr"]}
    return found


def summary(results: dict[Contestant, list[list[dict[str, float]]]], plain: dict[str, Any]) -> dict[str, Any]:
    names = ("steps", "seconds_since_process_start", "return")
    rows = {
        contestant.name: {
            "budget": contestant.budget,
            "compile_seconds": [curve[0]["compile_seconds"] for curve in curves],
            "curves": [{name: [point[name] for point in curve] for name in names} for curve in curves],
        }
        for contestant, curves in results.items()
    }
    return {"cores": os.cpu_count(), "contestants": rows, "plain commands": plain}


def compete(contestants: list[Contestant], seeds: int, venvs: Path) -> dict[Contestant, list[list[dict[str, float]]]]:
    """The learning curves of those that are installed, by taking turns."""
    results: dict[Contestant, list[list[dict[str, float]]]] = {}
    for contestant in contestants:
        if interpreter(contestant, venvs).exists():
            results[contestant] = []
        else:
            print(f"{contestant.name} is left out; to install it: {install_command(contestant.venv, venvs)}")
    for seed in range(seeds):
        for contestant, curves in results.items():
            curve = run(contestant, interpreter(contestant, venvs), seed)
            curves += [curve] if curve else []
            best = max((point["return"] for point in curve), default=math.nan)
            print(f"seed {seed}, {contestant.name}: {len(curve)} evaluations, best {best:.1f}", flush=True)
    return results


def main(arguments: Sequence[str]) -> None:
    parser = Parser(__doc__)
    parser.add_argument("--seeds", type=count, default=3)
    parser.add_argument("--only", nargs="+", choices=[contestant.name for contestant in CONTESTANTS])
    parser.add_argument("--venvs", type=Path, default=PEERS / ".venvs", help="where the peers' environments are")
    parser.add_argument("--install", action="store_true", help="print the commands that install the peers, and end")
    options = parser.parse_args(arguments)
    chosen = [contestant for contestant in CONTESTANTS if contestant.name in (options.only or contestant.name)]
    if options.install:
        venvs = dict.fromkeys(contestant.venv for contestant in chosen if contestant.venv)
        print("\n".join(install_command(venv, options.venvs) for venv in venvs))
        return
    results = compete(chosen, options.seeds, options.venvs)
    print("\nseconds from the start of the process (training alone), environment steps\n")
    print(table(results))
    write_figure("time_to_solve.png", draw(results))
    plain = plain_commands() if options.only is None else {}
    for name, found in plain.items():
        print(f"{name}, the plain command, seed 0: {found['seconds']} s, {found['mean']:.1f} in Gymnasium at the end")
    write_json("time_to_solve.json", summary(results, plain))


if __name__ == "__main__":
    run_command(main)
