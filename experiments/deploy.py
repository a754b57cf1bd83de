"""Claim: an exported controller is small and fast, and plays as the policy does that it was made of.

    python experiments/deploy.py

Trains the pendulum by its default command and exports it. Prints, and writes to results/deploy.json:

- the largest difference of each format from JAX on 10,000 observations;
- nanoseconds for one command: the C header in a loop, onnxruntime and JAX called from Python with one observation;
- bytes of the C controller: code and constants of its object file (`size`), and of the stack it takes (-fstack-usage);
- the mean return from the same 200 starts, of each format in each physics: MJX's, C MuJoCo's and Gymnasium's.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from commands import Parser, evaluate, largest_difference, train, write_json

from jaxpg.commands.ending import run_command
from jaxpg.deploy import c, onnx
from jaxpg.deploy.controller import collect_observations, make_command, make_controller
from jaxpg.deploy.exporter import FORMATS
from jaxpg.store import policies

TASK = "pendulum"
POLICIES = ("jax", "c", "onnx")
BACKENDS = ("mjx", "mujoco", "gymnasium")
EPISODES = 200
CALLS = 2_000  # of one measurement from Python
LOOPS = 1_000_000  # of one measurement in C

TIMED = """
#include <stdio.h>
#include <time.h>
#include "policy.h"
int main(void) {
    float observation[POLICY_OBSERVATIONS] = {0}, command[POLICY_COMMANDS];
    struct timespec began, ended;
    timespec_get(&began, TIME_UTC);
    for (int i = 0; i < LOOPS; i++) {
        policy_command(observation, command);
        observation[0] = 0.5f * command[0]; /* the next one waits for this one, and none can be left out */
    }
    timespec_get(&ended, TIME_UTC);
    double seconds = (double)(ended.tv_sec - began.tv_sec) + 1e-9 * (double)(ended.tv_nsec - began.tv_nsec);
    printf("%g %g\\n", seconds, (double)command[0]);
    return 0;
}
"""
ALONE = """
#include "policy.h"
void command(const float *s, float *a);
void command(const float *s, float *a) { policy_command(s, a); }
"""


def nanoseconds(call: Callable[[], Any]) -> float:
    """Of one call, the median of several rounds."""
    call()
    rounds = []
    for _ in range(5):
        began = time.perf_counter()
        for _ in range(CALLS):
            call()
        rounds.append((time.perf_counter() - began) / CALLS)
    return round(1e9 * float(np.median(rounds)))


def in_c(name: str, folder: Path) -> dict[str, Any]:
    """Speed and size of the header in `folder`."""
    texts = {"timed.c": TIMED, "alone.c": ALONE}
    for file, text in texts.items():
        (folder / file).write_text(text.replace("policy", name).replace("POLICY", name.upper()), encoding="utf-8")
    build = [c.find_compiler(), "-O2", "-lm", f"-DLOOPS={LOOPS}", "-o", "timed", "timed.c", "-lm"]
    subprocess.run(build, check=True, cwd=folder)
    runs = [subprocess.run(["./timed"], check=True, capture_output=True, text=True, cwd=folder) for _ in range(5)]
    subprocess.run([c.find_compiler(), "-std=c99", "-Os", "-fstack-usage", "-c", "alone.c"], check=True, cwd=folder)
    sizes = subprocess.run(["size", "alone.o"], check=True, capture_output=True, text=True, cwd=folder).stdout
    text, data, bss, *_ = (int(x) for x in sizes.splitlines()[1].split()[:3])
    stack = max(int(line.split("\t")[1]) for line in (folder / "alone.su").read_text().splitlines())
    return {
        "ns": round(1e9 * float(np.median([float(run.stdout.split()[0]) for run in runs])) / LOOPS),
        "code and constants, bytes": text,
        "variables, bytes": data + bss,
        "stack, bytes": stack,
    }


def main(arguments: Sequence[str] = ()) -> None:
    Parser(__doc__).parse_args(arguments)
    with tempfile.TemporaryDirectory() as place:
        run, folder = Path(place) / "run", Path(place)
        train(run, f"env={TASK}")
        stored = policies.load(str(run))
        control, command = make_controller(stored, {"policy": "an experiment's"}), jax.jit(make_command(stored))
        obs = collect_observations(stored)
        expected, differences = np.asarray(command(obs), np.float64), {}
        for name, way in FORMATS.items():
            way.write(control, folder, command)
            differences[name] = largest_difference(way.load(control, folder)(obs), expected)
        one = obs[:1]
        session = onnx.load(control, folder)
        speed = {"jax": nanoseconds(lambda: np.asarray(command(one))), "onnx": nanoseconds(lambda: session(one))}
        header = in_c(control.name, folder)
        backends = BACKENDS if TASK == "pendulum" else ("mjx",)
        returns = {
            f"{policy}, {backend}": evaluate(run, f"policy={policy}", f"backend={backend}", f"episodes={EPISODES}")[
                "mean"
            ]
            for backend in backends
            for policy in POLICIES
        }
    result = {"differences": differences, "ns": speed | {"c": header.pop("ns")}, "c": header, "returns": returns}
    print(json.dumps(result, indent=1), file=sys.stderr)
    write_json("deploy.json", result)


if __name__ == "__main__":
    run_command(main)
