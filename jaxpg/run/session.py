"""A training run from beginning to end: the loop on the host around the compiled chunks."""

from __future__ import annotations

import dataclasses
import importlib
import io
import shlex
import time
from collections.abc import Callable, Mapping
from signal import Signals
from typing import Any, NamedTuple

import jax
import numpy as np

from envs.base import interface
from jaxpg.divergence import BOUND
from jaxpg.run import agents, figures, folder, lock, memory, registered, results, same_run, versions
from jaxpg.run import config as configuration
from jaxpg.run.attempts import attempt
from jaxpg.run.cache import compilation_cache, physics_cache, timed
from jaxpg.run.chunks import PATIENCE, Watch, summary
from jaxpg.run.config import Config
from jaxpg.run.errors import UserError
from jaxpg.run.folder import RunFolder, jsonable
from jaxpg.run.keeper import Keeper
from jaxpg.run.lines import up_to
from jaxpg.run.loggers import follower
from jaxpg.run.metrics_log import MetricsLog
from jaxpg.run.names import own_metrics
from jaxpg.run.program import Program, Schedule, compile_program, described_jump, make_env, plan
from jaxpg.run.runtime import prepare
from jaxpg.run.schema import Run
from jaxpg.run.signals import StopRequests
from jaxpg.run.state import Best, RunState, better, current_policy
from jaxpg.run.statistics import counted_returns, finite_mean
from jaxpg.run.terminal import Display, shown
from jaxpg.run.watchdog import Watchdog
from jaxpg.types import TrainState

# Slow to import and not needed before training: imported while XLA compiles.
NEEDED_LATER = ("jaxpg.run.checkpoint", "tensorboardX", "matplotlib.figure", "matplotlib.backends.backend_agg")
EXPLODED = 4  # the exit status of a run that ended because its numbers were not finite any more
NOT_SAVED = 5  # the exit status of a run whose last state is on no disk


class Session(NamedTuple):
    """What a run is, how it is divided, where it is kept and where it shows."""

    config: Config
    schedule: Schedule
    run_folder: RunFolder
    display: Display


def begin(config: Config, check: Callable[[RunFolder], None] = folder.check_empty) -> int:
    """Trains from the beginning; returns the exit status.

    Args:
      config: of the run.
      check: raises UserError where the folder holds what must not be overwritten.
    """
    prepare(config)
    follower.check(config.run.loggers)
    env = _env(config)  # before anything is written: it may have a mistake to report
    run_folder = folder.planned(config)
    lock.check_free(run_folder.path)
    check(run_folder)
    with folder.owned(run_folder, print):
        check(run_folder)  # another process may have been there just now
        return _begin(config, env, run_folder)


def _begin(config: Config, env: Any, run_folder: RunFolder) -> int:
    schedule, run = plan(config), config.run
    folder.write_versions(run_folder)
    folder.replace(run_folder.config, configuration.to_yaml(config))
    display = Display(schedule.total_steps, num_agents=config.num_agents)
    display.say(
        f"{agents.described(config)}: {run.num_envs} environments x {run.num_steps} steps x "
        f"{schedule.num_updates:,} updates = {schedule.total_steps:,} steps, into {run_folder.path}"
    )
    session = Session(config, schedule, run_folder, display)
    program, seconds = _compile(session, env)
    state = program.init()
    _check_start(np.asarray(state.train.env_state.obs), env)
    return _train(session, program, state, seconds)


def _check_start(obs: np.ndarray, env: Any) -> None:
    """Raises UserError where an observation of the first episodes, `[S, N, n]`, is one of a physics that diverged."""
    outside = ~(np.abs(obs) <= BOUND)
    if outside.any():
        place = int(np.argmax(outside.any(axis=(0, 1))))
        names = interface(env).observations
        name = f" ({names[place]})" if place < len(names) else ""
        size = obs[..., place][outside[..., place]][0]
        raise UserError(
            f"observation {place}{name} is {size:.3g} after a reset: numbers that are not finite or beyond {BOUND:.0e} "
            f"count as diverged; give it in units in which it is smaller"
        )


def resume(given: Mapping[str, Any]) -> int:
    """Goes on from the newest checkpoint of the run in `given["resume"]`; returns the exit status."""
    changes = {name: value for name, value in given.items() if name != "resume"}
    run_folder = folder.find(str(given["resume"]))
    with folder.owned(run_folder, print):
        stored = configuration.load(run_folder.config)
        config = configuration.change(stored, changes)
        same_run.check_options(run_folder, stored, config, changes)
        return _go_on(stored, config, run_folder)


def begin_or_resume(config: Config) -> int:
    """Goes on with the run in `run_dir` where there is something to resume, and else begins it; the exit status.

    Args:
      config: all options of the run, as for a new one.
    """
    if config.run.run_dir is None:
        raise UserError("resume=auto needs run_dir=DIR: the folder to begin in, or to resume from")
    run_folder = folder.planned(config)
    if not folder.has_checkpoints(run_folder):
        return begin(config, folder.check_nothing_to_lose)
    with folder.owned(run_folder, print):
        stored = configuration.load(run_folder.config)
        # The folder may have been moved, or be given in other words.
        config = dataclasses.replace(config, run=dataclasses.replace(config.run, run_dir=stored.run.run_dir))
        same_run.check_options(run_folder, stored, config, configuration.named(stored) | configuration.named(config))
        return _go_on(stored, config, run_folder)


def _go_on(stored: Config, config: Config, run_folder: RunFolder) -> int:
    from jaxpg.run.checkpoint import Checkpoints

    recorded = folder.read_versions(run_folder)
    follower.check(config.run.loggers)
    prepare(config, recorded.get("threads"))  # before orbax restores anything, which starts the backend as well
    checkpoints = Checkpoints(run_folder.checkpoints)
    if checkpoints.latest() is None:
        raise UserError(
            f"{run_folder.path} has no checkpoint yet: begin again in another run_dir, or here with resume=auto"
        )
    update, problems = checkpoints.newest_sound()
    same_run.check_checkpoint(checkpoints, update, config)
    schedule = plan(config)
    display = Display(schedule.total_steps, update * schedule.steps_per_update, config.num_agents)
    for problem in problems:
        display.say(f"note: {problem}; the one before it is used")
    session = Session(config, schedule, run_folder, display)
    if update >= schedule.num_updates:
        _draw(session)
        display.say(f"{run_folder.path} is finished; a larger total_steps goes on")
        return 0
    lines = up_to(folder.read_metrics(run_folder, config.num_agents), update)
    if is_solved(config.run, results.best_returns(lines)):
        display.say(f"{run_folder.path} has reached stop_return={config.run.stop_return:g}; a higher one goes on")
        return 0
    display.say(
        f"resuming {run_folder.path} at {update * schedule.steps_per_update:,} of {schedule.total_steps:,} steps"
    )
    jump = described_jump(stored, config, update)
    if jump:
        display.say(f"note: {jump}")
    now = versions.versions()
    changed = versions.changes(recorded, now)
    for change in changed.items():
        display.say(f"note: {versions.described(*change)}")
    program, seconds = _compile(session, _env(config), resumed=True)
    state = checkpoints.restore(update, program.state_shape)
    if config.run.nan_policy == "skip":
        state = state._replace(train=_side_by_side(state.train))
    folder.replace(run_folder.config, configuration.to_yaml(config))
    if changed:
        folder.change_versions(run_folder, recorded, now)
    return _train(session, program, state, seconds)


def _env(config: Config) -> Any:
    """The environment of a run that fits into memory."""
    with physics_cache(config.run.cache):
        env = make_env(config)
    memory.check(config, env)
    return env


def _compile(session: Session, env: Any, resumed: bool = False) -> tuple[Program, float]:
    """The compiled program, and the seconds that it took."""
    config, display, began = session.config, session.display, time.monotonic()
    what = f"{config.choices['algo']} on {config.task}, network={config.choices['network']}"
    name = f"{what} {config.num_shards} {config.run.vmap_seeds} {resumed}"
    with (
        timed(config.run.cache, name) as before,
        display.working(f"compiling {what} ({before})"),
        compilation_cache(config.run.cache, display.say),
    ):
        program = compile_program(config, env, session.schedule.chunk, resumed=resumed, meanwhile=_import_the_rest)
    seconds = time.monotonic() - began
    display.say(f"compiled in {seconds:.1f} s")
    return program, seconds


def _import_the_rest() -> None:
    for name in NEEDED_LATER:
        importlib.import_module(name)


def _train(session: Session, program: Program, state: RunState, compile_seconds: float) -> int:
    """Chunk after chunk until the last update or a request to stop; returns the exit status."""
    config, schedule, run_folder, display = session
    solved = False
    first = update = _update(state.train)
    keeper = Keeper(config, run_folder, display.say)  # before the log, which has files and processes to close
    log = MetricsLog(run_folder, update, display.say, config.run.loggers, config.num_agents)
    watch, watchdog = Watch(config, display.say, min(PATIENCE, schedule.num_updates - first)), Watchdog()
    began, seconds_before = time.monotonic(), log.seconds
    display.start()
    try:
        with StopRequests() as stop:
            while update < schedule.num_updates and not (solved or stop.signal or watch.nobody_goes_on):
                number = schedule.until_next_line(update)
                with watchdog.chunk(f"update {update + 1:,} to {update + number:,}"):
                    train, metrics = jax.block_until_ready(program.advance(state.train, number))
                watch.look(state.train, metrics)
                made = _update(train) - update
                if not made:
                    break
                state, update = state._replace(train=train), update + made
                line = {"update": update, "steps": update * schedule.steps_per_update}
                line |= summary({name: x[:, :made] for name, x in metrics.items()})
                if schedule.is_due(update, schedule.eval_every):
                    state, evaluation = _evaluate(program, state)
                    line |= evaluation
                    solved = is_solved(config.run, state.best.episode_return)
                line["seconds"] = round(seconds_before + time.monotonic() - began, 3)
                log.write(line)
                display.update(line)
                if schedule.is_due(update, schedule.checkpoint_every) or keeper.failed:
                    keeper.save(update, state, log)
            if update > first and keeper.saved != update:
                keeper.save(update, state, log)
    finally:
        display.stop()
        training_seconds = time.monotonic() - began
        log.close()  # which may wait for a while
    status, text = _ending(session, update, watch, keeper, solved, stop.signal)
    if text:
        display.say(text)
    if status:
        return status
    rate = (update - first) * schedule.steps_per_update * config.num_agents / training_seconds
    _show_results(session, rate, compile_seconds, training_seconds)
    return 0


def _ending(
    session: Session, update: int, watch: Watch, keeper: Keeper, solved: bool, stopped: Signals | None
) -> tuple[int, str | None]:
    """The exit status of a run that ended after `update` updates, and what is to be said of it."""
    run, schedule = session.config.run, session.schedule
    steps, again = f"{update * schedule.steps_per_update:,} steps", f"resume={session.run_folder.path}"
    if watch.nobody_goes_on:
        advice = f"{again} nan_policy=skip leaves it out"
        if run.nan_policy == "skip":
            advice = f"the last {watch.in_a_row:,} updates could not be applied; {again} tries further ones"
        return EXPLODED, f"error: {watch.problem}; stopped at {steps}; {advice}"
    if keeper.failed:
        return NOT_SAVED, f"error: the last state, at {steps}, could not be saved; {again} repeats what is lost"
    if solved:
        return 0, f"reached stop_return={run.stop_return:g} after {steps}"
    if stopped and update < schedule.num_updates:
        return 128 + stopped, f"{stopped.name}: stopped at {steps}; {again} goes on"
    return 0, None


def _show_results(session: Session, rate: float, compile_seconds: float, training_seconds: float) -> None:
    """The learning curve, the settings of a sweep and the table at the end."""
    config, display, lines = session.config, session.display, _draw(session)
    if config.sweep:
        display.say(results.heading(config))
        display.table(results.table(config, lines))
    env = config.choices["env"]
    display.table(_closing_rows(lines, env, session.run_folder, rate, compile_seconds, training_seconds))
    if config.run.report:
        _write_report(session)


def _write_report(session: Session) -> None:
    """The page of the run."""
    from jaxpg.watch import report

    path, cache, say = str(session.run_folder.path), session.config.run.cache, session.display.say
    attempt("report", lambda: report.of_run(path, None, cache, say), _noting(session))


def _noting(session: Session) -> Callable[[str], None]:
    return lambda line: session.display.say(f"note: {line}")


def _update(train: TrainState) -> int:
    """The updates made, by the agents that still go on; read by numpy, as jax would compile a program for it."""
    return int(np.asarray(train.update).max())


def _side_by_side(train: TrainState) -> TrainState:
    """Agents that have stood still go on with the others: the updates that they have missed count as left out."""
    return train._replace(update=np.full_like(train.update, _update(train)))


def _draw(session: Session) -> list[dict[str, Any]]:
    """Draws the learning curve, if it can be drawn; returns the lines of metrics that it shows."""
    lines = folder.read_metrics(session.run_folder, session.config.num_agents)
    attempt("learning curve", lambda: _draw_curve(session, lines), _noting(session))
    return lines


def _draw_curve(session: Session, lines: list[dict[str, Any]]) -> None:
    config, title, picture = session.config, agents.described(session.config), io.BytesIO()
    if config.sweep:
        figures.sweep_curves(lines, picture, title, results.curves(config, lines))
    else:
        figures.learning_curve(lines, picture, title)
    folder.replace(session.run_folder.learning_curve, picture.getvalue())


def _evaluate(program: Program, state: RunState) -> tuple[RunState, dict[str, Any]]:
    """The deterministic policy's results, and the state with the best policy kept."""
    policy = current_policy(state.train)
    episodes = jax.tree.map(np.asarray, program.evaluate(policy))
    returns = counted_returns(episodes.episode_return, episodes.diverged).mean(axis=-1)
    found = {name: finite_mean(value) for name, value in own_metrics(episodes.metrics).items()}
    found |= {"return": returns, "diverged": episodes.diverged.sum(axis=-1)}
    best = better(state.best, Best(policy, returns.astype(np.float32)))
    return state._replace(best=best), {f"eval_{name}": jsonable(value) for name, value in found.items()}


def is_solved(run: Run, best_returns: np.ndarray) -> bool:
    """Whether all agents, or one of them, have reached the return at which the run ends."""
    if run.stop_return is None:
        return False
    reached = np.asarray(best_returns) >= run.stop_return
    return bool(reached.all() if run.stop_agents == "all" else reached.any())


def _closing_rows(
    lines: list[dict[str, Any]],
    env: str,
    run_folder: RunFolder,
    rate: float,
    compile_seconds: float,
    training_seconds: float,
) -> dict[str, str]:
    evaluations = [line for line in lines if "eval_return" in line]
    last = evaluations[-1]
    best = results.best_returns(lines)
    rows = {"deterministic return": f"{shown(last['eval_return'])} at the end, {shown(jsonable(best))} at best"}
    if not np.isfinite(best).all():
        rows["best policy"] = "the untrained one: in every evaluation all episodes diverged"
    exploded = np.sum(last.get("eval_diverged", 0))
    if exploded:
        rows["diverged"] = f"{exploded:,.0f} episodes of the last evaluation"
    if "eval_success" in last:
        success = finite_mean(np.array(last["eval_success"], float))
        rows["success"] = f"{success:.1%} at the end" if np.isfinite(success) else "n/a"
    return rows | {
        "speed": f"{rate:,.0f} steps/s",
        "time": f"{compile_seconds:.1f} s compiling, {training_seconds:.1f} s training",
        "run folder": str(run_folder.path),
        "evaluate it": f"{registered.command(env, 'evaluate')} run={shlex.quote(str(run_folder.path))}",
    }
