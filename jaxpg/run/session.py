"""A training run from beginning to end: how it begins or resumes, and its exit status."""

from __future__ import annotations

import dataclasses
import importlib
import time
from collections.abc import Callable, Mapping
from signal import Signals
from typing import Any, NamedTuple

import numpy as np

from envs.base import Env, interface
from jaxpg.config import configuration
from jaxpg.config.configuration import Config
from jaxpg.divergence import BOUND
from jaxpg.errors import UserError
from jaxpg.program import agents, memory
from jaxpg.program.backend import prepare
from jaxpg.program.compile import Program, compile_program
from jaxpg.program.environment import make_env
from jaxpg.program.schedule import describe_jump, plan
from jaxpg.program.state import RunState
from jaxpg.run.loop import Loop, Session, count_updates, is_solved
from jaxpg.run.signals import StopRequests
from jaxpg.run.terminal import Display
from jaxpg.store import config_file, folder, lock, results, run_files, same_run, versions, versions_file
from jaxpg.store.cache import compilation_cache, physics_cache
from jaxpg.store.durations import record_duration
from jaxpg.store.folder import RunFolder
from jaxpg.store.lines import select_until
from jaxpg.store.loggers import follower
from jaxpg.types import TrainState

# Slow to import and only needed after compilation, so they are imported while XLA compiles.
LATE_MODULES = ("jaxpg.store.checkpoint", "tensorboardX", "matplotlib.figure", "matplotlib.backends.backend_agg")
DIVERGED_STATUS = 4  # exit status of a run that ended because its numbers were not finite
NOT_SAVED_STATUS = 5  # exit status of a run whose last state could not be saved


class Times(NamedTuple):
    """How long training took.

    Attributes:
      rate: environment steps per second, over all agents.
      compiling, training: seconds.
    """

    rate: float
    compiling: float
    training: float


# Called with a run that has ended well, while its folder is still locked; times are None if it had ended before.
Finish = Callable[[Session, Times | None], None]


def begin(config: Config, finish: Finish, check: Callable[[RunFolder], None] = folder.check_empty) -> int:
    """Trains from the beginning; returns the exit status.

    Args:
      config: configuration of the run.
      finish: called with a run that has ended with status 0.
      check: raises UserError if the folder holds something that must not be overwritten.
    """
    prepare(config)
    follower.check_installed(config.run.loggers)
    env = _make_env(config)  # before anything is written, as it may raise an error
    run_folder = folder.choose(config)
    lock.check_free(run_folder.path)
    check(run_folder)
    with folder.own(run_folder, print):
        check(run_folder)  # again, now that the folder is locked
        return _begin(config, finish, env, run_folder)


def _begin(config: Config, finish: Finish, env: Env, run_folder: RunFolder) -> int:
    schedule, run = plan(config), config.run
    versions_file.write(run_folder.versions)
    run_files.replace(run_folder.config, configuration.to_yaml(config))
    display = Display(schedule.total_steps, num_agents=config.num_agents)
    display.say(
        f"{agents.describe_run(config)}: {run.num_envs} environments x {run.num_steps} steps x "
        f"{schedule.num_updates:,} updates = {schedule.total_steps:,} steps, into {run_folder.path}"
    )
    session = Session(config, schedule, run_folder, display)
    program, seconds = _compile(session, env)
    assert program.init is not None  # only where a run is resumed
    state = program.init()
    _check_start(np.asarray(state.train.env_state.obs), env)
    return _train(session, finish, program, state, seconds)


def _check_start(obs: np.ndarray, env: Env) -> None:
    """Raises UserError if an initial observation, `[S, N, n]`, is in the range that counts as diverged."""
    outside = ~(np.abs(obs) <= BOUND)
    if outside.any():
        place = int(np.argmax(outside.any(axis=(0, 1))))
        names = interface(env).observations
        name = f" ({names[place]})" if place < len(names) else ""
        size = obs[..., place][outside[..., place]][0]
        raise UserError(
            f"observation {place}{name} is {size:.3g} after a reset: numbers that are not finite or beyond {BOUND:.0e} "
            f"count as diverged; choose units in which it is smaller"
        )


def resume(given: Mapping[str, Any], finish: Finish) -> int:
    """Resumes the run in `given["resume"]` from its newest checkpoint; returns the exit status."""
    changes = {name: value for name, value in given.items() if name != "resume"}
    run_folder = folder.find(str(given["resume"]))
    with folder.own(run_folder, print):
        stored = config_file.load(run_folder.config)
        config = configuration.change(stored, changes)
        same_run.check_options(run_folder, stored, config)
        return _continue(stored, config, finish, run_folder)


def begin_or_resume(config: Config, finish: Finish) -> int:
    """Resumes the run in `run_dir` if it has a checkpoint, else begins it; returns the exit status.

    Args:
      config: all options of the run, as for a new run.
    """
    if config.run.run_dir is None:
        raise UserError("resume=auto needs run_dir=DIR: the folder to begin in, or to resume from")
    run_folder = folder.choose(config)
    if not folder.has_checkpoints(run_folder):
        return begin(config, finish, folder.check_nothing_to_lose)
    with folder.own(run_folder, print):
        stored = config_file.load(run_folder.config)
        # The folder may have been moved, or its path may be written differently.
        config = dataclasses.replace(config, run=dataclasses.replace(config.run, run_dir=stored.run.run_dir))
        same_run.check_options(run_folder, stored, config)
        return _continue(stored, config, finish, run_folder)


def _continue(stored: Config, config: Config, finish: Finish, run_folder: RunFolder) -> int:
    from jaxpg.store.checkpoint import Checkpoints

    recorded_versions = versions_file.read(run_folder.versions)
    follower.check_installed(config.run.loggers)
    prepare(config, recorded_versions.get("threads"))  # before orbax, which starts the backend too
    checkpoints = Checkpoints(run_folder.checkpoints)
    if checkpoints.latest() is None:
        raise UserError(f"{run_folder.path} has no checkpoint yet: start in another run_dir, or here with resume=auto")
    update, problems = checkpoints.newest_sound()
    same_run.check_checkpoint(checkpoints, update, config)
    schedule = plan(config)
    display = Display(schedule.total_steps, update * schedule.steps_per_update, config.num_agents)
    for problem in problems:
        display.say(f"note: {problem}; using the one before it")
    session = Session(config, schedule, run_folder, display)
    if _report_if_finished(session, update):
        finish(session, None)
        return 0
    current_versions = versions.collect_versions()
    changes = versions.find_changes(recorded_versions, current_versions)
    _announce_resume(session, update, describe_jump(stored, config, update), changes)
    program, seconds = _compile(session, _make_env(config), resumed=True)
    state = checkpoints.restore(update, program.state_shape)
    if config.run.nan_policy == "skip":
        state = state._replace(train=_align_updates(state.train))
    run_files.replace(run_folder.config, configuration.to_yaml(config))
    if changes:
        versions_file.change(run_folder.versions, recorded_versions, current_versions)
    return _train(session, finish, program, state, seconds)


def _report_if_finished(session: Session, update: int) -> bool:
    """Whether nothing is left to do after `update` updates; if so, tells the user."""
    config, schedule, run_folder, display = session
    if update >= schedule.num_updates:
        display.say(f"{run_folder.path} is finished; a larger total_steps continues it")
        return True
    lines = select_until(folder.read_metrics(run_folder, config.num_agents), update)
    solved = is_solved(config.run, results.best_returns(lines))
    if solved:
        display.say(f"{run_folder.path} has reached stop_return={config.run.stop_return:g}; a higher one continues it")
    return solved


def _announce_resume(session: Session, update: int, jump: str | None, changes: Mapping[str, tuple[Any, Any]]) -> None:
    """Tells where the run resumes, and what has changed: schedules that jump, and versions."""
    schedule, say = session.schedule, session.display.say
    steps = update * schedule.steps_per_update
    say(f"resuming {session.run_folder.path} at {steps:,} of {schedule.total_steps:,} steps")
    if jump:
        say(f"note: {jump}")
    for change in changes.items():
        say(f"note: {versions.describe_change(*change)}")


def _make_env(config: Config) -> Env:
    """The environment, after checking that the run fits into memory."""
    with physics_cache(config.run.cache):
        env = make_env(config)
    memory.check(config, env)
    return env


def _compile(session: Session, env: Env, resumed: bool = False) -> tuple[Program, float]:
    """The compiled program, and the seconds of compilation."""
    config, display, began = session.config, session.display, time.monotonic()
    what = f"{config.choices['algo']} on {config.task}, network={config.choices['network']}"
    name = f"{what} {config.num_shards} {config.run.vmap_seeds} {resumed}"
    with (
        record_duration(config.run.cache, name) as before,
        display.show_status(f"compiling {what} ({before})"),
        compilation_cache(config.run.cache, display.say),
    ):
        program = compile_program(config, env, session.schedule.chunk, resumed=resumed, meanwhile=_import_late_modules)
    seconds = time.monotonic() - began
    display.say(f"compiled in {seconds:.1f} s")
    return program, seconds


def _import_late_modules() -> None:
    for name in LATE_MODULES:
        importlib.import_module(name)


def _train(session: Session, finish: Finish, program: Program, state: RunState, compile_seconds: float) -> int:
    """Trains until the last update or a request to stop; returns the exit status."""
    loop = Loop(session, program, state)
    try:
        with StopRequests() as stop:
            loop.run(stop)
    finally:
        seconds = loop.close()
    status, text = _describe_end(session, loop, stop.signal)
    if text:
        session.display.say(text)
    if status:
        return status
    steps = (loop.update - loop.first) * session.schedule.steps_per_update * session.config.num_agents
    finish(session, Times(steps / seconds, compile_seconds, seconds))
    return 0


def _describe_end(session: Session, loop: Loop, stopped: Signals | None) -> tuple[int, str | None]:
    """The exit status of a run that has ended, and a message for the user."""
    run, monitor, update = session.config.run, loop.monitor, loop.update
    steps, again = f"{update * session.schedule.steps_per_update:,} steps", f"resume={session.run_folder.path}"
    if monitor.is_stuck:
        advice = f"{again} nan_policy=skip skips it"
        if run.nan_policy == "skip":
            advice = f"the last {monitor.consecutive:,} updates could not be applied; {again} tries further ones"
        return DIVERGED_STATUS, f"error: {monitor.problem}; stopped at {steps}; {advice}"
    if loop.keeper.failed:
        text = f"error: the last state, at {steps}, could not be saved; {again} repeats the lost updates"
        return NOT_SAVED_STATUS, text
    if loop.solved:
        return 0, f"reached stop_return={run.stop_return:g} after {steps}"
    if stopped and update < session.schedule.num_updates:
        return 128 + stopped, f"{stopped.name}: stopped at {steps}; {again} continues"
    return 0, None


def _align_updates(train: TrainState) -> TrainState:
    """Lets agents that were stuck continue with the others: the updates that they missed count as skipped."""
    return train._replace(update=np.full_like(train.update, count_updates(train)))
