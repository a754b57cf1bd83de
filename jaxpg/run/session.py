"""A training run from beginning to end: how it begins or goes on, and with what status it ends."""

from __future__ import annotations

import dataclasses
import importlib
import time
from collections.abc import Callable, Mapping
from signal import Signals
from typing import Any, NamedTuple

import numpy as np

from envs.base import interface
from jaxpg.config import configuration
from jaxpg.config.configuration import Config
from jaxpg.divergence import BOUND
from jaxpg.errors import UserError
from jaxpg.program import agents, memory
from jaxpg.program.backend import prepare
from jaxpg.program.compile import Program, compile_program
from jaxpg.program.environment import make_env
from jaxpg.program.schedule import described_jump, plan
from jaxpg.program.state import RunState
from jaxpg.run.loop import Loop, Session, is_solved, updates_made
from jaxpg.run.signals import StopRequests
from jaxpg.run.terminal import Display
from jaxpg.store import config_file, folder, lock, results, same_run, versions
from jaxpg.store.cache import compilation_cache, physics_cache
from jaxpg.store.durations import record_duration
from jaxpg.store.folder import RunFolder
from jaxpg.store.lines import up_to
from jaxpg.store.loggers import follower
from jaxpg.types import TrainState

# Slow to import and not needed before training: imported while XLA compiles.
NEEDED_LATER = ("jaxpg.store.checkpoint", "tensorboardX", "matplotlib.figure", "matplotlib.backends.backend_agg")
EXPLODED = 4  # the exit status of a run that ended because its numbers were not finite
NOT_SAVED = 5  # the exit status of a run whose last state is on no disk


class Times(NamedTuple):
    """What a training took.

    Attributes:
      rate: environment steps per second, of all agents.
      compiling, training: seconds.
    """

    rate: float
    compiling: float
    training: float


# What is done with a run that has ended well, while its folder is still owned; without times it had ended before.
Finish = Callable[[Session, Times | None], None]


def begin(config: Config, finish: Finish, check: Callable[[RunFolder], None] = folder.check_empty) -> int:
    """Trains from the beginning; returns the exit status.

    Args:
      config: of the run.
      finish: called with a run that has ended with status 0.
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
        return _begin(config, finish, env, run_folder)


def _begin(config: Config, finish: Finish, env: Any, run_folder: RunFolder) -> int:
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
    return _train(session, finish, program, state, seconds)


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


def resume(given: Mapping[str, Any], finish: Finish) -> int:
    """Goes on from the newest checkpoint of the run in `given["resume"]`; returns the exit status."""
    changes = {name: value for name, value in given.items() if name != "resume"}
    run_folder = folder.find(str(given["resume"]))
    with folder.owned(run_folder, print):
        stored = config_file.load(run_folder.config)
        config = configuration.change(stored, changes)
        same_run.check_options(run_folder, stored, config)
        return _go_on(stored, config, finish, run_folder)


def begin_or_resume(config: Config, finish: Finish) -> int:
    """Goes on with the run in `run_dir` where there is something to resume, and else begins it; the exit status.

    Args:
      config: all options of the run, as for a new one.
    """
    if config.run.run_dir is None:
        raise UserError("resume=auto needs run_dir=DIR: the folder to begin in, or to resume from")
    run_folder = folder.planned(config)
    if not folder.has_checkpoints(run_folder):
        return begin(config, finish, folder.check_nothing_to_lose)
    with folder.owned(run_folder, print):
        stored = config_file.load(run_folder.config)
        # The folder may have been moved, or be given in other words.
        config = dataclasses.replace(config, run=dataclasses.replace(config.run, run_dir=stored.run.run_dir))
        same_run.check_options(run_folder, stored, config)
        return _go_on(stored, config, finish, run_folder)


def _go_on(stored: Config, config: Config, finish: Finish, run_folder: RunFolder) -> int:
    from jaxpg.store.checkpoint import Checkpoints

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
    if _is_over(session, update):
        finish(session, None)
        return 0
    now = versions.versions()
    changed = versions.changes(recorded, now)
    _say_what_goes_on(session, update, described_jump(stored, config, update), changed)
    program, seconds = _compile(session, _env(config), resumed=True)
    state = checkpoints.restore(update, program.state_shape)
    if config.run.nan_policy == "skip":
        state = state._replace(train=_side_by_side(state.train))
    folder.replace(run_folder.config, configuration.to_yaml(config))
    if changed:
        folder.change_versions(run_folder, recorded, now)
    return _train(session, finish, program, state, seconds)


def _is_over(session: Session, update: int) -> bool:
    """Whether nothing is left to do after `update` updates, which is said then."""
    config, schedule, run_folder, display = session
    if update >= schedule.num_updates:
        display.say(f"{run_folder.path} is finished; a larger total_steps goes on")
        return True
    lines = up_to(folder.read_metrics(run_folder, config.num_agents), update)
    solved = is_solved(config.run, results.best_returns(lines))
    if solved:
        display.say(f"{run_folder.path} has reached stop_return={config.run.stop_return:g}; a higher one goes on")
    return solved


def _say_what_goes_on(session: Session, update: int, jump: str | None, changed: Mapping[str, tuple[Any, Any]]) -> None:
    """From where, and what is not as it was: schedules that jump, and versions."""
    schedule, say = session.schedule, session.display.say
    steps = update * schedule.steps_per_update
    say(f"resuming {session.run_folder.path} at {steps:,} of {schedule.total_steps:,} steps")
    if jump:
        say(f"note: {jump}")
    for change in changed.items():
        say(f"note: {versions.described(*change)}")


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
        record_duration(config.run.cache, name) as before,
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


def _train(session: Session, finish: Finish, program: Program, state: RunState, compile_seconds: float) -> int:
    """Until the last update or a request to stop; returns the exit status."""
    loop = Loop(session, program, state)
    try:
        with StopRequests() as stop:
            loop.run(stop)
    finally:
        seconds = loop.close()
    status, text = _ending(session, loop, stop.signal)
    if text:
        session.display.say(text)
    if status:
        return status
    steps = (loop.update - loop.first) * session.schedule.steps_per_update * session.config.num_agents
    finish(session, Times(steps / seconds, compile_seconds, seconds))
    return 0


def _ending(session: Session, loop: Loop, stopped: Signals | None) -> tuple[int, str | None]:
    """The exit status of a run that has ended, and what is to be said of it."""
    run, watch, update = session.config.run, loop.watch, loop.update
    steps, again = f"{update * session.schedule.steps_per_update:,} steps", f"resume={session.run_folder.path}"
    if watch.nobody_goes_on:
        advice = f"{again} nan_policy=skip leaves it out"
        if run.nan_policy == "skip":
            advice = f"the last {watch.in_a_row:,} updates could not be applied; {again} tries further ones"
        return EXPLODED, f"error: {watch.problem}; stopped at {steps}; {advice}"
    if loop.keeper.failed:
        return NOT_SAVED, f"error: the last state, at {steps}, could not be saved; {again} repeats what is lost"
    if loop.solved:
        return 0, f"reached stop_return={run.stop_return:g} after {steps}"
    if stopped and update < session.schedule.num_updates:
        return 128 + stopped, f"{stopped.name}: stopped at {steps}; {again} goes on"
    return 0, None


def _side_by_side(train: TrainState) -> TrainState:
    """Agents that have stood still go on with the others: the updates that they have missed count as left out."""
    return train._replace(update=np.full_like(train.update, updates_made(train)))
