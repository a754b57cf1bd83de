"""Claim: brax's and MuJoCo Playground's environments step many times faster than with their own physics, MJX.

    python experiments/mujoco_environments.py [NAME ...] [--envs 1024] [--steps 10] [--rounds 3] [--without mjx]

A NAME is brax:ant, playground:CartpoleBalance, ...; by default all of brax's and, where Playground is installed, those
of the DeepMind Control Suite. For each, environment steps per second under random actions on all cores, with
observations, rewards, time limits and resets, of

    scalar    env.physics=scalar, the default: C MuJoCo's step as scalar equations, or C MuJoCo where there are none
    mujoco    env.physics=mujoco: C MuJoCo
    mjx       env.physics=mjx: what brax and Playground do

one after the other in each round; by how much the first is faster than the others; and by how much for each second of a
core's time, which a busy machine hardly changes.

Also the mean reward of a step over 20 steps of all environments, each up to the end of its first episode, from the same
first states under the same actions; and by how much an environment's mean reward differs from that with C MuJoCo
(median and maximum of the environments). Rewards differ where the solver of C MuJoCo and MJX ends before the solution,
as brax and Playground ask for in some of their models, and by chance where motion is chaotic.

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
from jaxpg.vector_env import VectorState, vectorize

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
            state = jax.vmap(env.reset)(keys)  # `vector.reset` has one key, so a state would depend on the parts
            zeros = jnp.zeros_like(state.reward)
            return VectorState(state, zeros.astype(jnp.int32), zeros, zeros + 1)

        def play(state, keys):
            def draw(number):
                return jax.vmap(lambda key: jax.random.fold_in(key, number))(keys)

            def step(state, t):
                action = jax.vmap(lambda key: jax.random.uniform(key, (vector.action_size,), minval=-1.0))(draw(t))
                state, outcome = vector.step(state, action, draw(options.steps + t)[0])
                return state, (outcome.reward, outcome.terminated)

            state, found = jax.lax.scan(step, state, jnp.arange(options.steps))
            return state, jax.tree.map(jnp.transpose, found)

        self.size = options.envs * options.steps
        self.keys = jax.random.split(jax.random.key(0), options.envs)
        self.state = compile_in_parts(reset, number)(self.keys)
        self.run = compile_in_parts(play, number).lower(self.state, self.keys).compile()
        self.seconds = time.perf_counter() - began
        self.rewards = average_rewards([self.play() for _ in range(max(1, COMPARED // options.steps))])

    def play(self) -> tuple[jax.Array, jax.Array]:
        """Rewards and whether an episode terminated, of the next steps, `[N, T]`."""
        self.keys = jax.vmap(lambda key: jax.random.fold_in(key, 1))(self.keys)
        self.state, found = jax.block_until_ready(self.run(self.state, self.keys))
        return found

    def measure(self) -> np.ndarray:
        """Environment steps per second, and per second of all cores' time."""
        return self.size * time_calls(self.play, SECONDS)


def average_rewards(parts: list[tuple[jax.Array, jax.Array]]) -> np.ndarray:
    """The mean reward of a step up to the end of the first episode, `[N]`; what follows depends on the resets."""
    rewards, ended = (np.concatenate(x, 1) for x in zip(*parts, strict=True))
    first = np.cumsum(ended, 1) - ended == 0
    return np.sum(rewards * first, 1) / np.sum(first, 1)


def compare_rewards(batches: dict[str, Batch], physics: str) -> list[float]:
    """By how much mean rewards of environments differ from those with C MuJoCo: (median, maximum)."""
    differences = np.abs(batches[physics].rewards - batches["mujoco"].rewards)
    return [float(np.median(differences)), float(np.max(differences))]


def measure_environment(name: str, options) -> dict[str, Any]:
    kinds = [physics for physics in PHYSICS if physics not in options.without]
    batches = {physics: Batch(name, physics, options) for physics in kinds}
    rates = np.array([[batch.measure() for batch in batches.values()] for _ in range(options.rounds)])
    row: dict[str, Any] = {"name": name}
    for i, (physics, batch) in enumerate(batches.items()):
        reward = float(np.mean(batch.rewards))
        row[physics] = {"rate": summarise(rates[:, i, 0]), "reward": reward, "seconds": batch.seconds}
        if "mujoco" in batches and physics != "mujoco":
            row[physics]["difference"] = compare_rewards(batches, physics)
        ratios = rates[:, 0] / rates[:, i]
        row[physics] |= {"ratio": summarise(ratios[:, 0]), "ratio_per_core": summarise(ratios[:, 1])}
    return row


def show(row: dict[str, Any]) -> None:
    if "error" in row:
        print(f"{row['name']:35} {row['error']}", flush=True)
        return
    found = [row[physics] for physics in PHYSICS if physics in row]
    rates = " ".join(f"{x['rate'][1]:11,.0f}" for x in found)
    others = " ".join(f"{x['seconds']:6.1f}" for x in found), " ".join(f"{x['reward']:8.3f}" for x in found)
    ratios = " ".join(f"{x['ratio'][1]:6.1f} {x['ratio_per_core'][1]:6.1f}" for x in found[1:])
    differences = " ".join(f"{x:.0e}" for of_one in found for x in of_one.get("difference", ()))
    print(f"{row['name']:35} {rates}  {ratios}  {others[0]}  {others[1]}  {differences}", flush=True)


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
    print(
        f"environment, environment steps/s: {kinds}; scalar over each of the others, and for each core's second; s "
        "to compile; mean rewards; their differences from those with C MuJoCo (median, maximum)"
    )
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
