"""Claim: a run ends seconds after it is asked to, and its checkpoints cost next to nothing.

    python experiments/robustness.py

Sends SIGTERM at random moments of the default runs of the pendulum and of the arm, and measures the seconds until the
process has saved and ended. Then trains both longer with the default intervals, and adds up the time spent in saving.
Writes results/robustness.json. `pytest -m faults tests/faults` has the hundred kills and the two hundred damages.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from commands import Parser, train, write_json
from startup import measure

from jaxpg.commands.ending import run_command
from jaxpg.store.folder import RunFolder, read_metrics

TASKS = {"pendulum": ("env=pendulum",), "arm": ("env=arm",)}
STOPS = 10
STEPS = 5_000_000


def seconds_to_exit(folder: Path, arguments: tuple[str, ...], fraction: float) -> float:
    """From SIGTERM, sent after a fraction of the run's time to its end, to the end of the process.

    Args:
      folder: of a new run.
      arguments: of the training.
      fraction: of the run's steps, in [0, 1).
    """
    command = [sys.executable, "-m", "jaxpg.train", *arguments, f"run_dir={folder}"]
    log = RunFolder(folder).metrics
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        while process.poll() is None and not (log.exists() and log.read_bytes().count(b"\n") >= 1 + fraction * 5):
            time.sleep(0.005)
        time.sleep(0.3 * fraction)
        began = time.monotonic()
        process.send_signal(signal.SIGTERM)
        status = process.wait()
        seconds = time.monotonic() - began
    assert status == 128 + signal.SIGTERM, status
    return seconds


def stops(folder: Path, arguments: tuple[str, ...]) -> dict[str, Any]:
    train(folder / "compiled", *arguments, "total_steps=1")
    moment = random.Random(0)
    seconds = [seconds_to_exit(folder / f"stop-{i}", arguments, moment.random()) for i in range(STOPS)]
    return {"stops": STOPS, "median, s": round(median(seconds), 2), "worst, s": round(max(seconds), 2)}


def saving(folder: Path, arguments: tuple[str, ...]) -> dict[str, Any]:
    """The share of the training that is spent in saving, and what it was of."""
    phases = measure(
        dict(os.environ), folder / "long", *arguments, f"total_steps={STEPS}", f"run_dir={folder / 'long'}"
    )
    training = read_metrics(RunFolder(folder / "long"))[-1]["seconds"]
    saved, _ = phases["checkpoints"]
    return {"steps": STEPS, "training, s": training, "saving, s": round(saved, 2), "share": round(saved / training, 4)}


def main(arguments: Sequence[str] = ()) -> None:
    Parser(__doc__).parse_args(arguments)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = f"{folder}/cache"
        for task, arguments in TASKS.items():
            (Path(folder) / task).mkdir()
            rows.append({"task": task} | stops(Path(folder) / task, arguments) | saving(Path(folder) / task, arguments))
            print(rows[-1], flush=True)
    write_json("robustness.json", rows)


if __name__ == "__main__":
    run_command(main)
