"""Finds options that are valid by themselves but conflict with each other, one line for each.

Here a configuration is a `jaxpg.config.configuration.Config`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from jaxpg.config.schema import Reinforce, Run

EPISODE_MEANS = ("mean", "time_mean", "optimal", "leave_one_out")  # baselines that need several episodes


def find_choice_conflicts(config: Any) -> Iterator[str]:
    """Conflicts in a configuration whose rollout length may not be set yet."""
    yield from _find_algorithm_conflicts(config)
    yield from _find_network_conflicts(config)
    yield from _find_agent_conflicts(config)


def find_size_conflicts(config: Any) -> Iterator[str]:
    """Sizes that are too large, or too small for learning; the rollout length must be set."""
    yield from _find_excessive_sizes(config.run, config.algo, config.env.episode_length)
    yield from _find_degenerate_batches(config)


def _find_algorithm_conflicts(config: Any) -> Iterator[str]:
    algo, run, horizon = config.algo, config.run, config.env.episode_length
    if algo.whole_episodes and run.num_steps not in (None, horizon):
        name = config.choices["algo"]
        yield f"num_steps={run.num_steps}: algo={name} plays whole episodes, {horizon} steps here; leave it out"
    if isinstance(algo, Reinforce) and algo.discounted and algo.returns == "whole":
        yield "algo.discounted=true: whole returns already have the factors gamma^t; leave it out"
    shards = config.num_shards
    if run.num_envs % shards:
        yield _describe_divisor("algo.num_shards", shards, f"num_envs={run.num_envs}", run.num_envs)
    elif run.num_envs // shards % algo.minibatches:
        whole = f"num_envs={run.num_envs}" + (f" / algo.num_shards={shards}" if shards > 1 else "")
        yield _describe_divisor("algo.minibatches", algo.minibatches, whole, run.num_envs // shards)


def _find_degenerate_batches(config: Any) -> Iterator[str]:
    """Batches whose advantages vanish once their mean is subtracted, so that the policy would never change."""
    algo, run = config.algo, config.run
    if isinstance(algo, Reinforce) and run.num_envs < 2:
        if algo.baseline in EPISODE_MEANS:
            yield (
                f"algo.baseline={algo.baseline} needs other episodes: num_envs must be at least 2, "
                "or algo.baseline=none or value"
            )
        if algo.returns == "whole" and algo.normalize_advantages:
            yield (
                "algo.returns=whole algo.normalize_advantages=true: this subtracts the return of the only episode; "
                "num_envs must be at least 2, or algo.normalize_advantages=false"
            )
    if run.num_envs * run.num_steps == 1 and algo.normalize_advantages:
        yield (
            f"num_envs={run.num_envs} num_steps={run.num_steps}: a single advantage minus its mean is 0; "
            "increase either, or set algo.normalize_advantages=false"
        )


def _describe_divisor(name: str, value: int, whole: str, number: int) -> str:
    return f"{name}={value} does not divide {whole}: the nearest that does is {find_nearest_divisor(number, value)}"


def _find_network_conflicts(config: Any) -> Iterator[str]:
    network = config.network
    if network.sigma_is == "scheduled":
        if not config.algo.has_schedules:
            name = config.choices["algo"]
            yield f"network.sigma_is=scheduled: algo={name} has no schedules; expected fixed, learned or state"
        if "network.sigma" in config.sweep:
            yield "sweep.network.sigma: cannot be swept with network.sigma_is=scheduled; train a run for each value"
    if network.features == "radial" and network.order < 2:
        yield f"network.order={network.order}: radial features need at least 2 points per axis"


def _find_agent_conflicts(config: Any) -> Iterator[str]:
    run = config.run
    if config.num_agents % run.vmap_seeds:
        yield (
            f"vmap_seeds={run.vmap_seeds} does not divide the number of agents, {config.num_agents}: "
            f"the nearest that does is {find_nearest_divisor(config.num_agents, run.vmap_seeds)}"
        )
    if run.num_seeds + run.seed > 2**32:
        yield f"seed={run.seed} num_seeds={run.num_seeds}: seeds must stay below 2**32"


def _find_excessive_sizes(run: Run, algo: Any, horizon: int) -> Iterator[str]:
    """Sizes that overflow XLA's indices or the counters of steps and updates, which have 32 bits."""
    if horizon < 1:
        yield f"env.episode_length={horizon}: it must be at least 1"
    if horizon >= 2**31:
        yield f"env.episode_length={horizon}: it must stay below 2**31"
    rollout = run.num_envs * run.rollout_steps
    if rollout >= 2**31:
        yield f"num_envs={run.num_envs} num_steps={run.num_steps}: their product must stay below 2**31"
        return
    gradient_steps = algo.gradient_steps
    limit = rollout * ((2**31 - 1) // gradient_steps)
    if run.total_steps >= limit:
        gradients = f" and {gradient_steps} gradient steps" if gradient_steps > 1 else ""
        yield f"total_steps={run.total_steps}: with {rollout} steps{gradients} per update it must stay below {limit}"


def find_nearest_divisor(number: int, to: int) -> int:
    """The divisor of a number that is nearest to `to`; the smaller one of two.

    >>> find_nearest_divisor(12, 5), find_nearest_divisor(10, 3)
    (4, 2)
    """
    small = [n for n in range(1, math.isqrt(number) + 1) if number % n == 0]
    return min(sorted({*small, *(number // n for n in small)}), key=lambda n: abs(n - to))
