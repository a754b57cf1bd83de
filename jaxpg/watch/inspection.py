"""Describes a run folder without running anything."""

from __future__ import annotations

from typing import Any, NamedTuple

from jaxpg.config.configuration import Config
from jaxpg.program import agents
from jaxpg.program.backend import prepare
from jaxpg.program.schedule import Schedule, plan
from jaxpg.run.loop import is_solved
from jaxpg.run.terminal import format_metric
from jaxpg.store import config_file, folder, lock, same_run, versions, versions_file
from jaxpg.store.checkpoint import Checkpoints
from jaxpg.store.checkpoint_errors import CheckpointError
from jaxpg.store.folder import RunFolder, to_json
from jaxpg.store.lines import select_until
from jaxpg.store.results import best_returns, make_table


class Inspection(NamedTuple):
    """The state of a run, from its folder.

    Attributes:
      run_folder, config, schedule: folder, configuration and schedule of the run.
      checkpoints: number -> problem of the checkpoint, None if it is sound and belongs to this run; newest first.
      update: update of the newest sound checkpoint; 0 if there is none.
      finished: whether nothing is left to do.
      owner: the process that is training in it now, such as "process 12 on atlas", or None.
      digest: digest of the state in the newest sound checkpoint, or None; equal if two runs are bit for bit at the same
        point.
      lines: lines of metrics.
      changed: name -> (value when the run last continued, value now), for versions and machine.
      earlier: number of other versions and machines that computed earlier parts of the run.
    """

    run_folder: RunFolder
    config: Config
    checkpoints: dict[int, CheckpointError | None]
    update: int
    schedule: Schedule
    finished: bool
    owner: str | None
    digest: str | None
    lines: list[dict[str, Any]]
    changed: dict[str, tuple[Any, Any]]
    earlier: int


def inspect(path: str) -> Inspection:
    """Inspects the run in the folder `path`.

    Raises:
      UserError: it is not a run folder, or its configuration or versions cannot be read.
    """
    run_folder = folder.find(path)
    config = config_file.load(run_folder.config)
    lines = folder.read_metrics(run_folder, config.num_agents)
    prepare(config)  # as in training, to compare versions
    stored = Checkpoints(run_folder.checkpoints, read_only=True)
    checkpoints = {number: _find_problem(stored, number, config) for number in stored.numbers()}
    sound = [number for number, problem in checkpoints.items() if problem is None]
    update = sound[0] if sound else 0
    schedule = plan(config)
    best_of_checkpoint = best_returns(select_until(lines, update))
    recorded = versions_file.read(run_folder.versions)
    return Inspection(
        run_folder=run_folder,
        config=config,
        checkpoints=checkpoints,
        update=update,
        schedule=schedule,
        finished=bool(sound) and (update >= schedule.num_updates or is_solved(config.run, best_of_checkpoint)),
        owner=lock.find_owner(run_folder.path),
        digest=stored.digest(update) if sound else None,
        lines=lines,
        changed=versions.find_changes(recorded, versions.collect_versions()),
        earlier=len(recorded.get("earlier", [])),
    )


def _find_problem(checkpoints: Checkpoints, number: int, config: Config) -> CheckpointError | None:
    try:
        checkpoints.read(number)
        same_run.check_checkpoint(checkpoints, number, config)
    except CheckpointError as error:
        return error
    return None


def summarize(inspection: Inspection) -> dict[str, Any]:
    """The inspection as plain values: `step` counts updates, as checkpoints do, and `steps` environment steps."""
    return {
        "step": inspection.update,
        "steps": inspection.update * inspection.schedule.steps_per_update,
        "finished": inspection.finished,
        "owner": inspection.owner,
        "digest": inspection.digest,
        "checkpoints": [
            {"step": number, "sound": problem is None} for number, problem in inspection.checkpoints.items()
        ],
    }


def describe(inspection: Inspection) -> str:
    """The inspection as text, one line per item."""
    done, total = inspection.update * inspection.schedule.steps_per_update, inspection.schedule.total_steps
    checkpoints = [
        f"{number} {problem.word if problem else 'sound'}" for number, problem in inspection.checkpoints.items()
    ]
    rows = {
        "run": agents.describe_run(inspection.config),
        "progress": f"{done:,} of {total:,} steps, " + ("finished" if inspection.finished else "not finished"),
        "checkpoints": ", ".join(checkpoints) or "none",
    }
    if inspection.owner:
        rows["training"] = f"now, by {inspection.owner}"
    rows |= _describe_returns(inspection) | {
        "versions": _describe_versions(inspection),
        "digest": inspection.digest or "none",
    }
    problems = [f"{problem.word}: {problem}" for problem in inspection.checkpoints.values() if problem]
    return "\n".join([f"{name:<12} {value}" for name, value in rows.items()] + problems)


def _describe_returns(inspection: Inspection) -> dict[str, str]:
    """Returns of the evaluations; empty before the first."""
    evaluations = [line["eval_return"] for line in inspection.lines if "eval_return" in line]
    if not evaluations:
        return {}
    best = to_json(best_returns(inspection.lines))
    rows = {"return": f"{format_metric(evaluations[-1])} at the last evaluation, {format_metric(best)} at best"}
    if inspection.config.sweep:
        setting, score = next(iter(make_table(inspection.config, inspection.lines).items()))
        rows["best setting"] = f"{setting}: {score}"
    return rows


def _describe_versions(inspection: Inspection) -> str:
    changes = ", ".join(f"{name} was {old} and is {new}" for name, (old, new) in inspection.changed.items())
    earlier = f"; {inspection.earlier} others before (versions.json)" if inspection.earlier else ""
    return (changes or "unchanged") + earlier
