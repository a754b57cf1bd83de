"""Claim: other people's trainers learn in jaxpg's environments, and jaxpg learns in other people's environments.

    python experiments/plugged_in.py [--only PART ...] [--seeds 3] [--venvs DIR]
    python experiments/plugged_in.py --install | sh

    sb3           Stable-Baselines3's PPO, 61,440 steps with RL Zoo's settings, in Gymnasium's Pendulum-v1 and in
                  jaxpg/Pendulum-v0. Both policies are played in Pendulum-v1, from 200 fixed starts.
    brax_trainer  brax's PPO in this repository's pendulum; the same 200 starts.
    brax          jaxpg's PPO and brax's in brax's reacher (spring physics), 1,000 steps an episode.
    playground    jaxpg's PPO and brax's, with which Playground trains as well, in Playground's CartpoleBalance, where
                  nothing earns more than 1,000.

Everything is trained with the seeds 0, 1, ...; a figure is the mean of the last deterministic policies, with its
standard error over the seeds. What brax's settings are is said in peers/brax_ppo.py and peers/brax_by_name.py. What the
second command prints makes the virtual environments.

Prints a table, and writes what was asked for into results/plugged_in.json.
"""

from __future__ import annotations

import json
import math
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import commands
from commands import Parser, count, write_json

from jaxpg.commands.ending import run_command

ROOT = Path(__file__).parents[1]
PEERS = Path(__file__).parent / "peers"
VENVS = ("plugged_in", "plugged_in_brax")  # each with a requirements file; brax's trainer does not run with jax 0.10
SB3_STEPS = 61_440  # 15 rollouts
BRAX_BUDGET = 300.0  # seconds, of which the greater part is compiling
EARLY = 200_000  # steps after which brax's trainer is looked at, besides its best
EPISODES = 128  # of brax's evaluations and of jaxpg's in the same environments
# Environment: options of `python -m jaxpg.train`, and of brax's PPO.
REACHER = (
    ("env=brax", "env.name=reacher", "env.backend=spring", "algo=ppo", "algo.reward_scale=1", "total_steps=3000000"),
    ("env=reacher", "steps=3000000"),
)
CARTPOLE = (
    ("env=playground", "env.name=CartpoleBalance", "total_steps=2000000"),
    ("env=CartpoleBalance", "steps=2000000"),
)

Row = dict[str, Any]


def ask(interpreter: Path, script: str, *options: str) -> list[dict[str, float]]:
    """Runs a script of experiments/peers; returns what it leaves in the file `out`."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.json"
        subprocess.run(
            [interpreter, PEERS / script, *options, f"out={out}"], check=True, capture_output=True, text=True
        )
        return json.loads(out.read_text(encoding="utf-8"))


def train(interpreter: Path, seeds: int, *options: str) -> list[float]:
    """`python -m jaxpg.train`, and the mean return of each seed's last policy."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        training = [*options, f"num_seeds={seeds}", "report=false", f"run_dir={run}"]
        subprocess.run([interpreter, "-m", "jaxpg.train", *training], check=True, cwd=ROOT)
        evaluation = [f"run={run}", "checkpoint=last", f"episodes={EPISODES}", "json=true"]
        command = [interpreter, "-m", "jaxpg.evaluate", *evaluation]
        outputs = [
            subprocess.run([*command, f"agent={i}"], check=True, cwd=ROOT, capture_output=True, text=True).stdout
            for i in range(seeds)
        ]
    return [json.loads(output.splitlines()[-1])["mean"] for output in outputs]


def figure(returns: list[float]) -> dict[str, Any]:
    """Mean and standard error over the seeds, and what they are of."""
    stderr = statistics.stdev(returns) / math.sqrt(len(returns)) if len(returns) > 1 else math.nan
    return {"mean": round(statistics.mean(returns), 2), "stderr": round(stderr, 2), "seeds": returns}


def sb3(venvs: Path, seeds: int) -> dict[str, Row]:
    found = {}
    for name, env in (("Pendulum-v1", "Pendulum-v1"), ("jaxpg/Pendulum-v0", "jaxpg.gymnasium:jaxpg/Pendulum-v0")):
        options = (f"env={env}", f"steps={SB3_STEPS}")
        curves = [ask(python(venvs, "plugged_in"), "sb3_by_name.py", *options, f"seed={i}") for i in range(seeds)]
        points = [
            {"steps": same[0]["steps"], **figure([point["return"] for point in same])}
            for same in zip(*curves, strict=True)
        ]
        found[f"SB3 PPO, {name}"] = {**figure([curve[-1]["return"] for curve in curves]), "curve": points}
    return found


def brax_trainer(venvs: Path, seeds: int) -> dict[str, Row]:
    options = (f"budget={BRAX_BUDGET}",)
    curves = [ask(python(venvs, "plugged_in_brax"), "brax_ppo.py", *options, f"seed={i}") for i in range(seeds)]
    early = [next(point["return"] for point in curve if point["steps"] >= EARLY) for curve in curves]
    best = [max(point["return"] for point in curve) for curve in curves]
    name = "brax PPO, jaxpg's pendulum"
    return {f"{name}, {EARLY:,} steps": figure(early), f"{name}, best of {curves[0][-1]['steps']:,}": figure(best)}


def brax(venvs: Path, seeds: int) -> dict[str, Row]:
    return side_by_side("brax's reacher", Path(sys.executable), REACHER, venvs, seeds)


def playground(venvs: Path, seeds: int) -> dict[str, Row]:
    return side_by_side("Playground's CartpoleBalance", python(venvs, "plugged_in"), CARTPOLE, venvs, seeds)


def side_by_side(name: str, own: Path, options: tuple, venvs: Path, seeds: int) -> dict[str, Row]:
    """jaxpg's PPO, run by the interpreter `own`, and brax's in the same environment for as many steps."""
    ours, theirs = options
    returns = train(own, seeds, *ours)
    curves = [ask(python(venvs, "plugged_in_brax"), "brax_by_name.py", *theirs, f"seed={i}") for i in range(seeds)]
    return {
        f"jaxpg PPO, {name}": figure(returns),
        f"brax PPO, {name}": figure([curve[-1]["return"] for curve in curves]),
    }


PARTS = {"sb3": sb3, "brax_trainer": brax_trainer, "brax": brax, "playground": playground}


def python(venvs: Path, name: str) -> Path:
    return venvs / name / "bin" / "python"


def results() -> dict[str, Row]:
    """What has been found before."""
    file = commands.RESULTS / "plugged_in.json"
    return json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}


def main(arguments: Sequence[str]) -> None:
    parser = Parser(__doc__)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--seeds", type=count, default=3)
    parser.add_argument("--venvs", type=Path, default=PEERS / ".venvs", help="where the virtual environments are")
    parser.add_argument("--install", action="store_true", help="print the commands that make them, and end")
    options = parser.parse_args(arguments)
    if options.install:
        folders = {venv: options.venvs / venv for venv in VENVS}
        for venv, folder in folders.items():
            print(f"{sys.executable} -m venv {folder} && {folder}/bin/pip install -q -r {PEERS / venv}.txt")
        return
    for part in options.only:
        found = PARTS[part](options.venvs, options.seeds)
        write_json("plugged_in.json", results() | found)
        for name, row in found.items():
            print(f"{name:<45} {row['mean']:8.1f} +- {row['stderr']:.1f}", flush=True)


if __name__ == "__main__":
    run_command(main)
