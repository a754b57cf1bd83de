"""The page of a run: its curves, some of its episodes before and after training, and what it is."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax

from jaxpg.run import agents, folder, policies, results
from jaxpg.run import config as configuration
from jaxpg.run.cache import compilation_cache, physics_cache
from jaxpg.run.config import Config
from jaxpg.run.folder import RunFolder
from jaxpg.run.policies import StoredPolicy
from jaxpg.run.program import SELECTION_SEED
from jaxpg.run.statistics import counted_returns
from jaxpg.run.terminal import shown
from jaxpg.watch.curves import curves, finite
from jaxpg.watch.page import page
from jaxpg.watch.player import episodes
from jaxpg.watch.recording import Recording, record

Json = dict[str, Any]
PLAYED = 200  # episodes of each policy, where an evaluation has as many


def of_run(path: str, agent: int | None, cache: bool, say: Callable[[str], None]) -> None:
    """Writes `report.html` into a run folder.

    Args:
      path: the run folder.
      agent: whose episodes are shown, from 0; None takes the one with the best evaluation.
      cache: whether compiled programs are kept.
      say: takes a line when it is written.

    Raises:
      UserError: no run, no checkpoint in it, no such agent, or the page cannot be written.
    """
    run_folder = folder.find(path)
    with physics_cache(cache), compilation_cache(cache, say):
        best, last = policies.load_several(path, ["best", "last"], agent)
        stages = {"before training": policies.untrained(best)}
        if best.evaluated:
            stages["best"] = best
        if last.update != best.update or not best.evaluated:
            stages["last"] = last
        content = page(report(run_folder, configuration.load(run_folder.config), stages))
    folder.replace(run_folder.report, content)
    say(f"{run_folder.report}: {len(content) / 1000:,.0f} kB, to be opened in a browser")


def report(run_folder: RunFolder, config: Config, stages: Mapping[str, StoredPolicy]) -> Json:
    """What the page shows, as plain values.

    Args:
      run_folder, config: of the run.
      stages: one agent at some points of its training, by what they are called.
    """
    lines, stored = folder.read_metrics(run_folder, config.num_agents), next(iter(stages.values()))
    number = min(PLAYED, config.run.eval_episodes)
    starts = jax.random.split(jax.random.key(SELECTION_SEED), config.run.eval_episodes)[:number]
    recordings = record(stored, [stage.policy for stage in stages.values()], starts)
    shown_agent = [["episodes of", stored.agent]] if config.num_agents > 1 else []
    data = {
        "kind": "run",
        "title": agents.described(config),
        "facts": [*_progress(lines), *shown_agent, *_returns(stages, recordings), ["run folder", str(run_folder.path)]],
        "curves": curves(config, lines),
        "tables": _settings(config, lines),
        "improvement": None,
        "configuration": [[name, str(value)] for name, value in configuration.named(config).items()],
        "versions": _versions(run_folder),
    }
    return finite(data | episodes(stages, recordings))


def _progress(lines: Sequence[Json]) -> list[list[str]]:
    if not lines:
        return []
    last = lines[-1]
    rows = [["trained", f"{last['steps']:,} steps in {last['seconds']:.1f} s, {last['update']:,} updates"]]
    evaluated = [line for line in lines if "eval_return" in line]
    if evaluated:
        best = folder.jsonable(results.best_returns(lines))
        rows.append(["return", f"{shown(evaluated[-1]['eval_return'])} at the last evaluation, {shown(best)} at best"])
    return rows


def _returns(stages: Mapping[str, StoredPolicy], recordings: Sequence[Recording]) -> list[list[str]]:
    """Of each policy, over all of its episodes."""
    rows = []
    for label, recording in zip(stages, recordings, strict=True):
        returns = counted_returns(recording.episode_return, recording.diverged)
        error = returns.std(ddof=1) / math.sqrt(len(returns)) if len(returns) > 1 else math.nan
        exploded = f", {recording.diverged.sum()} of which diverged" if recording.diverged.any() else ""
        rows.append([f"return, {label}", f"{returns.mean():.1f} ± {error:.1f} over {len(returns)} episodes{exploded}"])
    return rows


def _versions(run_folder: RunFolder) -> list[list[str]]:
    """What computes the run now; where others have computed parts of it, what they were, too."""
    recorded = folder.read_versions(run_folder)
    all_parts = [*recorded.pop("earlier", []), recorded]
    return [[name, ", then ".join(dict.fromkeys(str(part.get(name)) for part in all_parts))] for name in recorded]


def _settings(config: Config, lines: Sequence[Json]) -> list[Json]:
    if not config.sweep:
        return []
    rows = [[setting, score] for setting, score in results.table(config, lines).items()]
    return [{"title": results.heading(config).rstrip(":"), "columns": ["setting", "return"], "rows": rows}]
