"""Claim: a run takes no more memory after an hour than after a minute, and is stopped within seconds.

    python experiments/endurance.py [--seconds 3600] [OPTION=VALUE ...]

Trains the pendulum with its default options for 10^9 environment steps or an hour, whichever ends first, reads the
process's resident memory every few seconds, and asks it to stop by SIGTERM. Prints the growth after the first minute,
and writes results/endurance.json and results/endurance.png.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from commands import Parser, duration, write_figure, write_json
from matplotlib.figure import Figure

from jaxpg.commands.ending import run_command
from jaxpg.config.parsing import compose
from jaxpg.store.folder import RunFolder, read_metrics

WARM_UP = 1 / 60  # of the time; compiling and the first evaluation and checkpoint are over by then
SAMPLES = 360
TASK = "pendulum"


def resident(process: int) -> float:
    """Resident memory of a process in MB."""
    lines = Path(f"/proc/{process}/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1024


def train(folder: Path, seconds: float, options: list[str]) -> dict[str, Any]:
    """Memory and steps of a run that is stopped after `seconds` of training."""
    run = RunFolder(folder)
    arguments = [f"env={TASK}", "total_steps=1000000000", *options, f"run_dir={folder}"]
    command = [sys.executable, "-m", "jaxpg.train", *arguments]
    when, memory = [], []
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        while not (run.metrics.exists() and run.metrics.stat().st_size) and process.poll() is None:
            time.sleep(0.1)
        began = time.monotonic()
        while (elapsed := time.monotonic() - began) < seconds and process.poll() is None:
            when.append(round(elapsed, 1))
            memory.append(round(resident(process.pid), 1))
            time.sleep(seconds / SAMPLES)
        asked = time.monotonic()
        process.send_signal(signal.SIGTERM)
        status = process.wait()
        stopped = time.monotonic() - asked
    assert status in (0, 128 + signal.SIGTERM), status
    last = read_metrics(run)[-1]
    return {
        "seconds": when,
        "resident, MB": memory,
        "steps": last["steps"],
        "training, s": last["seconds"],
        "SIGTERM to exit, s": round(stopped, 2),
        "best return": max(line["eval_return"] for line in read_metrics(run) if "eval_return" in line),
    }


def draw(result: dict[str, Any]) -> Figure:
    figure = Figure(figsize=(6.4, 3.2), layout="constrained")
    axes = figure.subplots()
    axes.plot(np.array(result["seconds"]) / 60, result["resident, MB"])
    axes.set(xlabel="minutes of training", ylabel="resident memory, MB", ylim=(0, None))
    axes.set_title(f"{result['steps']:,} environment steps of {TASK}")
    axes.grid(alpha=0.3)
    return figure


def main(arguments: Sequence[str]) -> None:
    parser = Parser(__doc__)
    parser.add_argument("--seconds", type=duration, default=3600)
    parser.add_argument("options", nargs="*", metavar="OPTION=VALUE")
    given = parser.parse_args(arguments)
    compose([f"env={TASK}", *given.options])  # a mistake in one of them is said here
    with tempfile.TemporaryDirectory() as folder:
        result = train(Path(folder) / "run", given.seconds, given.options)
    when, memory = np.array(result["seconds"]), np.array(result["resident, MB"])
    first, *_, last = memory[when >= WARM_UP * given.seconds]
    print(f"{result['steps']:,} steps; {first:.1f} MB after {WARM_UP * given.seconds:.0f} s, {last:.1f} MB at the end")
    print(f"largest {memory.max():.1f} MB; ended {result['SIGTERM to exit, s']} s after SIGTERM")
    write_json("endurance.json", result)
    write_figure("endurance.png", draw(result))


if __name__ == "__main__":
    run_command(main)
