"""`python -m jaxpg.evaluate run=DIR`: plays a trained policy, deterministically, from fixed starts."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass

from envs.options import build, describe, option
from jaxpg.run.errors import UserError, run_command


@dataclass(frozen=True)
class EvaluateOptions:
    """Options of the evaluation; options of the environment may be given too, as env.NAME=VALUE."""

    run: str | None = option(None, "run folder; required")
    episodes: int = option(200, "episodes to play", at_least=2)
    seed: int = option(0, "fixes the starts", at_least=0, at_most=2**32 - 1)
    backend: str = option("mjx", "the run's own environment, or Gymnasium's", choices=("mjx", "gymnasium"))
    checkpoint: str = option(
        "best", "the best policy by the evaluations while training, or the last", choices=("best", "last")
    )
    agent: int | None = option(None, "which of several agents, from 0 [default: the best]", at_least=0)
    json: bool = option(False, "end with one line of JSON: mean, stderr, episodes, success")


def main(arguments: Sequence[str]) -> int:
    """The evaluation command; returns its exit status."""
    if {"--help", "-h"} & set(arguments):
        print(help_text())
        return 0
    from jaxpg.run import config, episodes, policies

    given = config.parse(arguments)
    changes = {name: value for name, value in given.items() if name.startswith("env.")}
    options = build(EvaluateOptions, {name: value for name, value in given.items() if name not in changes})
    if options.run is None:
        raise UserError("run=DIR is missing: the folder of the run to evaluate")
    stored = policies.load(options.run, options.checkpoint, options.agent, changes)
    play = episodes.play_gymnasium if options.backend == "gymnasium" else episodes.play_own
    returns, metrics = play(stored, options.episodes, options.seed)
    mean, stderr = returns.mean(), returns.std(ddof=1) / math.sqrt(len(returns))
    saved = f"{options.checkpoint} policy (saved after {stored.update:,} updates)"
    print(f"{stored.config.choices['env']}, seed {stored.seed}, {saved}, {options.backend}")
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


def help_text() -> str:
    """Every option with its default, its range and its meaning."""
    lines = ["usage: python -m jaxpg.evaluate run=DIR [option=value] ...", "", EvaluateOptions.__doc__]
    for field in dataclasses.fields(EvaluateOptions):
        default = "" if field.default is None else str(field.default).lower()
        lines.append(f"  {field.name}={default}".ljust(24) + describe(field))
    return "\n".join(lines)


if __name__ == "__main__":
    run_command(main)
