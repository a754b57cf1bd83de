"""Claim: arms learn to reach within centimetres in seconds on two cores, with one set of defaults, and C MuJoCo agrees.

    python experiments/reach.py [robots=FOLDER] [ROBOT ...] [--seeds 3] [--option env.control=twist ...] [--command]
    python experiments/reach.py --speed [ROBOT] [--rounds 5]

For every robot (by default those of the library; with `robots=FOLDER` all model files in it) and seed, a training with
the defaults of `env=reach`, unless `--option` changes them. Every 100,000 steps its deterministic policy reaches for
500 goals, off the clock. A goal is reached within a distance if the end effector is within it in all of the last 0.2 s
of the episode. Printed are the seconds of training (compiling not included) and the environment steps until 95 % of
the goals are reached within 5, 2 and 1 cm, the shares at the end, and beside them:

    C MuJoCo     the shares when C MuJoCo steps the same policy, with all collisions of the model
    jerk         mean squared second difference of the actions, in shares of their limits
    violation    how far a joint is beyond its range at most, mean of the episodes [rad]

With `--command`, also the seconds of `python -m jaxpg.train` as a whole, with nothing compiled before. `--speed` prints
the training's environment steps per second with the physics of the library and with C MuJoCo's thread pool, turn by
turn in one process, and what the physics alone would make.

Writes results/reach.json, and results/reach_speed.json.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from commands import Parser, count, train, write_json
from measuring import CORES, divide_cpu, summarise, time_calls

from envs.batches import divide_batch
from envs.options import OptionError
from envs.physics import MujocoModelError
from envs.robots import SHIPPED_ROBOTS
from envs.robots.sources import find_file
from jaxpg.commands.ending import run_command
from jaxpg.config.parsing import compose
from jaxpg.evaluation import play
from jaxpg.policy import deterministic_policy
from jaxpg.program.backend import prepare
from jaxpg.program.compile import compile_program
from jaxpg.program.environment import make_env
from jaxpg.program.networks import make_networks
from jaxpg.program.state import get_policy

FOLDER = "robots="
RADII = (0.05, 0.02, 0.01)  # m
SHARE = 0.95
GOALS = 500
GOAL_SEED = 12345
INTERVAL = 100_000  # steps between evaluations
PHYSICS = ("scalar", "mujoco")


class Training:
    """A training with the defaults, whose policy can be tried at any time."""

    def __init__(self, options: Sequence[str]):
        self.config = compose(["env=reach", *options])
        prepare(self.config)
        env = make_env(self.config)
        run = self.config.run
        self.size = run.num_envs * run.num_steps
        self.chunk = max(1, round(INTERVAL / self.size))
        began = time.perf_counter()
        self.program = compile_program(self.config, env, self.chunk)
        self.state = self.program.init().train
        self.compiling, self.seconds, self.steps = time.perf_counter() - began, 0.0, 0
        self.play = self.compile_evaluation(env)

    def advance(self, number: int) -> float:
        """Updates; returns environment steps per second."""
        began = time.perf_counter()
        self.state, _ = jax.block_until_ready(self.program.advance(self.state, number=number))
        seconds = time.perf_counter() - began
        self.seconds, self.steps = self.seconds + seconds, self.steps + number * self.size
        return number * self.size / seconds

    def compile_evaluation(self, env: Any) -> Any:
        """Distances, angles `[T, N]` and metrics of episodes, as a function of the policy."""
        networks, length = make_networks(self.config, env), self.config.env.episode_length

        def look(step):
            return step.after.metrics["distance"], step.after.metrics.get("angle", jnp.zeros_like(step.reward))

        def play_from(policy, starts):
            act = deterministic_policy(networks, policy.params, policy.normalizer)
            episodes, records = play(env, act, starts, length, look)
            return episodes.metrics, tuple(jnp.moveaxis(x, 0, 1) for x in records)

        starts = jax.random.split(jax.random.key(GOAL_SEED), GOALS + GOALS % CORES)
        divided = jax.jit(divide_batch(play_from, (None, 0), jax.devices()[: self.config.num_shards]))
        return lambda policy: divided(policy, starts)

    def try_policy(self, evaluation: Any = None) -> dict[str, Any]:
        """Shares of the goals that are reached within `RADII`, and metrics of the episodes."""
        policy = jax.tree.map(lambda x: np.asarray(x)[0], get_policy(self.state))
        metrics, (distance, angle) = (evaluation or self.play)(policy)
        env = self.config.env
        last = max(1, round(env.hold_time / env.dt))
        angle_held = np.asarray(angle)[:, -last:].max(1) < env.success_angle
        reached = [np.asarray(distance)[:, -last:].max(1) < radius for radius in RADII]
        shares = [float((held & angle_held).mean()) for held in reached]
        means = {name: float(np.mean(metrics[name])) for name in ("distance", "jerk", "limit_violation")}
        return {"shares": shares, "median distance": float(np.median(metrics["distance"])), **means}


def measure(options: Sequence[str]) -> dict[str, Any]:
    """One training, with the seconds until each of `RADII` is good enough."""
    training = Training(options)
    total = training.config.run.total_steps
    until, until_steps = [None] * len(RADII), [None] * len(RADII)
    training.try_policy()
    while training.steps < total:
        training.advance(training.chunk)
        found = training.try_policy()
        for i, share in enumerate(found["shares"]):
            if until[i] is None and share >= SHARE:
                until[i], until_steps[i] = training.seconds, training.steps
    there = make_env(compose(["env=reach", *options, "env.physics=mujoco", "env.collision=all"]))
    in_c = training.try_policy(training.compile_evaluation(there))
    return {
        "compiling": training.compiling,
        "seconds": training.seconds,
        "steps": training.steps,
        "until": until,
        "until_steps": until_steps,
        "end": found,
        "mujoco": in_c,
    }


def time_command(options: Sequence[str]) -> float:
    """Seconds of `python -m jaxpg.train` from a cold start: no compiled program is there."""
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"XDG_CACHE_HOME": folder}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        return train(Path(folder) / "run", "env=reach", *options, environment=environment)


def describe(name: str, rows: list[dict[str, Any]]) -> str:
    """One line of the table: medians of the seeds, and all of their shares."""
    until = [[row["until"][i] for row in rows] for i in range(len(RADII))]
    times = " / ".join(f"{np.median(x):.1f}" if all(x) else "-" for x in until)
    steps = [[row["until_steps"][i] for row in rows] for i in range(len(RADII))]
    millions = " / ".join(f"{np.median(x) / 1e6:.1f}" if all(x) else "-" for x in steps)
    ours, theirs = (np.mean([row[who]["shares"] for row in rows], 0) for who in ("end", "mujoco"))
    shares = " / ".join(f"{100 * x:.1f}" for x in ours)
    c = " / ".join(f"{100 * x:.1f}" for x in theirs)
    jerk, violation = (np.mean([row["end"][key] for row in rows]) for key in ("jerk", "limit_violation"))
    seconds = np.median([row["seconds"] for row in rows])
    learning = f"{times:>18} s of {seconds:5.1f}, {millions:>15} M"
    return f"{name:16} {learning}   {shares:>20} %   C {c:>20} %   {jerk:.4f}   {violation:.4f}"


def measure_speed(robot: str, rounds: int) -> dict[str, Any]:
    """Environment steps per second of training by each physics, in turns, and of the physics alone."""
    trainings = {physics: Training([f"env.robot={robot}", f"env.physics={physics}"]) for physics in PHYSICS}
    for training in trainings.values():
        training.advance(1)
    rates = np.array([[training.advance(2) for training in trainings.values()] for _ in range(rounds)])
    alone = measure_physics(trainings["scalar"], rounds)
    found = {physics: summarise(rate) for physics, rate in zip(trainings, rates.T, strict=True)}
    found |= {"ratio": summarise(rates[:, 0] / rates[:, 1]), "environment alone": alone}
    for name, (low, middle, high) in found.items():
        print(f"{name:20} {middle:12,.1f} ({low:,.1f} to {high:,.1f})")
    return {"robot": robot, **found}


def measure_physics(training: Training, rounds: int) -> tuple[float, float, float]:
    """Steps per second of the environment under constant actions, on all cores."""
    env, number = make_env(training.config), training.config.run.num_envs
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), number))
    actions = jnp.full((number, env.action_size), 0.1)

    def run(states, actions):
        return jax.lax.scan(lambda s, _: (jax.vmap(env.step)(s, actions), None), states, length=50)[0]

    divided = jax.jit(divide_batch(run, 0, jax.devices()[: training.config.num_shards]))
    jax.block_until_ready(divided(states, actions))
    call = lambda: jax.block_until_ready(divided(states, actions))  # noqa: E731
    return summarise(np.array([50 * number * time_calls(call, 0.5)[0] for _ in range(rounds)]))


def list_robots(given: Sequence[str]) -> list[str]:
    """The robots' names, with the model files of `robots=FOLDER`; raises OptionError if there is no such robot."""
    folders = [Path(x.removeprefix(FOLDER)) for x in given if x.startswith(FOLDER)]
    files = [str(path) for folder in folders for path in sorted(folder.rglob("*.xml"))]
    robots = [*files, *(x for x in given if not x.startswith(FOLDER))]
    for robot in robots:
        find_file(robot)
    return robots or list(SHIPPED_ROBOTS)


def main(arguments: Sequence[str]) -> None:
    parser = Parser(__doc__)
    parser.add_argument("robots", nargs="*")
    parser.add_argument("--seeds", type=count, default=3)
    parser.add_argument("--rounds", type=count, default=5)
    parser.add_argument("--option", action="append", default=[])
    parser.add_argument("--command", action="store_true")
    parser.add_argument("--speed", action="store_true")
    given = parser.parse_args(arguments)
    divide_cpu()
    robots = list_robots(given.robots)
    if given.speed:
        write_json("reach_speed.json", [measure_speed(robot, given.rounds) for robot in robots[:1]])
        return
    results = []
    print("robot, s of training and steps until 95 % are within 5 / 2 / 1 cm; shares at the end; in C; jerk; violation")
    for robot in robots:
        options = [f"env.robot={robot}", *given.option]
        try:
            rows = [measure([*options, f"seed={seed}"]) for seed in range(given.seeds)]
        except (OptionError, MujocoModelError) as error:
            print(f"{Path(robot).stem:16} {error}")
            continue
        print(describe(Path(robot).stem, rows), flush=True)
        whole = time_command(options) if given.command else None
        results.append({"robot": Path(robot).stem, "options": given.option, "seeds": rows, "command": whole})
        if whole:
            print(f"{'':16} the whole command: {whole:.1f} s", flush=True)
    write_json("reach.json", results)


if __name__ == "__main__":
    run_command(main)
