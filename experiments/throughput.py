"""Steps per second of TD training on the pendulum, and where they go.

    python experiments/throughput.py

For several numbers of environments and network widths, rollouts of 8 steps, in turns within one process, the best of
several rounds each:

- steps/s of the training as it is; with the physics taken out (the state stands still); with the networks taken out
  (actions are noise, nothing is learned: rollouts only);
- its share of the peak: multiplications and additions of the networks' matrix products, over the rate of one product of
  two 1,024 x 1,024 matrices in the same process. A sample passes the actor twice (to act, to learn) and the critic
  twice (its own value, the next one's); each of the two that learn costs twice a pass more, backwards;
- memory that the program needs beside its arguments.

Then 1, 8 and 64 agents at once: time of an update of all over that of one agent times their number.

Writes results/throughput.json and prints it as tables.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from commands import write_json

from jaxpg.rollout import rollout
from jaxpg.run.config import Config, compose
from jaxpg.run.program import make_algorithm, make_env
from jaxpg.training import initial_state, train_scan
from jaxpg.vector_env import vectorize

TASK = "pendulum"
NUM_ENVS = (32, 256, 1024)
WIDTHS = (32, 64, 128)
SEEDS = (1, 8, 64)
NUM_STEPS = 8
SAMPLES = 80_000  # of one measurement, of each agent
ROUNDS = 7


def configured(num_envs: int, width: int) -> Config:
    sizes = f"num_envs={num_envs}", f"num_steps={NUM_STEPS}", f"network.widths=[{width},{width}]"
    return compose([f"env={TASK}", "algo=td", "network=mlp", "network.activation=tanh", *sizes])


class Standing:
    """An environment without its physics: the state stays as it is."""

    def __init__(self, env: Any):
        self.reset, self.observation_size, self.action_size = env.reset, env.observation_size, env.action_size

    def step(self, state: Any, action: jax.Array) -> Any:
        return state.replace(reward=state.reward + 0.0 * action[0])


def training(config: Config, env: Any, num_seeds: int = 1) -> tuple[Callable, Any]:
    """`(train, state)`, where `train(state)` makes the updates of one measurement; several agents are vmapped."""
    algorithm, updates = make_algorithm(config, env), num_updates(config)
    key = jax.random.key(0)
    if num_seeds == 1:
        return lambda state: train_scan(algorithm, key, updates, state), initial_state(algorithm, key)
    keys = jax.random.split(key, num_seeds)
    train = jax.vmap(lambda key, state: train_scan(algorithm, key, updates, state))
    return lambda state: train(keys, state), jax.jit(jax.vmap(lambda key: initial_state(algorithm, key)))(keys)


def rollouts(config: Config, env: Any) -> tuple[Callable, Any]:
    """As `training`, of rollouts only, with noise for actions."""
    vector = vectorize(env, config.run.num_envs, config.env.episode_length)

    def act(obs, key):
        u = jax.random.normal(key, (len(obs), env.action_size))
        return u, jnp.tanh(u)

    def play(state, key):
        state, steps = rollout(act, vector.step, state, key, NUM_STEPS)
        return state, jax.tree.map(jnp.sum, steps)

    keys = jax.random.split(jax.random.key(0), num_updates(config))
    return lambda state: jax.lax.scan(play, state, keys), vector.reset(jax.random.key(1))


def num_updates(config: Config) -> int:
    return max(1, SAMPLES // (config.run.num_envs * NUM_STEPS))


def product() -> tuple[Callable, Any]:
    """Ten products of two matrices, one after the other."""
    x = jax.random.normal(jax.random.key(0), (1024, 1024)) / 32
    return lambda x: jax.lax.scan(lambda y, _: (y @ x, None), x, length=10), x


def seconds(programs: dict[str, tuple[Callable, Any]]) -> tuple[dict[str, float], dict[str, int]]:
    """The best time of each program, measured in turns, and the bytes that it needs beside its arguments."""
    compiled = {name: (jax.jit(run).lower(state).compile(), state) for name, (run, state) in programs.items()}
    best = dict.fromkeys(programs, float("inf"))
    for _ in range(ROUNDS + 1):  # the first one warms up
        for name, (run, state) in compiled.items():
            began = time.perf_counter()
            jax.block_until_ready(run(state))
            best[name] = min(best[name], time.perf_counter() - began)
    return best, {name: run.memory_analysis().temp_size_in_bytes for name, (run, _) in compiled.items()}


def operations(observation_size: int, width: int) -> int:
    """Multiplications and additions of the networks for one sample, with one action."""
    one_pass = 2 * (observation_size * width + width * width + width)
    return one_pass * (2 * 2 + 2 * 2)  # both networks: two passes each, and two of a pass's size backwards


def sizes() -> list[dict[str, Any]]:
    rows = []
    for num_envs in NUM_ENVS:
        for width in WIDTHS:
            config = configured(num_envs, width)
            env = make_env(config)
            samples = num_updates(config) * num_envs * NUM_STEPS
            took, memory = seconds(
                {
                    "training": training(config, env),
                    "no physics": training(config, Standing(env)),
                    "no networks": rollouts(config, env),
                    "product": product(),
                }
            )
            peak = 10 * 2 * 1024**3 / took["product"]
            rows.append(
                {"environments": num_envs, "width": width}
                | {
                    f"{name}, steps/s": round(samples / took[name])
                    for name in ("training", "no physics", "no networks")
                }
                | {
                    "share of peak": round(
                        operations(env.observation_size, width) * samples / took["training"] / peak, 3
                    ),
                    "peak, GFLOP/s": round(peak / 1e9, 1),
                    "memory, MB": round(memory["training"] / 1e6, 1),
                }
            )
            print(rows[-1], flush=True)
    return rows


def agents() -> list[dict[str, Any]]:
    config = compose([f"env={TASK}", "algo=td"])
    env = make_env(config)
    took, _ = seconds({str(number): training(config, env, number) for number in SEEDS})
    return [
        {"agents": number, "time over that of one after the other": round(took[str(number)] / number / took["1"], 3)}
        for number in SEEDS
    ]


def table(rows: list[dict[str, Any]]) -> None:
    print("| " + " | ".join(rows[0]) + " |")
    print("|---" * len(rows[0]) + "|")
    for row in rows:
        print("| " + " | ".join(f"{value:,}" for value in row.values()) + " |")


def main() -> None:
    result = {"sizes": sizes(), "agents": agents()}
    write_json("throughput.json", result)
    for rows in result.values():
        table(rows)


if __name__ == "__main__":
    main()
