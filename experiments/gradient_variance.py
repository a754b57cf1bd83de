"""What baselines do to the variance of the gradient, and lambda to its bias and variance.

    python experiments/gradient_variance.py

On the linear-quadratic problem with three variables, where the gradient of J is known in closed form; with the factors
gamma^t, so that nothing is biased but by its critic. Left: mean squared error of the gradient of a batch of episodes,
over that gradient's squared length, for every baseline, times the number of episodes in the batch; a level line is the
error of independent samples. Right: TD(lambda) with the values of quite another policy for a critic: squared bias by
the closed form, variance of batches of 100 episodes as measured, and their sum.

Writes results/gradient_variance.png and results/gradient_variance.json.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import jax
import numpy as np
from commands import Parser, write_figure, write_json
from linear_quadratic import (
    UNBIASED,
    Played,
    advantages,
    closed_form,
    discounted,
    gradients,
    num_noises,
    play,
    setting,
    td_lambda_with_wrong_critic,
)
from matplotlib.figure import Figure

from jaxpg.commands.ending import run_command

VARIABLES = 3
NUM_EPISODES = 204_800
BATCH_SIZES = (2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)
BASELINES = ("none", "batch mean", "time mean", "leave one out", "optimal", "value")
LAMBDA_BATCH = 100
LAMBDAS = np.linspace(0, 1, 11)


@functools.cache
def episodes() -> Played:
    case = setting(VARIABLES)
    return play(case, np.random.default_rng(0).normal(size=(NUM_EPISODES, num_noises(case))))


def error(baseline: str, batch_size: int) -> float:
    """Mean squared error of the gradient of a batch, times its size, over the squared length of the gradient."""
    advantage = discounted(UNBIASED["returns" if baseline == "none" else f"returns, {baseline}"])
    batches = jax.tree.map(lambda x: x.reshape(len(x), -1, batch_size, *x.shape[2:]).swapaxes(0, 1), episodes())
    found = np.einsum("btnp,btn->bp", batches.score, advantages(batches, jax.vmap(advantage))) / batch_size
    exact = closed_form(setting(VARIABLES))
    return float(batch_size * np.mean(np.sum((found - exact) ** 2, axis=1)) / np.sum(exact**2))


def bias_and_variance(lambda_: float) -> tuple[float, float]:
    """Squared bias, and variance of a batch, with the wrong critic, over the squared length of the gradient."""
    case, (advantage, targets) = setting(VARIABLES), td_lambda_with_wrong_critic(lambda_)
    exact = closed_form(case)
    bias = closed_form(case, targets(case)) - exact
    variance = gradients(episodes(), discounted(advantage)).var(0).sum() / LAMBDA_BATCH
    return float(np.sum(bias**2) / np.sum(exact**2)), float(variance / np.sum(exact**2))


def main(arguments: Sequence[str] = ()) -> None:
    Parser(__doc__).parse_args(arguments)
    errors = {baseline: [error(baseline, size) for size in BATCH_SIZES] for baseline in BASELINES}
    bias, variance = np.array([bias_and_variance(lambda_) for lambda_ in LAMBDAS]).T
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for baseline, values in errors.items():
        left.plot(BATCH_SIZES, values, "o-", ms=3, label=baseline)
    left.set(xscale="log", yscale="log", xlabel="episodes in a batch", ylabel="squared error x episodes, relative")
    right.plot(LAMBDAS, bias, label="squared bias (closed form)")
    right.plot(LAMBDAS, variance, label=f"variance, {LAMBDA_BATCH} episodes (measured)")
    right.plot(LAMBDAS, bias + variance, "k--", label="squared error")
    right.set(xlabel="lambda, with a wrong critic", ylabel="squared error, relative")
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    write_figure("gradient_variance.png", figure)
    summary = {
        "batch sizes": list(BATCH_SIZES),
        "squared error x episodes": {name: [round(x, 3) for x in values] for name, values in errors.items()},
        "lambda": LAMBDAS.round(3).tolist(),
        "squared bias": bias.round(4).tolist(),
        "variance": variance.round(4).tolist(),
    }
    write_json("gradient_variance.json", summary)
    print(summary)


if __name__ == "__main__":
    run_command(main)
