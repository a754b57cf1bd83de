"""The page of a run: its curves, some of its episodes before and after training, and what it is."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from envs.scenes import references
from jaxpg.config import configuration, repeat
from jaxpg.config.configuration import Config
from jaxpg.program import agents
from jaxpg.program.compile import SELECTION_SEED
from jaxpg.run.terminal import format_metric
from jaxpg.store import config_file, folder, policies, results
from jaxpg.store.cache import compilation_cache, physics_cache
from jaxpg.store.folder import RunFolder
from jaxpg.store.policies import StoredPolicy
from jaxpg.store.statistics import penalize_diverged
from jaxpg.watch.attempts import attempt
from jaxpg.watch.clips import limits_of
from jaxpg.watch.curves import curves, diagnostics, finite
from jaxpg.watch.page import page
from jaxpg.watch.player import episodes
from jaxpg.watch.recording import Recording, record
from jaxpg.watch.seen import seen
from jaxpg.watch.smoothness import NEAR, chatter, share_at_limit
from jaxpg.watch.untrained import untrained

Json = dict[str, Any]
Stages = Mapping[str, StoredPolicy]
MOST = 2**18  # steps that are recorded of each policy: of longer episodes not all that an evaluation plays
UNTRAINED = "before training"
SMOOTHNESS = (
    "Chatter: the mean of |u(t) \u2212 u(t \u2212 1)| / (2 limit) over steps and commands u, 0 % where they stand "
    "still, 100 % where they jump from limit to limit at every step. At a limit: the share of steps and commands "
    f"with |u| \u2265 {NEAR} limit."
)


def of_run(path: str, agent: int | None, cache: bool, say: Callable[[str], None]) -> None:
    """Writes `report.html` into a run folder.

    Args:
      path: the run folder.
      agent: whose episodes are shown, from 0; None takes the one with the best evaluation.
      cache: whether compiled programs are kept.
      say: takes a line when it is written, and one for each thing that could not be drawn.

    Raises:
      UserError: no run, no checkpoint in it, no such agent, or the page cannot be written.
    """
    run_folder = folder.find(path)
    with physics_cache(cache), compilation_cache(cache, say):
        best, last = policies.load_several(path, ["best", "last"], agent)
        stages = {UNTRAINED: untrained(best)}
        if best.has_evaluation:
            stages["best"] = best
        if last.update != best.update or not best.has_evaluation:
            stages["last"] = last
        data = report(run_folder, config_file.load(run_folder.config), stages)
    content = page(data)
    folder.replace(run_folder.report, content)
    for line in data["notes"]:
        say(f"note: {run_folder.report.name} has {line}")
    say(f"{run_folder.report}: {len(content) / 1000:,.0f} kB, to be opened in a browser")


def report(run_folder: RunFolder, config: Config, stages: Stages) -> Json:
    """What the page shows, as plain values; what cannot be drawn is left out, and said in its `notes`.

    Args:
      run_folder, config: of the run.
      stages: one agent at some points of its training, by what they are called.
    """
    lines, notes, stored = folder.read_metrics(run_folder, config.num_agents), [], next(iter(stages.values()))

    def part(what: str, draw: Callable[[], Any], otherwise: Any = None) -> Any:
        drawn = attempt(what, draw, notes.append)
        return otherwise if drawn is None else drawn

    view = seen(stored.env, notes.append)
    starts = _starts(config)
    recordings = part("episodes", lambda: record(stored, [one.policy for one in stages.values()], starts, view))
    compared = part("returns to compare with", lambda: _references(config, stored, stages, recordings), {})
    shown_agent = [["episodes of", stored.agent]] if config.num_agents > 1 else []
    data = {
        "kind": "run",
        "title": agents.described(config),
        "facts": [*_progress(config, lines), *shown_agent, ["run folder", str(run_folder.path)]],
        "head": recordings and part("table of policies", lambda: _policies(config, stages, recordings, compared)),
        "curves": part("learning curves", lambda: curves(config, lines, compared), []),
        "diagnostics": part("diagnostics", lambda: diagnostics(config, lines), []),
        "tables": _settings(config, lines),
        "improvement": None,
        "command": part("command", lambda: repeat.command(config)),
        "configuration": part("configuration", lambda: _configuration(config), []),
        "versions": part("versions", lambda: _versions(run_folder), []),
        **{"player": None, "portrait": None, "workspace": None},
    }
    played = recordings and part("episodes", lambda: episodes(view, stages, recordings, notes.append))
    return finite(data | (played or {}) | {"notes": notes})


def _starts(config: Config) -> jax.Array:
    """Those of the run's evaluations; of long episodes the first that are `MOST` steps."""
    number = max(1, min(config.run.eval_episodes, MOST // config.env.episode_length))
    return jax.random.split(jax.random.key(SELECTION_SEED), config.run.eval_episodes)[:number]


def _progress(config: Config, lines: Sequence[Json]) -> list[list[str]]:
    """How long it was trained; of several agents how good they are together, as the table is about one of them."""
    if not lines:
        return []
    last = lines[-1]
    rows = [["trained", f"{last['steps']:,} steps in {last['seconds']:.1f} s, {last['update']:,} updates"]]
    evaluated = [line for line in lines if "eval_return" in line]
    if evaluated and config.num_agents > 1:
        best = format_metric(folder.to_json(results.best_returns(lines)))
        mean = f"{format_metric(evaluated[-1]['eval_return'])} at the last evaluation, {best} at the best of each"
        rows.append([f"mean return of {config.num_agents} agents", mean])
    return rows


def _policies(config: Config, stages: Stages, recordings: Sequence[Recording], compared: Mapping[str, float]) -> Json:
    """What each policy earns, and how smoothly; below them what else there is to compare with."""
    measured = [
        _measured(label, stage, recording) for (label, stage), recording in zip(stages.items(), recordings, strict=True)
    ]
    measured += [
        {"policy": label, "return": f"{value:.1f}"} for label, value in compared.items() if label not in stages
    ]
    columns = list(dict.fromkeys(name for one in measured for name in one))
    number, of = len(recordings[0].length), config.run.eval_episodes
    which = "the episodes" if number == of else f"the first {number} of the {of} episodes"
    return {
        "title": "policies",
        "columns": columns,
        "rows": [[one.get(name, "") for name in columns] for one in measured],
        "note": f"Mean and standard error over {which} of an evaluation while training. {SMOOTHNESS}",
    }


def _measured(label: str, stage: StoredPolicy, recording: Recording) -> dict[str, str]:
    """A row of the table: what there is to say of a policy, by column."""
    every, limits = np.arange(len(recording.length)), limits_of(stage)
    row = {"policy": label, "return": _earned(recording)}
    if "success" in recording.metrics:
        row["success"] = _percent(recording.metrics["success"][recording.length - 1, every])
    row["chatter"] = _percent(chatter(recording.command, limits, recording.length))
    row["at a limit"] = _percent(share_at_limit(recording.command, limits, recording.length))
    row["updates"] = f"{stage.update:,}"
    return row | ({"diverged": str(int(recording.diverged.sum()))} if recording.diverged.any() else {})


def _earned(recording: Recording) -> str:
    """Mean return and its standard error."""
    returns = penalize_diverged(recording.episode_return, recording.diverged)
    if not np.isfinite(returns).all():
        return "n/a"
    mean = f"{returns.mean():.1f}"
    return mean if len(returns) == 1 else f"{mean} ± {returns.std(ddof=1) / math.sqrt(len(returns)):.1f}"


def _percent(values: np.ndarray) -> str:
    """Mean of those that are numbers."""
    numbers = values[np.isfinite(values)]
    return f"{100 * numbers.mean(dtype=float):.1f} %" if len(numbers) else "n/a"


def _references(
    config: Config, stored: StoredPolicy, stages: Stages, recordings: Sequence[Recording] | None
) -> dict[str, float]:
    """Returns to compare with: of the untrained policy, the one that ends the run, those the environment knows."""
    found = {str(label): float(value) for label, value in references(stored.env).items()}
    if config.run.stop_return is not None:
        found["stop_return"] = config.run.stop_return
    for label, recording in zip(stages, recordings or [], strict=False):
        if label == UNTRAINED:
            found[label] = float(penalize_diverged(recording.episode_return, recording.diverged).mean())
    return {label: value for label, value in found.items() if math.isfinite(value)}


def _configuration(config: Config) -> list[list[str | None]]:
    """Name and value of each option, and its default where that is another; where the run is kept is no difference."""
    values = configuration.named(config)
    defaults = repeat.defaults(config) | {name: values[name] for name in repeat.NOT_REPEATED}
    return [
        [name, str(value), None if value == defaults.get(name) else str(defaults.get(name))]
        for name, value in values.items()
    ]


def _versions(run_folder: RunFolder) -> list[list[str]]:
    """What computes the run now; where others have computed parts of it, what they were, too."""
    recorded = folder.read_versions(run_folder)
    all_parts = [*recorded.pop("earlier", []), recorded]
    return [[name, ", then ".join(dict.fromkeys(str(part.get(name)) for part in all_parts))] for name in recorded]


def _settings(config: Config, lines: Sequence[Json]) -> list[Json]:
    if not config.sweep:
        return []
    rows = [[setting, score] for setting, score in results.make_table(config, lines).items()]
    return [
        {
            "title": results.make_heading(config).rstrip(":"),
            "columns": ["setting", "return"],
            "rows": rows,
            "note": None,
        }
    ]
