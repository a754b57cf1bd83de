"""The page of a run: its curves, some episodes before and after training, and its configuration."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from envs.scenes import find_references
from jaxpg.config import configuration, repeat
from jaxpg.config.configuration import Config
from jaxpg.program import agents
from jaxpg.program.compile import SELECTION_SEED
from jaxpg.run.terminal import format_metric
from jaxpg.store import config_file, folder, policies, results, run_files, versions_file
from jaxpg.store.cache import compilation_cache, physics_cache
from jaxpg.store.folder import RunFolder
from jaxpg.store.policies import StoredPolicy
from jaxpg.store.statistics import penalize_diverged
from jaxpg.watch.attempts import attempt
from jaxpg.watch.clips import find_limits
from jaxpg.watch.curves import make_curves, make_diagnostics, replace_nonfinite
from jaxpg.watch.page import make_page
from jaxpg.watch.player import build_player
from jaxpg.watch.recording import Recording, record
from jaxpg.watch.smoothness import NEAR, chatter, share_at_limit
from jaxpg.watch.untrained import make_untrained
from jaxpg.watch.view import find_view

Json = dict[str, Any]
Stages = Mapping[str, StoredPolicy]
MAX_STEPS = 2**18  # recorded steps of each policy; limits the number of long episodes
UNTRAINED = "before training"
SMOOTHNESS = (
    "Chatter: the mean of |u(t) \u2212 u(t \u2212 1)| / (2 limit) over steps and commands u; 0 % if they are "
    "constant, 100 % if they jump from limit to limit at every step. At a limit: the share of steps and commands "
    f"with |u| \u2265 {NEAR} limit."
)


def write_report(path: str, agent: int | None, cache: bool, say: Callable[[str], None]) -> None:
    """Writes `report.html` into a run folder.

    Args:
      path: the run folder.
      agent: index of the agent whose episodes are shown, from 0; None takes the one with the best evaluation.
      cache: whether to cache compiled programs.
      say: takes a line when the page is written, and one for everything that could not be drawn.

    Raises:
      UserError: there is no run, checkpoint or such agent, or the page cannot be written.
    """
    run_folder = folder.find(path)
    with physics_cache(cache), compilation_cache(cache, say):
        best, last = policies.load_several(path, ["best", "last"], agent)
        stages = {UNTRAINED: make_untrained(best)}
        if best.has_evaluation:
            stages["best"] = best
        if last.update != best.update or not best.has_evaluation:
            stages["last"] = last
        data = build_report(run_folder, config_file.load(run_folder.config), stages)
    content = make_page(data)
    run_files.replace(run_folder.report, content)
    for line in data["notes"]:
        say(f"note: {run_folder.report.name} has {line}")
    say(f"{run_folder.report}: {len(content) / 1000:,.0f} kB, open it in a browser")


def build_report(run_folder: RunFolder, config: Config, stages: Stages) -> Json:
    """The data of the page as plain values; whatever cannot be drawn is skipped, with a line in `notes`.

    Args:
      run_folder, config: folder and configuration of the run.
      stages: label -> policy of one agent at that point of its training.
    """
    lines, notes, stored = folder.read_metrics(run_folder, config.num_agents), [], next(iter(stages.values()))

    def try_part(what: str, draw: Callable[[], Any], otherwise: Any = None) -> Any:
        result = attempt(what, draw, notes.append)
        return otherwise if result is None else result

    view = find_view(stored.env, notes.append)
    starts = _make_starts(config)
    recordings = try_part("episodes", lambda: record(stored, [one.policy for one in stages.values()], starts, view))
    references = try_part("returns to compare with", lambda: _find_references(config, stored, stages, recordings), {})
    agent_row = [["episodes of", stored.agent]] if config.num_agents > 1 else []
    data = {
        "kind": "run",
        "title": agents.describe_run(config),
        "facts": [*_describe_progress(config, lines), *agent_row, ["run folder", str(run_folder.path)]],
        "head": recordings
        and try_part("table of policies", lambda: _make_policy_table(config, stages, recordings, references)),
        "curves": try_part("learning curves", lambda: make_curves(config, lines, references), []),
        "diagnostics": try_part("diagnostics", lambda: make_diagnostics(config, lines), []),
        "tables": _make_settings_table(config, lines),
        "improvement": None,
        "command": try_part("command", lambda: repeat.format_command(config)),
        "configuration": try_part("configuration", lambda: _list_options(config), []),
        "versions": try_part("versions", lambda: _list_versions(run_folder), []),
        **{"player": None, "portrait": None, "workspace": None},
    }
    episode_data = recordings and try_part("episodes", lambda: build_player(view, stages, recordings, notes.append))
    return replace_nonfinite(data | (episode_data or {}) | {"notes": notes})


def _make_starts(config: Config) -> jax.Array:
    """The starts of the run's evaluations, as many as make at most `MAX_STEPS` steps."""
    number = max(1, min(config.run.eval_episodes, MAX_STEPS // config.env.episode_length))
    return jax.random.split(jax.random.key(SELECTION_SEED), config.run.eval_episodes)[:number]


def _describe_progress(config: Config, lines: Sequence[Json]) -> list[list[str]]:
    """How long the run was trained; and the mean return of several agents, as the table is about one of them."""
    if not lines:
        return []
    last = lines[-1]
    rows = [["trained", f"{last['steps']:,} steps in {last['seconds']:.1f} s, {last['update']:,} updates"]]
    evaluations = [line for line in lines if "eval_return" in line]
    if evaluations and config.num_agents > 1:
        best = format_metric(folder.to_json(results.best_returns(lines)))
        mean = f"{format_metric(evaluations[-1]['eval_return'])} at the last evaluation, {best} at the best of each"
        rows.append([f"mean return of {config.num_agents} agents", mean])
    return rows


def _make_policy_table(
    config: Config, stages: Stages, recordings: Sequence[Recording], references: Mapping[str, float]
) -> Json:
    """The return and smoothness of each policy, followed by the references."""
    rows = [
        _measure(label, stage, recording) for (label, stage), recording in zip(stages.items(), recordings, strict=True)
    ]
    rows += [{"policy": label, "return": f"{value:.1f}"} for label, value in references.items() if label not in stages]
    columns = list(dict.fromkeys(name for one in rows for name in one))
    number, of = len(recordings[0].length), config.run.eval_episodes
    which = "the episodes" if number == of else f"the first {number} of the {of} episodes"
    return {
        "title": "policies",
        "columns": columns,
        "rows": [[one.get(name, "") for name in columns] for one in rows],
        "note": f"Mean and standard error over {which} of an evaluation during training. {SMOOTHNESS}",
    }


def _measure(label: str, stage: StoredPolicy, recording: Recording) -> dict[str, str]:
    """A row of the table, by column."""
    episodes, limits = np.arange(len(recording.length)), find_limits(stage)
    row = {"policy": label, "return": _format_return(recording)}
    if "success" in recording.metrics:
        row["success"] = _format_percent(recording.metrics["success"][recording.length - 1, episodes])
    row["chatter"] = _format_percent(chatter(recording.command, limits, recording.length))
    row["at a limit"] = _format_percent(share_at_limit(recording.command, limits, recording.length))
    row["updates"] = f"{stage.update:,}"
    return row | ({"diverged": str(int(recording.diverged.sum()))} if recording.diverged.any() else {})


def _format_return(recording: Recording) -> str:
    """Mean return and its standard error, as text."""
    returns = penalize_diverged(recording.episode_return, recording.diverged)
    if not np.isfinite(returns).all():
        return "n/a"
    mean = f"{returns.mean():.1f}"
    return mean if len(returns) == 1 else f"{mean} ± {returns.std(ddof=1) / math.sqrt(len(returns)):.1f}"


def _format_percent(values: np.ndarray) -> str:
    """Mean of the finite values in percent, as text."""
    numbers = values[np.isfinite(values)]
    return f"{100 * numbers.mean(dtype=float):.1f} %" if len(numbers) else "n/a"


def _find_references(
    config: Config, stored: StoredPolicy, stages: Stages, recordings: Sequence[Recording] | None
) -> dict[str, float]:
    """Returns to compare with: of the environment, `stop_return`, and of the untrained policy."""
    returns = {str(label): float(value) for label, value in find_references(stored.env).items()}
    if config.run.stop_return is not None:
        returns["stop_return"] = config.run.stop_return
    for label, recording in zip(stages, recordings or [], strict=False):
        if label == UNTRAINED:
            returns[label] = float(penalize_diverged(recording.episode_return, recording.diverged).mean())
    return {label: value for label, value in returns.items() if math.isfinite(value)}


def _list_options(config: Config) -> list[list[str | None]]:
    """Name and value of each option, and its default if that differs; the run's place is not a difference."""
    values = configuration.to_arguments(config)
    defaults = repeat.compose_defaults(config) | {name: values[name] for name in repeat.NOT_REPEATED}
    return [
        [name, str(value), None if value == defaults.get(name) else str(defaults.get(name))]
        for name, value in values.items()
    ]


def _list_versions(run_folder: RunFolder) -> list[list[str]]:
    """The versions that computed the run, with earlier ones if they differ."""
    recorded = versions_file.read(run_folder.versions)
    all_parts = [*recorded.pop("earlier", []), recorded]
    return [[name, ", then ".join(dict.fromkeys(str(part.get(name)) for part in all_parts))] for name in recorded]


def _make_settings_table(config: Config, lines: Sequence[Json]) -> list[Json]:
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
