"""Claim: brax's and MuJoCo Playground's environments step many times faster than with their own physics, MJX.

    python experiments/mujoco_environments.py [NAME ...] [--envs 1024] [--steps 10] [--rounds 3] [--without mjx]

A NAME is brax:ant, playground:CartpoleBalance, ...; by default all of brax's and, where Playground is installed, those
of the DeepMind Control Suite. For each, environment steps per second under random actions on all cores, with
observations, rewards, time limits and resets, of

    scalar    env.physics=scalar, the default: C MuJoCo's step as scalar equations, or C MuJoCo where there are none
    mujoco    env.physics=mujoco: C MuJoCo
    mjx       env.physics=mjx: what brax and Playground do

one after the other in each round, and the mean reward of a step from the same first states under the same actions,
over 20 steps of all environments. Rewards differ where MJX's solver ends before the solution, as brax and Playground
ask for in some of their models, and by chance where motion is chaotic.

Prints one table and writes results/mujoco_environments.json: medians of the rounds with the smallest and the largest.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from commands import Parser, count, write_json
from measuring import compile_in_parts, count_parts, divide_cpu, summarise, time_calls

import envs
from envs.options import OptionError
from jaxpg.commands.ending import run_command
from jaxpg.vector_env import vectorize

PHYSICS = ("scalar", "mujoco", "mjx")
BRAX = ("inverted_pendulum", "inverted_double_pendulum", "reacher", "hopper", "walker2d", "halfcheetah", "pusher")
BRAX += ("ant", "humanoid", "humanoidstandup")
LENGTH = 1000  # of episodes
COMPARED = 20  # steps over which rewards are averaged
SECONDS = 1.0  # that one measurement lasts, at least


class Batch:
    """Environments divided over the cores; with C MuJoCo, which uses all of them by itself, they are in one part."""

    def __init__(self, name: str, physics: str, options):
        library, own = name.split(":")
        began = time.perf_counter()
        env = envs.make(library, name=own, physics=physics)
        number = count_parts(options.envs) if physics != "mujoco" else 1
        part = options.envs // number
        vector = vectorize(env, part, LENGTH)

        def reset(keys):
            return vector.reset(keys[0])

        def play(state, keys):
            def step(state, key):
                action, again = jax.random.split(key)
                size = (part, vector.action_size)
                state, outcome = vector.step(state, jax.random.uniform(action, size, minval=-1.0), again)
                return state, outcome.reward

            state, rewards = jax.lax.scan(step, state, jax.random.split(keys[0], options.steps))
            return state, jnp.mean(rewards, 0)

        self.size = options.envs * options.steps
        self.keys = jax.random.split(jax.random.key(0), options.envs)
        self.state = compile_in_parts(reset, number)(self.keys)
        self.run = compile_in_parts(play, number).lower(self.state, self.keys).compile()
        self.seconds = time.perf_counter() - began
        self.reward = float(np.mean([self.play() for _ in range(max(1, COMPARED // options.steps))]))

    def play(self) -> float:
        """The mean reward of a step."""
        self.keys = jax.vmap(lambda key: jax.random.fold_in(key, 1))(self.keys)
        self.state, rewards = self.run(self.state, self.keys)
        return float(jnp.mean(rewards))

    def measure(self) -> float:
        """Environment steps per second."""
        return self.size * time_calls(self.play, SECONDS)[0]


def measure_environment(name: str, options) -> dict[str, Any]:
    kinds = [physics for physics in PHYSICS if physics not in options.without]
    batches = {physics: Batch(name, physics, options) for physics in kinds}
    rates = np.array([[batch.measure() for batch in batches.values()] for _ in range(options.rounds)])
    row: dict[str, Any] = {"name": name}
    for i, (physics, batch) in enumerate(batches.items()):
        row[physics] = {"rate": summarise(rates[:, i]), "reward": batch.reward, "seconds": batch.seconds}
    if "mjx" in batches:
        row["ratio"] = summarise(rates[:, 0] / rates[:, kinds.index("mjx")])
    return row


def show(row: dict[str, Any]) -> None:
    if "error" in row:
        print(f"{row['name']:35} {row['error']}", flush=True)
        return
    found = [row[physics] for physics in PHYSICS if physics in row]
    rates = " ".join(f"{x['rate'][1]:11,.0f}" for x in found)
    others = " ".join(f"{x['seconds']:6.1f}" for x in found), " ".join(f"{x['reward']:8.3f}" for x in found)
    low, middle, high = row.get("ratio", (np.nan,) * 3)
    print(f"{row['name']:35} {rates}  {middle:7.1f} ({low:.1f} to {high:.1f})  {others[0]}  {others[1]}", flush=True)


def list_names() -> list[str]:
    names = [f"brax:{name}" for name in BRAX]
    if find_spec("mujoco_playground") is not None:
        from mujoco_playground import dm_control_suite

        names += [f"playground:{name}" for name in dm_control_suite.ALL_ENVS]
    return names


def main(arguments: Sequence[str]) -> None:
    parser = Parser(__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="brax:NAME or playground:NAME")
    parser.add_argument("--envs", type=count, default=1024)
    parser.add_argument("--steps", type=count, default=10, help="in one call")
    parser.add_argument("--rounds", type=count, default=3)
    parser.add_argument("--without", nargs="+", choices=PHYSICS[1:], default=[], help="leave out a kind of physics")
    options = parser.parse_args(arguments)
    for name in options.names:
        if name.split(":")[0] not in ("brax", "playground") or name.count(":") != 1:
            parser.error(f"{name}: expected brax:NAME or playground:NAME")
    divide_cpu()
    kinds = ", ".join(physics for physics in PHYSICS if physics not in options.without)
    print(f"environment, environment steps/s: {kinds}; scalar over mjx (range); s to compile; mean rewards")
    rows = []
    for name in options.names or list_names():
        try:
            rows.append(measure_environment(name, options))
        except OptionError as error:
            rows.append({"name": name, "error": str(error)})
        show(rows[-1])
        write_json("mujoco_environments.json", rows)


if __name__ == "__main__":
    run_command(main)
