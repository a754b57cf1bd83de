"""Claim: models step at the speed of hand-written equations, and many times faster than C MuJoCo on all cores.

    python experiments/physics_throughput.py [--envs 1 64 1024 16384] [--repeats 7] [--models pendulum arm ...]

For a pendulum, a two-link arm and a seven-joint arm with and without joint limits, physics steps per second of

    scalar   C MuJoCo's step as scalar equations (envs.physics.compile_step), batched by vmap, on one core
    mjx      vmap(mjx.step); of the seven-joint arm with few environments only, as it makes a few dozen steps a second
    hand     the pendulum's equation of motion, written down, batched by vmap
    mujoco   C MuJoCo's step called from the compiled program, one call for each step of all environments, on all cores
    C        mujoco.rollout on all cores, one call for all steps of all environments

all in one process, one after the other in each round, so that a ratio compares neighbours in time. Prints one table
and writes results/physics_throughput.json: the median of the rounds with the smallest and the largest, seconds to trace
and to compile, and temporary memory in bytes for each environment.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from commands import Parser, count, write_json

import envs
from envs.base import ASSETS
from envs.physics import compile_step, load_spec
from jaxpg.commands.ending import run_command

SECONDS = 0.3  # that one measurement lasts, at least
MJX_PANDAS = 1  # environments up to which mjx.step of the seven-joint arm is measured


def pendulum_by_hand(qpos, qvel, torque):
    """theta'' = 3 g / (2 l) sin(theta) + 3 / (m l^2) tau, by the semi-implicit Euler rule, with Gymnasium's figures."""
    qvel = qvel + 0.05 * (15.0 * jnp.sin(qpos) + 3.0 * torque)
    return qpos + 0.05 * qvel, qvel


def panda(limits: bool) -> mujoco.MjModel:
    spec = load_spec(ASSETS / "panda.xml")
    if not limits:
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    return spec.compile()


def random_states(model: mujoco.MjModel, num_envs: int) -> list[np.ndarray]:
    random = np.random.default_rng(0)
    limit = model.actuator_ctrlrange[:, 1]
    return [
        random.uniform(-1, 1, (num_envs, model.nq)),
        random.uniform(-1, 1, (num_envs, model.nv)),
        0.1 * limit * random.uniform(-1, 1, (num_envs, model.nu)),
    ]


class Compiled:
    """Many steps of a batch in one scan, compiled; `measure` gives the steps per second of one call."""

    def __init__(self, make_step: Callable, model: mujoco.MjModel, num_envs: int, few: bool = False):
        states = [jnp.asarray(x, jnp.float32) for x in random_states(model, num_envs)]
        self.num_envs, self.state, ctrl = num_envs, tuple(states[:2]), states[2]
        began = time.perf_counter()
        step = jax.vmap(make_step())

        def many(state, length):
            return jax.lax.scan(lambda s, _: (step(*s, ctrl), None), state, length=length)[0]

        traced = jax.jit(many, static_argnums=1).trace(self.state, 2)
        self.trace_seconds = time.perf_counter() - began
        began = time.perf_counter()
        compiled = traced.lower().compile()
        self.compile_seconds = time.perf_counter() - began
        self.bytes_per_env = compiled.memory_analysis().temp_size_in_bytes / num_envs
        self.run, self.length = compiled, 2
        if not few:
            rate = max(self.measure() for _ in range(3))
            self.length = max(2, int(rate * SECONDS / num_envs))
            self.run = jax.jit(many, static_argnums=1).lower(self.state, self.length).compile()

    def measure(self) -> float:
        began = time.perf_counter()
        jax.block_until_ready(self.run(self.state))
        return self.num_envs * self.length / (time.perf_counter() - began)


class InC:
    """The same by C MuJoCo, on all cores."""

    trace_seconds = compile_seconds = bytes_per_env = None

    def __init__(self, model: mujoco.MjModel, num_envs: int):
        qpos, qvel, ctrl = random_states(model, num_envs)
        self.model, self.threads = model, os.cpu_count()
        self.datas = [mujoco.MjData(model) for _ in range(self.threads)]
        length = max(2, int(100_000 * SECONDS / num_envs))
        size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        self.initial = np.concatenate([np.zeros((num_envs, 1)), qpos, qvel], 1)
        assert self.initial.shape[1] == size
        self.ctrl = np.repeat(ctrl[:, None], length, 1)
        self.rollout = mujoco.rollout.Rollout(nthread=self.threads)

    def measure(self) -> float:
        began = time.perf_counter()
        self.rollout.rollout(self.model, self.datas, self.initial, self.ctrl)
        return self.ctrl.shape[0] * self.ctrl.shape[1] / (time.perf_counter() - began)


def contestants(name: str, model: mujoco.MjModel, num_envs: int) -> dict[str, Any]:
    few = name.startswith("panda")
    found: dict[str, Any] = {"scalar": Compiled(lambda: compile_step(model), model, num_envs)}
    if not few or num_envs <= MJX_PANDAS:
        found["mjx"] = Compiled(lambda: compile_step(model, physics="mjx"), model, num_envs, few)
    if name == "pendulum":
        found["hand"] = Compiled(lambda: pendulum_by_hand, model, num_envs)
    found["mujoco"] = Compiled(lambda: compile_step(model, physics="mujoco"), model, num_envs)
    return found | {"C": InC(model, num_envs)}


def measure(name: str, model: mujoco.MjModel, num_envs: int, repeats: int) -> list[dict[str, Any]]:
    methods = contestants(name, model, num_envs)
    rates: dict[str, list[float]] = {method: [] for method in methods}
    for _ in range(repeats):
        for method, contestant in methods.items():
            rates[method].append(contestant.measure())
    rows = []
    for method, contestant in methods.items():
        ratios = [a / b for a, b in zip(rates["scalar"], rates[method], strict=True)]
        rows.append(
            {
                "model": name,
                "envs": num_envs,
                "method": method,
                "steps_per_second": statistics.median(rates[method]),
                "slowest": min(rates[method]),
                "fastest": max(rates[method]),
                "scalar_is_faster_by": [min(ratios), statistics.median(ratios), max(ratios)],
                "trace_seconds": contestant.trace_seconds,
                "compile_seconds": contestant.compile_seconds,
                "bytes_per_env": contestant.bytes_per_env,
            }
        )
    return rows


def show(row: dict[str, Any]) -> None:
    low, middle, high = row["scalar_is_faster_by"]
    times = "" if row["trace_seconds"] is None else f"{row['trace_seconds']:7.2f} {row['compile_seconds']:8.2f}"
    memory = "" if row["bytes_per_env"] is None else f"{row['bytes_per_env']:9.0f}"
    print(
        f"{row['model']:18} {row['envs']:6d} {row['method']:7} {row['steps_per_second'] / 1e6:10.4f} "
        f"({row['slowest'] / 1e6:.4f} to {row['fastest'] / 1e6:.4f})  "
        f"{middle:8.1f} ({low:.1f} to {high:.1f}) {times} {memory}",
        flush=True,
    )


MODELS = {
    "pendulum": lambda: envs.make("pendulum").model,
    "arm": lambda: envs.make("arm").model,
    "panda": lambda: panda(limits=False),
    "panda with limits": lambda: panda(limits=True),
}


def main(arguments: Sequence[str]) -> None:
    parser = Parser(__doc__)
    parser.add_argument("--envs", type=count, nargs="+", default=[1, 64, 1024, 16_384])
    parser.add_argument("--repeats", type=count, default=7)
    parser.add_argument("--models", nargs="+", default=list(MODELS), choices=MODELS)
    options = parser.parse_args(arguments)
    print(
        "model, environments, method, M steps/s (range), scalar is faster by (range), s to trace, to compile, bytes/env"
    )
    rows = []
    for name in options.models:
        for num_envs in options.envs:
            found = measure(name, MODELS[name](), num_envs, options.repeats)
            rows += found
            for row in found:
                show(row)
    write_json("physics_throughput.json", rows)


if __name__ == "__main__":
    run_command(main)
