"""Steps per second of one of EnvPool's tasks, measured at each line of standard input, as lines of JSON.

    python envpool_steps.py task=HalfCheetah-v4 envs=1024 threads=2 seconds=0.7

Under random actions that were drawn beforehand, with all environments in one batch (synchronous), and in two and four
batches of which some are always being stepped: {"1": steps/s, "2": ..., "4": ...}.
"""

from __future__ import annotations

from protocol import parse

NAMES = ("task", "envs", "threads", "seconds")
OPTIONS = parse(NAMES, needed=NAMES)  # before the imports, which take a while

import json  # noqa: E402
import sys  # noqa: E402
import time  # noqa: E402
from typing import Any  # noqa: E402

import envpool  # noqa: E402
import numpy as np  # noqa: E402

NUM_BATCHES = (1, 2, 4)
NUM_ACTIONS = 64  # drawn for each environment


class Steps:
    """A task's environments, in so many batches."""

    def __init__(self, num_batches: int):
        num_envs, threads = int(OPTIONS["envs"]), int(OPTIONS["threads"])
        self.size, self.is_divided = num_envs // num_batches, num_batches > 1
        sizes = {"num_envs": num_envs, "batch_size": self.size, "num_threads": threads}
        self.env: Any = envpool.make(OPTIONS["task"], env_type="gymnasium", **sizes)
        shape = (NUM_ACTIONS, self.size, *self.env.action_space.shape)
        self.actions = np.random.default_rng(0).uniform(-1, 1, shape)
        self.count = 0
        if self.is_divided:
            self.env.async_reset()
        else:
            self.env.reset()

    def step(self) -> None:
        actions = self.actions[self.count % NUM_ACTIONS]
        self.count += 1
        if self.is_divided:
            self.env.send(actions, self.env.recv()[-1]["env_id"])
        else:
            self.env.step(actions)

    def measure(self) -> float:
        began, first = time.perf_counter(), self.count
        while time.perf_counter() - began < float(OPTIONS["seconds"]):
            self.step()
        return (self.count - first) * self.size / (time.perf_counter() - began)


if __name__ == "__main__":
    ways = {number: Steps(number) for number in NUM_BATCHES}
    for _ in sys.stdin:
        print(json.dumps({number: way.measure() for number, way in ways.items()}), flush=True)
