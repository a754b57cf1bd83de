"""Random search over an algorithm's options: the draws are agents of one compiled program.

    python experiments/sweep.py [--draws 32] [--seeds 2] env=arm [option=value ...]

The options in `RANGES` are arguments of the program, not part of it: it is compiled once for all draws, which are
trained side by side on the cores. All other options are those of the training command, the same for every draw; the
tuned values of the environments were found so, one choice of sizes after the other.

A draw's result is the mean return of the deterministic policy over the evaluation's fixed starts at the end, and what
else the environment reports, averaged over the seeds. Prints the best draws and writes results/sweep_ENV_ALGO.json.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from commands import Parser, count, write_json

from jaxpg.commands.ending import run_command
from jaxpg.config.configuration import Config
from jaxpg.config.parsing import compose
from jaxpg.config.sweep import Setting
from jaxpg.program.agents import combine
from jaxpg.program.backend import prepare
from jaxpg.program.compile import compile_program
from jaxpg.program.environment import make_env
from jaxpg.program.schedule import plan
from jaxpg.program.state import get_policy
from jaxpg.store.names import rename_metrics

# Drawn log-uniformly between the two; discount and lambda by what they lack of 1.
RANGES = {
    "actor_lr": (3e-4, 1e-2),
    "critic_lr": (3e-4, 2e-2),
    "reward_scale": (0.02, 20.0),
    "1 - gamma": (0.01, 0.1),
    "1 - lambda_": (0.02, 0.2),
}
SHOWN = 10


def draws(algo: Any, number: int, seed: int = 0) -> list[Setting]:
    """Values of those options in `RANGES` that the algorithm has, `number` times."""
    generator, found = np.random.default_rng(seed), {}
    for label, (low, high) in RANGES.items():
        values = np.exp(generator.uniform(np.log(low), np.log(high), number))
        name = label.removeprefix("1 - ")
        if hasattr(algo, name):
            found[f"algo.{name}"] = values if name == label else 1 - values
    return [dict(zip(found, values, strict=True)) for values in zip(*found.values(), strict=True)]


def results(config: Config, settings: list[Setting], num_seeds: int) -> dict[str, np.ndarray]:
    """Mean return and metrics of every setting at the end of its training, `[settings]` by name."""
    agents = combine(settings, range(num_seeds))
    program = compile_program(config, make_env(config), plan(config).num_updates, agents)
    train, _ = program.advance(program.init().train)
    episodes = program.evaluate(get_policy(train))
    found = {"return": episodes.episode_return, **rename_metrics(episodes.metrics)}
    return {name: np.asarray(x).reshape(len(settings), -1).mean(axis=1) for name, x in found.items()}


def kept(setting: Setting, found: dict[str, np.ndarray], i: int) -> dict[str, float]:
    """What is kept of setting i."""
    values = {name.removeprefix("algo."): value for name, value in setting.items()}
    values |= {name: column[i] for name, column in found.items()}
    return {name: float(f"{value:.4g}") for name, value in values.items()}


def main(arguments: Sequence[str]) -> None:
    parser = Parser(__doc__)
    parser.add_argument("--draws", type=count, default=32)
    parser.add_argument("--seeds", type=count, default=2)
    parser.add_argument("options", nargs="*", help="of python -m jaxpg.train")
    given = parser.parse_args(arguments)
    config = compose(given.options)
    prepare(config)
    settings, began = draws(config.algo, given.draws), time.monotonic()
    found = results(config, settings, given.seeds)
    rows = [kept(setting, found, i) for i, setting in enumerate(settings)]
    rows.sort(key=lambda row: np.nan_to_num(row["return"], nan=-np.inf), reverse=True)
    print(f"{given.draws} draws, {given.seeds} seeds of each, {time.monotonic() - began:.0f} s; the best:")
    for row in rows[:SHOWN]:
        print("  ".join(f"{name}={value:g}" for name, value in row.items()))
    names = config.choices["env"], config.choices["algo"]
    write_json("sweep_{}_{}.json".format(*names), {"options": given.options, "seeds": given.seeds, "draws": rows})


if __name__ == "__main__":
    run_command(main)
