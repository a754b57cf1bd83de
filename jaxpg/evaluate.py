"""`python -m jaxpg.evaluate run=DIR`: plays a trained policy, deterministically, from fixed starts."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

from jaxpg.run import config
from jaxpg.run.commands import about_a_run_in
from jaxpg.run.errors import UserError, run_command
from jaxpg.run.schema import EvaluateOptions


def main(arguments: Sequence[str]) -> int:
    """The evaluation command; returns its exit status."""
    options, changes = about_a_run_in("evaluate", EvaluateOptions, arguments)
    if options is None:
        return 0
    from jaxpg.run import episodes, policies
    from jaxpg.run.cache import compilation_cache, physics_cache

    if options.backend == "mujoco":
        changes |= _in_mujoco(options.run)
    with physics_cache(options.cache):
        stored = policies.load(options.run, options.checkpoint, options.agent, changes)
    play = episodes.play_gymnasium if options.backend == "gymnasium" else episodes.play_own
    with _playing(stored, options.policy) as player, compilation_cache(options.cache, print):
        returns, metrics = play(player, options.episodes, options.seed)
    mean, stderr = returns.mean(), returns.std(ddof=1) / math.sqrt(len(returns))
    saved = f"{options.checkpoint} policy (saved after {stored.update:,} updates)"
    how = options.backend if options.policy == "jax" else f"{options.backend}, as {options.policy}"
    print(f"{stored.config.task}, {stored.agent}, {saved}, {how}")
    print(f"return   {mean:.2f} +- {stderr:.2f} (mean and standard error, {len(returns)} episodes)")
    for metric, values in metrics.items():
        print(
            f"{metric:<8} {values.mean():.2%}"
            if metric == "success"
            else f"{metric:<8} {values.mean():.4g} on average at the end"
        )
    if options.json:
        success = float(metrics["success"].mean()) if "success" in metrics else None
        print(json.dumps({"mean": float(mean), "stderr": float(stderr), "episodes": len(returns), "success": success}))
    return 0


def _in_mujoco(run: str) -> dict[str, str]:
    """The change to the options of this run by which C MuJoCo steps its environment.

    Raises:
      UserError: no run, or its environment is no model that C MuJoCo could step.
    """
    from jaxpg.run import folder

    stored = config.load(folder.find(run).config)
    if not hasattr(stored.env, "physics"):
        raise UserError(f"backend=mujoco: env={stored.choices['env']} is not stepped by MuJoCo; backend=mjx plays it")
    return {"env.physics": "mujoco"}


def _playing(stored: Any, form: str) -> AbstractContextManager[Any]:
    """The stored policy as it is, or as exported."""
    if form == "jax":
        return nullcontext(stored)
    from jaxpg.deploy.export import as_written

    return as_written(stored, form)


if __name__ == "__main__":
    run_command(main)
