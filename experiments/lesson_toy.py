"""The lesson's section 8.3 as printed, against the best that any linear policy can do.

    python experiments/lesson_toy.py

s' = s + 0.1 a, r = -(s'^2 + 0.01 a^2) from s = 0.5, 50 steps; a ~ N(theta_1 s + theta_2, 0.5^2). The lesson makes 500
plain steps of 0.001 along sum_t G_t grad log pi of one episode each; J is in closed form, so the curve has no noise of
its own. Beside it the project's defaults: `python -m jaxpg.train env=quadratic algo=reinforce`, which average over
32 episodes, subtract the mean of the others and take Adam's steps. 100 seeds of the lesson's, 20 of the defaults.

What one sees: single episodes without a baseline are so noisy that 15 of the lesson's 100 seeds leave the stable gains
(-20 < theta_1 < 0) within 500 updates and never return. The others have a median cost of 2.8 times the best after the
lesson's 500 updates, and of 1.5 times after 5,000. The defaults end within 0.5 % of the best with every seed.

Writes results/lesson_toy.png and results/lesson_toy.json.
"""

from __future__ import annotations

import json
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from commands import Parser, write_figure, write_json
from matplotlib.figure import Figure

from envs.linear_quadratic import Policy, best_policy, objective
from envs.quadratic import LinearQuadratic, QuadraticConfig, chain
from jaxpg.commands.ending import run_command
from jaxpg.config.parsing import compose
from jaxpg.distributions import gaussian_log_prob, gaussian_sample
from jaxpg.estimators import reinforce
from jaxpg.networks import linear_mean
from jaxpg.program.algorithms import make_algorithm
from jaxpg.program.environment import make_env
from jaxpg.program.schedule import plan
from jaxpg.rollout import rollout
from jaxpg.training import initial_state, train_scan
from jaxpg.vector_env import vectorize

SIGMA, STEP_SIZE = 0.5, 0.001
NUM_UPDATES = 5_000  # the lesson's 500, and where they would lead
LESSON_SEEDS, DEFAULT_SEEDS = 100, 20
DIVERGED = 1e3  # |theta| from which nothing comes back


def lesson(key: jax.Array) -> jax.Array:
    """theta after each of the lesson's updates, `[NUM_UPDATES, 2]`."""
    problem = chain(QuadraticConfig())
    batch = vectorize(LinearQuadratic(problem), 1, problem.horizon)
    log_std = jnp.log(SIGMA)

    def update(theta, key):
        def act(obs, key):
            u = gaussian_sample(key, theta[0] * obs + theta[1], log_std)
            return u, u

        key_reset, key_rollout = jax.random.split(key)
        _, played = rollout(act, batch.step, batch.reset(key_reset), key_rollout, problem.horizon)
        returns = reinforce(played.reward, problem.discount).advantage

        def surrogate(theta):
            return jnp.sum(gaussian_log_prob(played.u, theta[0] * played.obs + theta[1], log_std) * returns)

        theta = theta + STEP_SIZE * jax.grad(surrogate)(theta)
        return theta, theta

    return jax.lax.scan(update, jnp.zeros(2), jax.random.split(key, NUM_UPDATES))[1]


def defaults(key: jax.Array) -> jax.Array:
    """theta after each update of the project's defaults, `[updates, 2]`."""
    config = compose(["env=quadratic", "algo=reinforce"])
    algorithm = make_algorithm(config, make_env(config))

    def update(state, _):
        state, _ = train_scan(algorithm, key, 1, state)
        gain, offset = linear_mean(state.params["actor"])
        return state, jnp.concatenate([gain[0], offset])

    return jax.lax.scan(update, initial_state(algorithm, key), length=plan(config).num_updates)[1]


def cost(theta: np.ndarray) -> np.ndarray:
    """-J of the policies theta, `[..., 2]`, in closed form; infinite where theta has diverged."""
    problem = chain(QuadraticConfig())

    def of(row):
        if not np.abs(row).max() < DIVERGED:
            return np.inf
        return -objective(problem, Policy(row[None, :1], row[1:], SIGMA))

    return np.apply_along_axis(of, -1, np.asarray(theta, np.float64))


def state_of(theta: np.ndarray, best: float) -> dict[str, float]:
    """How far the seeds have come, those apart that have diverged."""
    costs = cost(theta)
    kept = np.isfinite(costs)
    return {
        "diverged": float(np.mean(~kept)),
        "median cost over best": float(np.median(costs[kept]) / best),
        "worst cost over best": float(costs[kept].max() / best),
        "median gain": float(np.median(theta[kept, 0])),
    }


def main(arguments: Sequence[str] = ()) -> None:
    Parser(__doc__).parse_args(arguments)
    problem = chain(QuadraticConfig())
    best = -objective(problem, best_policy(problem, SIGMA))
    axes = (figure := Figure(figsize=(7, 4.2), layout="constrained")).subplots()
    axes.axhline(best, color="black", lw=1, ls=":", label="best linear policy")
    summary = {"best cost": best}
    for label, run, seeds, episodes in (
        ("the lesson's update", lesson, LESSON_SEEDS, 1),
        ("defaults", defaults, DEFAULT_SEEDS, 32),
    ):
        keys = jnp.stack([jax.random.key(seed) for seed in range(seeds)])
        theta = np.asarray(jax.jit(jax.vmap(run))(keys))
        shown = np.unique(np.geomspace(1, theta.shape[1], 40).astype(int)) - 1
        low, median, high = np.quantile(cost(theta[:, shown]), [0.25, 0.5, 0.75], axis=0, method="inverted_cdf")
        axes.plot(episodes * (shown + 1), median, label=label)
        axes.fill_between(episodes * (shown + 1), low, high, alpha=0.25)
        summary[label] = {"seeds": seeds} | {
            f"after {updates} updates": state_of(theta[:, updates - 1], best)
            for updates in sorted({min(500, theta.shape[1]), theta.shape[1]})
        }
    axes.set(
        xscale="log",
        yscale="log",
        ylim=(0.3, 30),
        xlabel="episodes",
        ylabel="cost -J (median and quartiles of the seeds)",
    )
    axes.axvline(500, color="gray", lw=0.8, ls="--")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    write_figure("lesson_toy.png", figure)
    write_json("lesson_toy.json", summary)
    print(json.dumps(summary, indent=1))


if __name__ == "__main__":
    run_command(main)
