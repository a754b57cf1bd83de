"""The per-step actor-critic on the pendulum: linear in Fourier features and with an MLP, and where it breaks.

    python experiments/online_pendulum.py

Left: the lesson's online update with traces, tuned defaults (`env=pendulum algo=online`: linear in Fourier features of
order 3) and the same with two hidden layers; return of the sampled actions while learning. Right: the linear one with
its two step sizes multiplied by the same factor: return over the last tenth of the run. Five seeds each.

What one sees: with linear features five of five seeds solve it, from step sizes of a third to three times the tuned
ones; at ten times they are worse and far apart, at a tenth only slow. The MLP ends better with the seeds that solve
it and leaves two of five at -780.

Writes results/online_pendulum.png and results/online_pendulum.json.
"""

from __future__ import annotations

import json
from collections.abc import Sequence

import jax
import numpy as np
from commands import Parser, write_figure, write_json
from matplotlib.figure import Figure

from jaxpg.commands.ending import run_command
from jaxpg.config.parsing import compose
from jaxpg.program.agents import list_agents
from jaxpg.program.algorithms import make_algorithm
from jaxpg.program.environment import make_env
from jaxpg.program.schedule import plan
from jaxpg.store.statistics import interquartile_mean
from jaxpg.training import train_scan
from jaxpg.watch.figures import draw_curve

NUM_SEEDS = 5
POINTS = 40  # of a curve
MLP = ("network=mlp", "network.widths=[32,32]", "network.sigma_is=fixed", "algo.actor_lr=0.003", "algo.critic_lr=0.02")
NETWORKS = {"linear, Fourier features": (), "MLP": MLP}
FACTORS = (0.1, 0.3, 1.0, 3.0, 10.0)
SIZES: tuple[str, ...] = ()  # options for all runs


def returns(*options: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps `[K]` and mean return of the episodes that ended since the last point, `[S, K]`."""
    config = compose(["env=pendulum", "algo=online", f"num_seeds={NUM_SEEDS}", *SIZES, *options])
    algorithm, schedule = make_algorithm(config, make_env(config)), plan(config)
    train = jax.vmap(lambda seed: train_scan(algorithm, jax.random.key(seed), schedule.num_updates))
    _, metrics = jax.jit(train)(list_agents(config).seed)
    ends = np.linspace(0, schedule.num_updates, min(POINTS, schedule.num_updates) + 1).astype(int)
    total, episodes = (
        np.add.reduceat(np.asarray(metrics[name], float), ends[:-1], axis=1) for name in ("return_sum", "episodes")
    )
    return ends[1:] * schedule.steps_per_update, total / np.maximum(episodes, 1)


def main(arguments: Sequence[str] = ()) -> None:
    Parser(__doc__).parse_args(arguments)
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    summary = {"curves": {}, "step sizes": {}}
    for label, options in NETWORKS.items():
        steps, earned = returns(*options)
        draw_curve(left, steps, earned, label)
        summary["curves"][label] = {
            "steps": steps.tolist(),
            "interquartile_mean": interquartile_mean(earned).round(1).tolist(),
            "at the end, by seed": earned[:, -1].round(1).tolist(),
        }
    left.set(xlabel="environment steps, each with its update", ylabel="return of sampled actions")
    tuned = compose(["env=pendulum", "algo=online"]).algo
    ends = {}
    for factor in FACTORS:
        options = f"algo.actor_lr={factor * tuned.actor_lr}", f"algo.critic_lr={factor * tuned.critic_lr}"
        _, earned = returns(*options)
        ends[factor] = earned[:, -max(1, earned.shape[1] // 10) :].mean(axis=1)
        kept = ends[factor][np.isfinite(ends[factor])]
        summary["step sizes"][str(factor)] = {
            "return by seed": [round(x, 1) if np.isfinite(x) else None for x in ends[factor].tolist()],
            "diverged": int(NUM_SEEDS - len(kept)),
        }
        right.plot([factor] * len(kept), kept, "o", color="C0", alpha=0.6)
        if len(kept) < NUM_SEEDS:
            right.annotate(f"{NUM_SEEDS - len(kept)} diverged", (factor, 0), ha="center", fontsize=8)
    right.set(xscale="log", xlabel="factor on both step sizes", ylabel="return at the end, by seed", ylim=(-1700, 60))
    left.legend(loc="lower right", fontsize=8)
    for axes in (left, right):
        axes.grid(alpha=0.3)
    write_figure("online_pendulum.png", figure)
    write_json("online_pendulum.json", summary)
    print(json.dumps(summary["step sizes"], indent=1))


if __name__ == "__main__":
    run_command(main)
