"""Options that are right by themselves and do not go together, a line for each.

A configuration here is a `jaxpg.config.configuration.Config`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from jaxpg.config.schema import Reinforce, Run

OF_OTHER_EPISODES = ("mean", "time_mean", "optimal", "leave_one_out")  # baselines that are means over episodes


def of_choices(config: Any) -> Iterator[str]:
    """Conflicts within a configuration, whose rollout length may still be open."""
    yield from _of_the_algorithm(config)
    yield from _of_the_network(config)
    yield from _of_agents(config)


def of_sizes(config: Any) -> Iterator[str]:
    """Sizes that are too large, or too small to learn from, once the rollout length is known."""
    yield from _too_large(config.run, config.algo, config.env.episode_length)
    yield from _batches_that_cannot_teach(config)


def _of_the_algorithm(config: Any) -> Iterator[str]:
    algo, run, horizon = config.algo, config.run, config.env.episode_length
    if algo.whole_episodes and run.num_steps not in (None, horizon):
        name = config.choices["algo"]
        yield f"num_steps={run.num_steps}: algo={name} plays whole episodes, {horizon} steps here; leave it out"
    if isinstance(algo, Reinforce) and algo.discounted and algo.returns == "whole":
        yield "algo.discounted=true: whole returns have the factors gamma^t in them; leave it out"
    shards = config.num_shards
    if run.num_envs % shards:
        yield _does_not_divide("algo.num_shards", shards, f"num_envs={run.num_envs}", run.num_envs)
    elif run.num_envs // shards % algo.minibatches:
        whole = f"num_envs={run.num_envs}" + (f" / algo.num_shards={shards}" if shards > 1 else "")
        yield _does_not_divide("algo.minibatches", algo.minibatches, whole, run.num_envs // shards)


def _batches_that_cannot_teach(config: Any) -> Iterator[str]:
    """Batches of which nothing is left once their own mean is taken away: the policy would stay what it is for ever."""
    algo, run = config.algo, config.run
    if isinstance(algo, Reinforce) and run.num_envs < 2:
        if algo.baseline in OF_OTHER_EPISODES:
            yield (
                f"algo.baseline={algo.baseline} needs other episodes, with a single one it is that one's own return: "
                "num_envs must be at least 2; algo.baseline=none and value do without"
            )
        if algo.returns == "whole" and algo.normalize_advantages:
            yield (
                "algo.returns=whole algo.normalize_advantages=true: the mean that is taken away is the return of the "
                "only episode; num_envs must be at least 2, or algo.normalize_advantages=false"
            )
    if run.num_envs * run.num_steps == 1 and algo.normalize_advantages:
        yield (
            f"num_envs={run.num_envs} num_steps={run.num_steps}: less its mean a single advantage is 0; "
            "take more of either, or algo.normalize_advantages=false"
        )


def _does_not_divide(name: str, value: int, whole: str, number: int) -> str:
    return f"{name}={value} does not divide {whole}: the nearest that does is {nearest_divisor(number, value)}"


def _of_the_network(config: Any) -> Iterator[str]:
    network = config.network
    if network.sigma_is == "scheduled":
        if not config.algo.has_schedules:
            name = config.choices["algo"]
            yield f"network.sigma_is=scheduled: algo={name} has no schedules; fixed, learned and state are left"
        if "network.sigma" in config.sweep:
            yield "sweep.network.sigma: cannot be swept with network.sigma_is=scheduled; each value needs its own run"
    if network.features == "radial" and network.order < 2:
        yield f"network.order={network.order}: radial features need at least 2 points of an axis"


def _of_agents(config: Any) -> Iterator[str]:
    run = config.run
    if config.num_agents % run.vmap_seeds:
        yield (
            f"vmap_seeds={run.vmap_seeds} does not divide the number of agents, {config.num_agents}: "
            f"the nearest that does is {nearest_divisor(config.num_agents, run.vmap_seeds)}"
        )
    if run.num_seeds + run.seed > 2**32:
        yield f"seed={run.seed} num_seeds={run.num_seeds}: seeds must stay below 2**32"


def _too_large(run: Run, algo: Any, horizon: int) -> Iterator[str]:
    """XLA's indices and the counters of steps and updates are 32-bit numbers."""
    if horizon < 1:
        yield f"env.episode_length={horizon}: it must be at least 1"
    if horizon >= 2**31:
        yield f"env.episode_length={horizon}: it must stay below 2**31"
    rollout = run.num_envs * run.rollout_steps
    if rollout >= 2**31:
        yield f"num_envs={run.num_envs} num_steps={run.num_steps}: their product must stay below 2**31"
        return
    of_update = algo.gradient_steps
    most = rollout * ((2**31 - 1) // of_update)
    if run.total_steps >= most:
        gradients = f" and {of_update} gradient steps" if of_update > 1 else ""
        yield f"total_steps={run.total_steps}: with {rollout} steps{gradients} an update it must stay below {most}"


def nearest_divisor(number: int, to: int) -> int:
    """The divisor of a number that is the nearest to another one, and of two the smaller.

    >>> nearest_divisor(12, 5), nearest_divisor(10, 3)
    (4, 2)
    """
    small = [n for n in range(1, math.isqrt(number) + 1) if number % n == 0]
    return min(sorted({*small, *(number // n for n in small)}), key=lambda n: abs(n - to))
