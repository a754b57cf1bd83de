"""What can be said of a run folder without running anything."""

from __future__ import annotations

from typing import Any, NamedTuple

from jaxpg.config.configuration import Config
from jaxpg.program import agents
from jaxpg.program.backend import prepare
from jaxpg.program.schedule import Schedule, plan
from jaxpg.run.loop import is_solved
from jaxpg.run.terminal import shown
from jaxpg.store import config_file, folder, lock, same_run, versions
from jaxpg.store.checkpoint import Checkpoints
from jaxpg.store.checkpoint_errors import CheckpointError
from jaxpg.store.folder import RunFolder, jsonable
from jaxpg.store.lines import up_to
from jaxpg.store.results import best_returns, table


class Inspection(NamedTuple):
    """A run as its folder shows it.

    Attributes:
      run_folder, config: of the run.
      checkpoints: the problem of each checkpoint by its number, None where it is sound and of this run; the newest
        first.
      update: of the newest sound checkpoint; 0 where there is none.
      schedule: of the run.
      finished: whether nothing is left to do.
      owner: the process that is training in it just now, such as "process 12 on atlas"; None where there is none.
      digest: of the state in the newest sound checkpoint; two runs are at the same point, bit for bit, where it is the
        same. None where there is none.
      lines: of metrics.
      changed: name -> (what it was when the run last went on, what it is now), of versions and machine.
      earlier: versions and machines that have computed parts of the run before those.
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
    """Looks at the run in the folder `path`.

    Raises:
      UserError: it is no run folder, or its configuration or versions cannot be read.
    """
    run_folder = folder.find(path)
    config = config_file.load(run_folder.config)
    lines = folder.read_metrics(run_folder, config.num_agents)
    prepare(config)  # as for a training, whose versions are compared
    stored = Checkpoints(run_folder.checkpoints, read_only=True)
    checkpoints = {number: _problem(stored, number, config) for number in stored.numbers()}
    sound = [number for number, problem in checkpoints.items() if problem is None]
    update = sound[0] if sound else 0
    schedule = plan(config)
    best_of_checkpoint = best_returns(up_to(lines, update))
    before = folder.read_versions(run_folder)
    return Inspection(
        run_folder=run_folder,
        config=config,
        checkpoints=checkpoints,
        update=update,
        schedule=schedule,
        finished=bool(sound) and (update >= schedule.num_updates or is_solved(config.run, best_of_checkpoint)),
        owner=lock.owner(run_folder.path),
        digest=stored.digest(update) if sound else None,
        lines=lines,
        changed=versions.changes(before, versions.versions()),
        earlier=len(before.get("earlier", [])),
    )


def _problem(checkpoints: Checkpoints, number: int, config: Config) -> CheckpointError | None:
    try:
        checkpoints.read(number)
        same_run.check_checkpoint(checkpoints, number, config)
    except CheckpointError as error:
        return error
    return None


def summary(found: Inspection) -> dict[str, Any]:
    """The inspection as plain values: `step` counts updates, as checkpoints do, and `steps` environment steps."""
    return {
        "step": found.update,
        "steps": found.update * found.schedule.steps_per_update,
        "finished": found.finished,
        "owner": found.owner,
        "digest": found.digest,
        "checkpoints": [{"step": number, "sound": problem is None} for number, problem in found.checkpoints.items()],
    }


def described(found: Inspection) -> str:
    """The inspection in words, a line for each thing."""
    done, total = found.update * found.schedule.steps_per_update, found.schedule.total_steps
    checkpoints = [f"{number} {problem.word if problem else 'sound'}" for number, problem in found.checkpoints.items()]
    rows = {
        "run": agents.described(found.config),
        "progress": f"{done:,} of {total:,} steps, " + ("finished" if found.finished else "not finished"),
        "checkpoints": ", ".join(checkpoints) or "none",
    }
    if found.owner:
        rows["training"] = f"just now, by {found.owner}"
    rows |= _returns(found) | {"versions": _versions(found), "digest": found.digest or "none"}
    problems = [f"{problem.word}: {problem}" for problem in found.checkpoints.values() if problem]
    return "\n".join([f"{name:<12} {value}" for name, value in rows.items()] + problems)


def _returns(found: Inspection) -> dict[str, str]:
    """What the evaluations say; nothing before the first."""
    evaluations = [line["eval_return"] for line in found.lines if "eval_return" in line]
    if not evaluations:
        return {}
    best = jsonable(best_returns(found.lines))
    rows = {"return": f"{shown(evaluations[-1])} at the last evaluation, {shown(best)} at best"}
    if found.config.sweep:
        setting, score = next(iter(table(found.config, found.lines).items()))
        rows["best setting"] = f"{setting}: {score}"
    return rows


def _versions(found: Inspection) -> str:
    changes = ", ".join(f"{name} was {was} and is {now}" for name, (was, now) in found.changed.items())
    earlier = f"; {found.earlier} others before (versions.json)" if found.earlier else ""
    return (changes or "as they are now") + earlier
