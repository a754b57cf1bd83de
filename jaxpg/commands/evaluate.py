"""`python -m jaxpg.evaluate run=DIR`: evaluates a trained policy, deterministically, from fixed starts."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any

from jaxpg.commands.options import parse_run_and_env_options
from jaxpg.config.command_options import EvaluateOptions
from jaxpg.errors import UserError
from jaxpg.store import config_file
from jaxpg.store.statistics import finite_mean

if TYPE_CHECKING:
    from jaxpg.watch.episodes import Results


def main(arguments: Sequence[str]) -> int:
    """The evaluation command; returns its exit status."""
    options, changes = parse_run_and_env_options("evaluate", EvaluateOptions, arguments)
    if options is None:
        return 0
    from jaxpg.store import policies
    from jaxpg.store.cache import compilation_cache, physics_cache
    from jaxpg.watch import episodes

    if options.backend == "mujoco":
        changes |= _make_mujoco_changes(options.run)
    with physics_cache(options.cache):
        divided = options.policy in ("jax", "baseline")
        stored = policies.load(options.run, options.checkpoint, options.agent, changes, divided)
    play = episodes.play_gymnasium if options.backend == "gymnasium" else episodes.play_native
    with _choose_player(stored, options.policy) as player, compilation_cache(options.cache, print):
        results = play(player, options.episodes, options.seed)
    how = options.backend if options.policy == "jax" else f"{options.backend}, as {options.policy}"
    print(f"{stored.config.task}, {stored.agent}, {stored.describe(options.checkpoint)}, {how}")
    for name, value in _format_results(results).items():
        print(f"{name:<8} {value}")
    if options.json:
        print(json.dumps(_summarize(results), allow_nan=False))
    return 0


def _format_results(results: Results) -> dict[str, str]:
    """The lines to print, by name; for diverged episodes see `jaxpg.store.statistics.penalize_diverged`."""
    number, num_diverged = len(results.returns), int(results.diverged.sum())
    mean, stderr = _mean(results.returns)
    rows = {"return": f"{mean:.2f} +- {stderr:.2f} (mean and standard error, {number} episodes)"}
    if num_diverged == number:
        rows["return"] = f"n/a: the physics of all {number} episodes diverged"
    elif num_diverged:
        rows["diverged"] = f"{num_diverged} of {number} episodes, each counted as the worst of the others, at most 0"
    for name, values in results.metrics.items():
        rows[name] = _format_metric(name, float(finite_mean(values)))
    return rows


def _format_metric(name: str, value: float) -> str:
    if not math.isfinite(value):
        return "n/a"
    return f"{value:.2%}" if name == "success" else f"{value:.4g} on average at the end"


def _summarize(results: Results) -> dict[str, Any]:
    """The results as numbers; None if there is no such number."""
    mean, stderr = _mean(results.returns)
    success = finite_mean(results.metrics["success"]) if "success" in results.metrics else math.nan
    numbers = {"mean": mean, "stderr": stderr, "success": float(success)}
    counts = {"episodes": len(results.returns), "diverged": int(results.diverged.sum())}
    return {name: value if math.isfinite(value) else None for name, value in numbers.items()} | counts


def _mean(returns: Any) -> tuple[float, float]:
    """Mean and standard error; the latter is NaN for a single episode."""
    number = len(returns)
    return float(returns.mean()), float(returns.std(ddof=1)) / math.sqrt(number) if number > 1 else math.nan


def _make_mujoco_changes(run: str) -> dict[str, str]:
    """The changed options with which C MuJoCo steps the run's environment, with all that collides in its model.

    Raises:
      UserError: there is no run, or C MuJoCo cannot step its environment.
    """
    from jaxpg.store import folder

    stored = config_file.load(folder.find(run).config)
    if not hasattr(stored.env, "physics"):
        raise UserError(f"backend=mujoco: env={stored.choices['env']} is not stepped by MuJoCo; backend=mjx plays it")
    return {"env.physics": "mujoco"} | ({"env.collision": "all"} if hasattr(stored.env, "collision") else {})


def _choose_player(stored: Any, form: str) -> AbstractContextManager[Any]:
    """The stored policy itself, its export, or the controller that it is compared with."""
    if form == "jax":
        return nullcontext(stored)
    if form == "baseline":
        from jaxpg.watch import episodes

        return nullcontext(episodes.replace_by_baseline(stored))
    from jaxpg.deploy.exporter import replace_by_export

    return replace_by_export(stored, form)
