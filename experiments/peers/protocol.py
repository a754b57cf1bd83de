"""What every contestant of experiments/time_to_solve.py has in common; numpy is all it needs.

A contestant is run as `python NAME.py seed=0 budget=60 out=FILE [started=SECONDS] [algo=...]` by its own interpreter.
It trains through its library's public interface and now and then hands its deterministic policy to a `Recorder`, which
stops the clock, plays the policy in `play` (Gymnasium's Pendulum-v1, 200 fixed starts) and writes `out`: a list of

    {"steps", "seconds_training", "seconds_since_process_start", "compile_seconds", "return"}

Both clocks leave out the evaluations; `compile_seconds` is all before the first update: imports, tracing, compiling.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np

NUM_STARTS = 200
EPISODE_LENGTH = 200
SPEED_LIMIT, TORQUE_LIMIT, DT = 8.0, 2.0, 0.05
RECORDERS = ("out", "budget", "started")  # options
INTERVAL = 0.5, 0.02  # between two evaluations, at least: seconds of training, and part of all seconds so far

Act = Callable[[np.ndarray], Any]  # observations [N, 3] in float32 -> torques [N] or [N, 1], in N m


def starts() -> np.ndarray:
    """(theta, theta') of `gymnasium.make("Pendulum-v1").reset(seed=i)` for i = 0, 1, ...; `[NUM_STARTS, 2]`."""
    high = np.array([np.pi, 1.0])
    return np.stack([np.random.Generator(np.random.PCG64(i)).uniform(-high, high) for i in range(NUM_STARTS)])


def observe(state: np.ndarray) -> np.ndarray:
    theta, speed = state.T
    return np.stack([np.cos(theta), np.sin(theta), speed], axis=1).astype(np.float32)


def step(state: np.ndarray, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gymnasium's Pendulum-v1 for all rows at once: next states `[N, 2]` and rewards `[N]`."""
    theta, speed = state.T
    torque = np.clip(torque, -TORQUE_LIMIT, TORQUE_LIMIT)
    angle = np.mod(theta + np.pi, 2 * np.pi) - np.pi
    reward = -(angle**2 + 0.1 * speed**2 + 0.001 * torque**2)
    speed = np.clip(speed + DT * (15.0 * np.sin(theta) + 3.0 * torque), -SPEED_LIMIT, SPEED_LIMIT)
    return np.stack([theta + DT * speed, speed], axis=1), reward


def play(act: Act) -> np.ndarray:
    """Returns of one episode from each of the fixed starts, `[NUM_STARTS]`."""
    state, total = starts(), np.zeros(NUM_STARTS)
    for _ in range(EPISODE_LENGTH):
        torque = np.asarray(act(observe(state)), np.float64).reshape(NUM_STARTS)
        state, reward = step(state, torque)
        total += reward
    return total


class Recorder:
    """The clock of one training, and its learning curve.

    Args:
      out: the file that is rewritten with every evaluation.
      budget: seconds since the start of the process, without evaluations, after which `over` is true.
      started: when the process started, by `time.time()`.
    """

    def __init__(self, out: str | Path, budget: float, started: float):
        self._out, self._budget, self._started = Path(out), budget, started
        self._paused = self._last = 0.0
        self.compile_seconds: float | None = None
        self.curve: list[dict[str, float]] = []

    @property
    def seconds(self) -> float:
        """Since the start of the process, without evaluations."""
        return time.time() - self._started - self._paused

    @property
    def over(self) -> bool:
        return self.seconds > self._budget

    @property
    def due(self) -> bool:
        """Whether it is time for the next evaluation."""
        return self.seconds - self._last >= max(INTERVAL[0], INTERVAL[1] * self.seconds)

    def ready(self) -> None:
        """Everything is imported and compiled: training begins."""
        self.compile_seconds = self._last = self.seconds

    def look(self, steps: int, act: Act) -> None:
        """Plays the policy after `steps` environment steps, with the clock stopped."""
        seconds = self.seconds
        mean = float(play(act).mean())
        point = {"steps": int(steps), "seconds_since_process_start": round(seconds, 3), "return": round(mean, 2)}
        self.curve.append(point)
        self.write()
        self._last = seconds
        self._paused += self.seconds - seconds

    def write(self) -> None:
        """Writes the curve; the training alone is what is left of the time without `compile_seconds`."""
        compiling = round(self.compile_seconds or 0.0, 3)
        lines = []
        for point in self.curve:
            training = round(point["seconds_since_process_start"] - compiling, 3)
            lines.append(point | {"compile_seconds": compiling, "seconds_training": training})
        self._out.write_text(json.dumps(lines, indent=1) + "\n", encoding="utf-8")


def parse(known: Collection[str] | None, needed: Collection[str]) -> dict[str, str]:
    """The options of the command line by name, before anything slow is imported.

    `--help` prints what the script says of itself and ends; an argument of another form, a name that is not known
    (None: all are) and one that is needed and missing end in one line and status 2.
    """
    doc, arguments = sys.modules["__main__"].__doc__ or "", sys.argv[1:]
    if {"--help", "-h"} & set(arguments):
        print(doc.strip())
        sys.exit(0)
    options = dict(argument.split("=", 1) for argument in arguments if "=" in argument)
    wrong = [argument for argument in arguments if "=" not in argument]
    wrong += [name for name in options if known is not None and name not in known]
    missing = [f"{name}=..." for name in needed if name not in options]
    if wrong or missing:
        reason = f"unknown argument '{wrong[0]}'" if wrong else f"{missing[0]} is missing"
        print(f"error: {reason}; --help says more", file=sys.stderr)
        sys.exit(2)
    return options


def begin(names: Collection[str] | None = None, needed: Collection[str] = ()) -> tuple[dict[str, str], Recorder]:
    """The options of the command line, and a recorder made of them.

    Args:
      names: of the script's own options beside the recorder's and `seed`; None: any may be given.
      needed: of these, such as have no default.
    """
    options = parse(None if names is None else (*RECORDERS, "seed", *names), ("out", *needed))
    started = float(options.get("started", time.time()))
    return options, Recorder(options["out"], float(options.get("budget", "inf")), started)
