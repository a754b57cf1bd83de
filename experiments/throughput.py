"""Steps per second of TD training on the pendulum, and where they go.

    python experiments/throughput.py

For several numbers of environments and network widths, rollouts of 8 steps, in turns within one process, the best of
several rounds each:

- steps/s of the training as it is; with the physics taken out (the state stands still); with the networks taken out
  (actions are noise, nothing is learned: rollouts only); with all but the networks' matrix products taken out; as it
  is, but with the environments in two shards, each on a core of its own;
- its share of the peak: multiplications and additions of the networks' matrix products, over the rate of one product of
  two 1,024 x 1,024 matrices in the same process. A sample passes the actor twice (to act, to learn) and the critic
  once, a rollout's ends twice more; each of the two that learn costs twice a pass more, backwards; beside it the share
  that the products reach alone, which is the most that a training of these shapes can have;
- memory that the program needs beside its arguments.

Then the programs of `python -m jaxpg.train` for 8 and 64 agents at once: their time over that of one agent times their
number, with the agents in programs of their own, side by side on the cores, and with several in one program (vmap);
and over that of one agent in two shards, which has both cores to itself.

Writes results/throughput.json and prints it as tables.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from commands import Parser, write_json

from jaxpg.commands.ending import run_command
from jaxpg.config.configuration import Config
from jaxpg.config.parsing import compose
from jaxpg.program.algorithms import make_algorithm
from jaxpg.program.backend import prepare
from jaxpg.program.compile import compile_program
from jaxpg.program.environment import make_env
from jaxpg.program.schedule import plan
from jaxpg.rollout import rollout
from jaxpg.training import initial_state, train_scan
from jaxpg.vector_env import vectorize

TASK = "pendulum"
NUM_ENVS = (32, 256, 1024)
WIDTHS = (32, 64, 128)
ALGORITHMS = ("ppo", "td")
SEEDS = (8, 64)
IN_ONE_PROGRAM = (1, 4, 8)
NUM_STEPS = 8
SHARDS = 2
SAMPLES = 80_000  # of one measurement, of each agent
ROUNDS = 7


def configured(num_envs: int, width: int, shards: int = 1) -> Config:
    sizes = f"num_envs={num_envs}", f"num_steps={NUM_STEPS}", f"network.widths=[{width},{width}]"
    options = "algo=td", f"algo.num_shards={shards}", "network=mlp", "network.activation=tanh"
    return compose([f"env={TASK}", *options, *sizes])


class Standing:
    """An environment without its physics: the state stays as it is."""

    def __init__(self, env: Any):
        self.reset, self.observation_size, self.action_size = env.reset, env.observation_size, env.action_size

    def step(self, state: Any, action: jax.Array) -> Any:
        return state.replace(reward=state.reward + 0.0 * action[0])


def training(config: Config, env: Any) -> tuple[Callable, Any]:
    """`(train, state)`, where `train(state)` makes the updates of one measurement."""
    algorithm, updates, key = make_algorithm(config, env), num_updates(config), jax.random.key(0)
    return lambda state: train_scan(algorithm, key, updates, state), initial_state(algorithm, key)


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


def products(config: Config, observation_size: int) -> tuple[Callable, Any]:
    """As `training`, of the networks' matrix products only: of the same shapes, forwards and backwards."""
    sizes = [observation_size, *config.network.widths, 1]
    keys = jax.random.split(jax.random.key(0), len(sizes))
    layers = [
        jax.random.normal(key, pair) / pair[0] for key, *pair in zip(keys[1:], sizes[:-1], sizes[1:], strict=True)
    ]
    obs = jax.random.normal(keys[0], (NUM_STEPS, config.run.num_envs, observation_size))
    rows = obs.reshape(-1, observation_size)

    def network(layers, x):
        for layer in layers:
            x = x @ layer
        return x

    def learn(params):
        return jnp.sum(network(params["actor"], rows) ** 2) + jnp.sum(network(params["critic"], rows) ** 2)

    def update(params, _):
        acting = jax.lax.map(lambda x: jnp.sum(network(params["actor"], x)), obs)
        next_value = jnp.sum(network(params["critic"], rows[: 2 * config.run.num_envs] + 1e-6 * acting[0]))
        return jax.tree.map(lambda w, g: w - 1e-9 * (g + next_value), params, jax.grad(learn)(params)), None

    state = {"actor": layers, "critic": layers}
    return lambda params: jax.lax.scan(update, params, length=num_updates(config)), state


def num_updates(config: Config) -> int:
    return max(1, SAMPLES // (config.run.num_envs * NUM_STEPS))


def product() -> tuple[Callable, Any]:
    """Ten products of two matrices, one after the other."""
    x = jax.random.normal(jax.random.key(0), (1024, 1024)) / 32
    return lambda x: jax.lax.scan(lambda y, _: (y @ x, None), x, length=10), x


def seconds(programs: dict[str, tuple[Callable, Any]]) -> dict[str, float]:
    """The best time of each program `(run, state)`, measured in turns."""
    best = dict.fromkeys(programs, float("inf"))
    for _ in range(ROUNDS + 1):  # the first one warms up
        for name, (run, state) in programs.items():
            began = time.perf_counter()
            jax.block_until_ready(run(state))
            best[name] = min(best[name], time.perf_counter() - began)
    return best


def compiled(run: Callable, state: Any) -> tuple[Callable, Any]:
    program = jax.jit(run).lower(state).compile()
    (where,), _ = program.input_shardings
    return program, jax.device_put(state, where)


def operations(observation_size: int, width: int) -> int:
    """Multiplications and additions of the networks for one sample, with one action."""
    one_pass = 2 * (observation_size * width + width * width + width)
    forwards = 2 + 1 + 2 / NUM_STEPS
    return round(one_pass * (forwards + 2 * 2))  # backwards, two of a pass's size for either network


def sizes() -> list[dict[str, Any]]:
    rows = []
    for num_envs in NUM_ENVS:
        for width in WIDTHS:
            config = configured(num_envs, width)
            env = make_env(config)
            samples = num_updates(config) * num_envs * NUM_STEPS
            programs = {
                "training": compiled(*training(config, env)),
                "in shards": compiled(*training(configured(num_envs, width, SHARDS), env)),
                "no physics": compiled(*training(config, Standing(env))),
                "no networks": compiled(*rollouts(config, env)),
                "products alone": compiled(*products(config, env.observation_size)),
                "product": compiled(*product()),
            }
            took, memory = seconds(programs), programs["training"][0].memory_analysis().temp_size_in_bytes
            peak, work = 10 * 2 * 1024**3 / took["product"], samples * operations(env.observation_size, width)
            rows.append(
                {"environments": num_envs, "width": width}
                | {
                    f"{name}, steps/s": round(samples / took[name])
                    for name in ("training", "in shards", "no physics", "no networks")
                }
                | {
                    "share of peak": round(work / took["training"] / peak, 3),
                    "in shards, share": round(work / took["in shards"] / peak, 3),
                    "products alone": round(work / took["products alone"] / peak, 3),
                    "peak, GFLOP/s": round(peak / 1e9, 1),
                    "memory, MB": round(memory / 1e6, 1),
                }
            )
            print(rows[-1], flush=True)
    return rows


def agents() -> list[dict[str, Any]]:
    rows = []
    for algo in ALGORITHMS:
        alone = seconds({"alone": agents_at_once(algo, 1, 1), "in shards": agents_at_once(algo, 1, 1, SHARDS)})
        for number in SEEDS:
            programs = {str(size): agents_at_once(algo, number, size) for size in IN_ONE_PROGRAM}
            took = seconds(programs)
            shares = {
                f"{size} in a program": round(took[str(size)] / number / alone["alone"], 3) for size in IN_ONE_PROGRAM
            }
            shares["over one in shards"] = round(took["1"] / number / alone["in shards"], 3)
            rows.append({"algorithm": algo, "agents": number, **shares})
            print(rows[-1], flush=True)
    return rows


def agents_at_once(algo: str, number: int, size: int, shards: int = 1) -> tuple[Callable, Any]:
    """The updates between two lines of metrics of this many agents, `size` of them in one program."""
    agents = f"num_seeds={number}", f"vmap_seeds={size}"
    config = compose([f"env={TASK}", f"algo={algo}", f"algo.num_shards={shards}", *agents])
    program = compile_program(config, make_env(config), plan(config).chunk)
    return program.advance, program.init().train


def table(rows: list[dict[str, Any]]) -> None:
    print("| " + " | ".join(rows[0]) + " |")
    print("|---" * len(rows[0]) + "|")
    for row in rows:
        print("| " + " | ".join(value if isinstance(value, str) else f"{value:,}" for value in row.values()) + " |")


def main(arguments: Sequence[str] = ()) -> None:
    Parser(__doc__).parse_args(arguments)
    prepare(configured(NUM_ENVS[0], WIDTHS[0], SHARDS))
    result = {"sizes": sizes(), "agents": agents()}
    write_json("throughput.json", result)
    for rows in result.values():
        table(rows)


if __name__ == "__main__":
    run_command(main)
