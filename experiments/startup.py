"""Claim: the default command compiles once; from then on it starts in seconds.

    python experiments/startup.py

Runs `python -m jaxpg.train env=pendulum` in a fresh process with an empty cache folder, once more with the folder that
it left, and evaluates the policy twice in the same way. Prints where the time goes, wall-clock and of the processor,
and writes results/startup.json. Wall-clock needs a machine that does nothing else.
"""

from __future__ import annotations

import json
import operator
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from commands import Parser, write_json

from jaxpg.commands.ending import run_command

ARGUMENTS = ("env=pendulum",)
MEASURED = "--measured"  # a process of this script that is the command, and notes where its time goes
# Phases by what is called in them, of `jaxpg`.
PHASES = {
    "options": ("config.parsing.compose",),
    "environment": ("run.session._make_env",),
    "tracing and compiling": ("run.session._compile",),
    "evaluations": ("run.loop._evaluate",),
    "checkpoints": ("store.keeper.Keeper.__init__", "store.keeper.Keeper.save"),
    "figure": ("watch.closing.draw_learning_curve",),
}
TRACING = ("jaxpr_trace_duration", "jaxpr_to_mlir_module_duration")
PROGRAMS = {name for program in ("init", "advance", "play") for name in (program, f"jit({program})")}


def main(arguments: Sequence[str] = ()) -> None:
    Parser(__doc__).parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"XDG_CACHE_HOME": f"{folder}/cache"}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        runs = {}
        for name in ("cold", "warm"):
            runs[f"train, {name}"] = measure(environment, Path(folder) / name, *ARGUMENTS, f"run_dir={folder}/{name}")
        for name in ("cold", "warm"):
            runs[f"evaluate, {name}"] = evaluate(environment, f"{folder}/warm")
    show(runs)
    write_json("startup.json", {name: rounded(phases) for name, phases in runs.items()})


def measure(environment: dict[str, str], folder: Path, *arguments: str) -> dict[str, Any]:
    """Phase -> [seconds, of them of the processor] of a training command, measured in its own process."""
    report = folder.with_suffix(".json")
    began, cpu_began = time.monotonic(), cpu()
    subprocess.run(
        [sys.executable, __file__, MEASURED, str(report), str(began), *arguments], env=environment, check=True
    )
    whole = [time.monotonic() - began, cpu() - cpu_began]
    return {**json.loads(report.read_text(encoding="utf-8")), "whole process": whole}


def evaluate(environment: dict[str, str], folder: str) -> dict[str, Any]:
    began, cpu_began = time.monotonic(), cpu()
    command = [sys.executable, "-m", "jaxpg.evaluate", f"run={folder}"]
    subprocess.run(command, env=environment, check=True, capture_output=True)
    return {"whole process": [time.monotonic() - began, cpu() - cpu_began]}


def rounded(phases: dict[str, list[float]]) -> dict[str, dict[str, float]]:
    return {
        phase: {"seconds": round(seconds, 2), "processor": round(processor, 2)}
        for phase, (seconds, processor) in phases.items()
    }


def cpu() -> float:
    """Processor seconds of the processes that have ended."""
    times = os.times()
    return times.children_user + times.children_system


def show(runs: dict[str, Any]) -> None:
    for name, phases in runs.items():
        print(f"\n{name:<32}seconds  processor")
        for phase, (seconds, processor) in phases.items():
            print(f"  {phase:<30}{seconds:7.2f}    {processor:7.2f}")


# --- in the measured process ------------------------------------------------------------------------------------------


class Stopwatch:
    """Adds up the time spent in functions, by phase."""

    def __init__(self, began: float):
        self.began = began
        self.phases: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])

    def now(self) -> list[float]:
        return [time.monotonic() - self.began, time.process_time()]

    def add(self, phase: str, since: list[float]) -> None:
        for i, (now, then) in enumerate(zip(self.now(), since, strict=True)):
            self.phases[phase][i] += now - then

    def watch(self, owner: Any, name: str, phase: str) -> None:
        """Replaces a function by the same, timed."""
        function = getattr(owner, name)

        def timed(*arguments, **options):
            since = self.now()
            try:
                return function(*arguments, **options)
            finally:
                self.add(phase, since)

        setattr(owner, name, timed)


def measured(report: str, began: float, arguments: list[str]) -> int:
    """The training command with its phases timed."""
    watch = Stopwatch(began)
    import jaxpg
    import jaxpg.watch.closing  # and with it all that PHASES names
    from jaxpg.commands.train import main as train
    from jaxpg.run import session
    from jaxpg.store.metrics_log import MetricsLog

    watch.add("imports", [0.0, 0.0])
    _listen(watch)
    for phase, names in PHASES.items():
        for name in names:
            owner, _, leaf = name.rpartition(".")
            watch.watch(operator.attrgetter(owner)(jaxpg), leaf, phase)
    written = MetricsLog.write

    def first(log, line):
        if "from the command to the first line of metrics" not in watch.phases:
            watch.add("from the command to the first line of metrics", [0.0, 0.0])
        written(log, line)

    MetricsLog.write = first
    watch.watch(session, "_train", "updates and all else")
    status = train(arguments)
    for phase in ("evaluations", "checkpoints", "figure"):
        _take(watch.phases, "updates and all else", phase)
    Path(report).write_text(json.dumps(watch.phases), encoding="utf-8")
    return status


def _listen(watch: Stopwatch) -> None:
    """Tracing by itself, as jax reports it; it has no figure for the processor."""
    import jax

    def note(event: str, seconds: float, **details: Any) -> None:
        if event.rpartition("/")[2] in TRACING and details.get("fun_name") in PROGRAMS:
            watch.phases["of it tracing"][0] += seconds
            watch.phases["of it tracing"][1] += seconds

    jax.monitoring.register_event_duration_secs_listener(note)


def _take(phases: dict[str, list[float]], whole: str, part: str) -> None:
    phases[whole] = [a - b for a, b in zip(phases[whole], phases[part], strict=True)]


if __name__ == "__main__":
    if sys.argv[1:2] == [MEASURED]:
        sys.exit(measured(sys.argv[2], float(sys.argv[3]), sys.argv[4:]))
    run_command(main)
