"""Claim: robots as they are published step faster as scalar equations than in C MuJoCo on all cores.

    python experiments/robots.py [robots=FOLDER] [FILE ...] [--envs 1024] [--steps 50] [--rounds 5] [--memory]

For every model file (by default those of envs/assets; with `robots=FOLDER` all that are in it), environment steps per
second of

    ours    compile_step of the model, batched by vmap and divided over CPU devices, one for each core
    floor   C MuJoCo's step called from the compiled program, one call for each step of all environments
    C       mujoco.batch and mujoco.rollout on all cores, one call for all steps of all environments: the faster one

with the model's own settings, from a keyframe or else the initial position, with random velocities of 0.1 rad/s or m/s.
Every solver starts from the acceleration of the last step. Controls are random, and held: over the whole range of each
actuator ("all"), or within 5 % of it around those of the keyframe, or else the middle ("calm"). Meshes collide on
neither side. One process; in each round one after the other, so that a ratio compares neighbours in time. What may
touch beyond the contacts of the equations is left to C MuJoCo: the share of such steps is counted on C MuJoCo's own
motion. Also: by how much positions differ from C MuJoCo's at the end of all steps (median of the environments and 99 %
of them), and how much faster ours is for each second of a core's time, which a busy machine hardly changes.

Bytes for each environment are those that the compiled loop wants beside the states. With `--memory` each model is also
traced and compiled in a process of its own, whose largest resident memory (Linux) is printed: before, when libraries
and the model are loaded, and after.

Prints one table and writes results/robots.json: medians of the rounds with the smallest and the largest.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import mujoco.rollout
import numpy as np
from commands import Parser, count, write_json
from measuring import CORES, divide_cpu, summarise, time_calls

from envs.base import ASSETS
from envs.physics import (
    MujocoModelError,
    change_collision,
    compile_model,
    compile_step,
    describe,
    divide_batch,
    load_spec,
    scalarize,
)
from envs.physics.dynamics.bounds import choose_bounds
from envs.physics.dynamics.choice import choose_pairs, count_points
from envs.physics.dynamics.forward import find_positions
from envs.physics.dynamics.watch import may_touch
from envs.physics.models import find_control_ranges, import_mjx, put_model
from envs.physics.pairs import candidate_pairs
from envs.physics.step import WARMSTART
from jaxpg.commands.ending import run_command
from jaxpg.errors import UserError

STATUS = Path("/proc/self/status")  # of a process, on Linux
SECONDS = 0.3  # that one measurement lasts, at least
FOLDER = "robots="
CONTROLS = {"all": 1.0, "calm": 0.05}  # which part of each actuator's range is drawn from
WATCHED_ENVS = 64  # environments of which steps that are left to C MuJoCo are counted
METHODS = ("ours", "floor", "C")


# --- states and controls ----------------------------------------------------------------------------------------------


def make_states(model: mujoco.MjModel, num_envs: int) -> dict[str, np.ndarray]:
    """Positions, velocities and activations of all environments: those of a keyframe, with random velocities."""
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    states = {name: np.tile(getattr(data, name), (num_envs, 1)) for name in ("qpos", "qvel", "act")}
    states["qvel"] += 0.1 * np.random.default_rng(0).normal(size=states["qvel"].shape)
    return states


def make_controls(model: mujoco.MjModel, num_envs: int, share: float) -> np.ndarray:
    """Random controls from a share of each actuator's range, around its middle or where the keyframe has it."""
    low, high = find_control_ranges(model)
    middle = model.key_ctrl[0] if model.nkey and share < 1 else (low + high) / 2
    random = np.random.default_rng(1).uniform(-0.5, 0.5, (num_envs, model.nu))
    return np.clip(middle + share * (high - low) * random, low, high)


# --- what is measured -------------------------------------------------------------------------------------------------


class Compiled:
    """Many steps of a batch in one scan, divided over the cores."""

    def __init__(self, model: mujoco.MjModel, states: dict, num_steps: int, physics: str):
        names = tuple(name for name in (*states, WARMSTART) if name != "act" or model.na)
        states = {**states, WARMSTART: np.zeros((len(states["qpos"]), model.nv))}
        step = jax.vmap(compile_step(model, inputs=(*names, "ctrl"), outputs=names, physics=physics))

        def play(state, ctrl):
            return jax.lax.scan(lambda s, _: (step(*s, ctrl), None), state, length=num_steps)[0]

        self.state = tuple(jnp.asarray(states[name], jnp.float32) for name in names)
        self.size = len(states["qpos"]) * num_steps
        number = len(jax.devices()) if physics == "scalar" else 1  # C MuJoCo uses all cores by itself
        divided = divide_batch(play, devices=jax.devices()[:number])
        ctrl = jnp.zeros((len(states["qpos"]), model.nu), jnp.float32)
        began = time.perf_counter()
        lowered = divided.trace(self.state, ctrl).lower()
        self.trace_seconds = time.perf_counter() - began
        began = time.perf_counter()
        self.run = lowered.compile()
        self.compile_seconds = time.perf_counter() - began
        self.bytes_per_env = self.run.memory_analysis().temp_size_in_bytes * number / len(ctrl)

    def play(self, ctrl: np.ndarray) -> tuple:
        """The states after the last step."""
        return jax.block_until_ready(self.run(self.state, jnp.asarray(ctrl, jnp.float32)))

    def measure(self, ctrl: np.ndarray) -> np.ndarray:
        return self.size * time_calls(lambda: self.play(ctrl), SECONDS)


class InC:
    """The same by C MuJoCo on all cores, by whichever of its two ways is faster."""

    def __init__(self, model: mujoco.MjModel, states: dict, num_steps: int):
        self.model, self.states, self.num_steps = model, states, num_steps
        self.num_envs = len(states["qpos"])
        self.size = self.num_envs * num_steps
        self.batch = mujoco.batch.Batch(model, self.num_envs, CORES)
        self.bound = {name: self.batch.bind(name) for name in (*states, "ctrl")}
        self.initial = self.batch.state.copy()
        self.datas = [mujoco.MjData(model) for _ in range(CORES)]
        self.rollout = mujoco.rollout.Rollout(nthread=CORES)
        self.full = np.concatenate([np.zeros((self.num_envs, 1)), *states.values()], 1)

    def run_batch(self, ctrl: np.ndarray) -> None:
        self.batch.state[...] = self.initial
        for name, values in {**self.states, "ctrl": ctrl}.items():
            self.bound[name][...] = values
        self.batch.step(np.ones(self.num_envs, bool), self.num_steps)

    def play(self, ctrl: np.ndarray) -> np.ndarray:
        """The states after each step, `[N, T, size]`."""
        repeated = np.repeat(ctrl[:, None], self.num_steps, 1)
        return self.rollout.rollout(self.model, self.datas, self.full[: len(ctrl)], repeated)[0]

    def measure(self, ctrl: np.ndarray) -> np.ndarray:
        ways = (lambda: self.run_batch(ctrl), lambda: self.play(ctrl))
        return self.size * np.max([time_calls(way, SECONDS / 2) for way in ways], 0)


def count_left(model: mujoco.MjModel, watched: list, positions: np.ndarray) -> float:
    """The share of the positions `[..., nq]` in which a watched pair may touch."""
    mx, bounds = put_model(model), choose_bounds(model, watched)
    data = import_mjx().make_data(mx)

    def is_near(qpos):
        placed, _ = find_positions(model, mx, data.replace(qpos=qpos))
        return may_touch(placed, bounds).astype(float)

    is_near_fast = scalarize(is_near, jnp.zeros(model.nq))
    flags = jax.jit(jax.vmap(is_near_fast))(jnp.asarray(positions.reshape(-1, model.nq), jnp.float32))
    return float(np.mean(np.asarray(flags)))


def find_peak() -> float:
    """The largest resident memory of this process so far [MiB]; NaN where the system does not say."""
    lines = STATUS.read_text().splitlines() if STATUS.exists() else []
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:")), float("nan"))


def compile_alone(path: Path, num_envs: int, num_steps: int) -> list[float]:
    """Largest memory of a new process before and after it has traced and compiled the model's loop [MiB]."""
    divide_cpu()
    model = load(path)
    states, before = make_states(model, num_envs), find_peak()
    Compiled(model, states, num_steps, "scalar")
    return [before, find_peak()]


def measure_memory(path: Path, options) -> list[float]:
    """`compile_alone` in a process of its own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(compile_alone, (path, options.envs, options.steps))


# --- one model --------------------------------------------------------------------------------------------------------


def name_model(path: Path) -> str:
    """A model file's name in tables, with that of its folder."""
    return path.stem if path.parent == ASSETS else f"{path.resolve().parent.name}/{path.stem}"


def load(path: Path) -> mujoco.MjModel:
    """The model of a file, without collisions of meshes."""
    model = change_collision(compile_model(load_spec(path)), "primitives")
    if not model.nv:
        raise MujocoModelError("nothing moves")
    return model


def measure_model(path: Path, options) -> dict[str, Any]:
    """Everything about one model file; of one that cannot be stepped, what MuJoCo or we say of it."""
    name = name_model(path)
    try:
        row = {"model": name, **measure_speeds(load(path), options)}
        return row | ({"memory": measure_memory(path, options)} if options.memory else {})
    except MujocoModelError as error:
        return {"model": name, "error": str(error)}


def measure_speeds(model: mujoco.MjModel, options) -> dict[str, Any]:
    states = make_states(model, options.envs)
    inputs = ("qpos", "qvel", "act", "ctrl") if model.na else ("qpos", "qvel", "ctrl")
    began = time.perf_counter()
    found = describe(model, inputs=inputs)
    trace_seconds = time.perf_counter() - began
    chosen, watched = ([], []) if found.reason else choose_pairs(model, candidate_pairs(model))
    in_c = InC(model, states, options.steps)
    methods: dict[str, Any] = {"floor": Compiled(model, states, options.steps, "mujoco"), "C": in_c}
    ours = methods["floor"] if found.reason else Compiled(model, states, options.steps, "scalar")
    methods = {"ours": ours, **methods}
    row = {
        "reason": found.reason,
        "equations": found.equations,
        "points": count_points(model, chosen),
        "watched": len(watched),
        "trace_seconds": trace_seconds + ours.trace_seconds,
        "compile_seconds": ours.compile_seconds,
        "bytes_per_env": ours.bytes_per_env,
        "speeds": {},
    }
    for kind, share in CONTROLS.items():
        ctrl = make_controls(model, options.envs, share)
        positions = in_c.play(ctrl)[..., 1 : 1 + model.nq]
        differences = np.abs(np.asarray(ours.play(ctrl)[0]) - positions[:, -1]).max(1)
        row["speeds"][kind] = {
            **play_rounds(methods, ctrl, options.rounds),
            "left_to_c": count_left(model, watched, positions[:WATCHED_ENVS]) if watched else 0.0,
            "difference": np.quantile(differences, [0.5, 0.99]).tolist(),
        }
    return row


def play_rounds(methods: dict[str, Any], ctrl: np.ndarray, rounds: int) -> dict[str, Any]:
    """Steps per second of each method, and by how much ours is faster than C: (smallest, median, largest)."""
    rates = np.array([[method.measure(ctrl) for method in methods.values()] for _ in range(rounds)])
    found = {name: summarise(rates[:, i, 0]) for i, name in enumerate(methods)}
    ratios = rates / rates[:, [list(methods).index("C")]]
    ours, floor = (ratios[:, list(methods).index(name)] for name in ("ours", "floor"))
    found |= {"ours_over_C": summarise(ours[:, 0]), "floor_over_C": summarise(floor[:, 0])}
    return found | {"ours_over_C_per_core": summarise(ours[:, 1])}


def show(row: dict[str, Any]) -> None:
    if "error" in row:
        print(f"{row['model']:34} {row['error'][:160]}", flush=True)
        return
    head = f"{row['model']:34} {row['equations']:6d} {row['points']:3d} {row['watched']:4d}"
    head += f" {row['trace_seconds']:6.1f} {row['compile_seconds']:6.1f} {row['bytes_per_env']:7.0f}"
    for kind, found in row["speeds"].items():
        rates = " ".join(f"{found[name][1] / 1e6:8.4f}" for name in METHODS)
        low, middle, high = found["ours_over_C"]
        ratios = f"{middle:6.2f} ({low:.2f} to {high:.2f}) {found['ours_over_C_per_core'][1]:6.2f}"
        error, larger_error = found["difference"]
        tail = f"{100 * found['left_to_c']:5.1f} % {error:.0e} {larger_error:.0e}"
        print(f"{head} {kind:5} {rates}  {ratios}  {found['floor_over_C'][1]:5.2f} {tail}", flush=True)
    if "memory" in row:
        before, after = row["memory"]
        print(f"    largest memory of a process that compiles it: {before:.0f} MiB before, {after:.0f} MiB after")
    if row["reason"]:
        print(f"    stepped by C MuJoCo: {row['reason'][:140]}", flush=True)


def list_files(given: Sequence[str]) -> list[Path]:
    """The model files that the arguments name; of a folder all of those in it."""
    files: list[Path] = []
    for argument in given:
        path = Path(argument.removeprefix(FOLDER))
        if not path.exists():
            raise UserError(f"{path}: there is no such file or folder")
        files += sorted(path.rglob("*.xml")) if path.is_dir() else [path]
    return files or sorted(ASSETS.glob("*.xml"))


def main(arguments: Sequence[str]) -> None:
    parser = Parser(__doc__)
    parser.add_argument("files", nargs="*", help=f"model files, and {FOLDER}FOLDER")
    parser.add_argument("--envs", type=count, default=1024)
    parser.add_argument("--steps", type=count, default=50)
    parser.add_argument("--rounds", type=count, default=5)
    parser.add_argument("--memory", action="store_true", help="memory of tracing and compiling each model")
    options = parser.parse_args(arguments)
    files = list_files(options.files)
    divide_cpu()
    print(
        "model, equations, points of contact, watched pairs, s to trace, to compile, bytes/env, controls, "
        f"M steps/s: {', '.join(METHODS)}; ours over C (range), for each core's second, floor over "
        "C, steps left to C, difference in the end: median, 99 %"
    )
    rows = []
    for path in files:
        rows.append(measure_model(path, options))
        show(rows[-1])
        write_json("robots.json", rows)


if __name__ == "__main__":
    run_command(main)
