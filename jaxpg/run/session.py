"""A training run from beginning to end: the loop on the host around the compiled chunks."""

from __future__ import annotations

import importlib
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxpg.run import config as configuration
from jaxpg.run import figures, folder
from jaxpg.run.cache import compilation_cache
from jaxpg.run.config import Config
from jaxpg.run.errors import UserError
from jaxpg.run.folder import MetricsLog, RunFolder, jsonable
from jaxpg.run.program import Program, Schedule, compile_program, make_env, plan
from jaxpg.run.runtime import StopRequests, prepare
from jaxpg.run.schema import Run
from jaxpg.run.state import Best, RunState, better, current_policy
from jaxpg.run.terminal import Display, shown
from jaxpg.types import Metrics, TrainState

# Slow to import and not needed before training: imported while XLA compiles.
NEEDED_LATER = ("jaxpg.run.checkpoint", "tensorboardX", "matplotlib.figure", "matplotlib.backends.backend_agg")
# What may change together with resume=DIR; anything else would be another run.
RESUMABLE = (
    *("total_steps", "log_interval", "eval_interval", "checkpoint_interval"),
    *("stop_return", "stop_agents", "cache"),
)


class Session(NamedTuple):
    """What a run is, how it is divided, where it is kept and where it shows."""

    config: Config
    schedule: Schedule
    run_folder: RunFolder
    display: Display


def begin(config: Config) -> int:
    """Trains from the beginning; returns the exit status."""
    prepare(config)
    env = make_env(config)  # before anything is written: it may have a mistake to report
    run_folder, schedule = folder.create(config), plan(config)
    configuration.save(config, run_folder.config)
    display = Display(schedule.total_steps)
    run, algo = config.run, config.choices["algo"]
    agents = f"seeds {run.seed} to {run.seed + run.num_seeds - 1}" if run.num_seeds > 1 else f"seed {run.seed}"
    display.say(
        f"{algo} on {config.choices['env']}, {agents}: {run.num_envs} environments x {run.num_steps} steps x "
        f"{schedule.num_updates:,} updates = {schedule.total_steps:,} steps, into {run_folder.path}"
    )
    session = Session(config, schedule, run_folder, display)
    program, seconds = _compile(session, env)
    return _train(session, program, program.init(), seconds)


def resume(given: Mapping[str, Any]) -> int:
    """Goes on from the newest checkpoint of the run in `given["resume"]`; returns the exit status."""
    from jaxpg.run.checkpoint import Checkpoints

    changes = {name: value for name, value in given.items() if name != "resume"}
    run_folder = folder.find(str(given["resume"]))
    config = _changed(run_folder, changes)
    checkpoints = Checkpoints(run_folder.checkpoints)
    update = checkpoints.latest()
    if update is None:
        raise UserError(f"{run_folder.path} has no checkpoint yet: start again with another run_dir")
    recorded = folder.read_versions(run_folder)
    prepare(config, recorded.get("threads"))
    schedule = plan(config, done=update)
    display = Display(schedule.total_steps, steps=update * schedule.steps_per_update)
    if update >= schedule.num_updates:
        _draw(config, run_folder)
        display.say(f"{run_folder.path} is finished; a larger total_steps goes on")
        return 0
    if _solved(config.run, _best_returns(folder.read_metrics(run_folder))):
        display.say(f"{run_folder.path} has reached stop_return={config.run.stop_return:g}; a higher one goes on")
        return 0
    display.say(
        f"resuming {run_folder.path} at {update * schedule.steps_per_update:,} of {schedule.total_steps:,} steps"
    )
    for name, now in folder.versions().items():
        if recorded.get(name) != now:
            display.say(f"note: {name} was {recorded.get(name)} and is {now}: the same run, but not the same bits")
    session = Session(config, schedule, run_folder, display)
    program, seconds = _compile(session, make_env(config), resumed=True)
    state = checkpoints.restore(update, program.state_shape)
    configuration.save(config, run_folder.config)
    return _train(session, program, state, seconds)


def _changed(run_folder: RunFolder, changes: Mapping[str, Any]) -> Config:
    """The stored configuration with the changes, if these leave it the same run."""
    stored = configuration.load(run_folder.config)
    changed = configuration.change(stored, changes)
    before, after = configuration.flatten(stored), configuration.flatten(changed)
    for name in changes:
        if name not in RESUMABLE and before.get(name) != after.get(name):
            raise UserError(
                f"{name}={changes[name]}: {run_folder.path} has {name}={before[name]}, and on resume only "
                f"{', '.join(RESUMABLE)} may change"
            )
    return changed


def _compile(session: Session, env: Any, resumed: bool = False) -> tuple[Program, float]:
    """The compiled program, and the seconds that it took."""
    session.display.say("compiling ...")
    began = time.monotonic()
    with compilation_cache(session.config.run.cache, session.display.say):
        program = compile_program(session.config, env, session.schedule.chunk, resumed, meanwhile=_import_the_rest)
    seconds = time.monotonic() - began
    session.display.say(f"compiled in {seconds:.1f} s")
    return program, seconds


def _import_the_rest() -> None:
    for name in NEEDED_LATER:
        importlib.import_module(name)


def _train(session: Session, program: Program, state: RunState, compile_seconds: float) -> int:
    """Chunk after chunk until the last update or a request to stop; returns the exit status."""
    config, schedule, run_folder, display = session
    keeper, solved = _Keeper(run_folder, config), False
    first = update = _update(state.train)
    log = MetricsLog(run_folder, update)
    began, seconds_before = time.monotonic(), log.seconds
    display.start()
    try:
        with StopRequests() as stop:
            while update < schedule.num_updates and not solved and not stop.signal:
                train, metrics = program.advance(state.train)
                update = _update(train)
                line = {"update": update, "steps": update * schedule.steps_per_update} | _summary(metrics)
                state = state._replace(train=train)
                if schedule.is_due(update, schedule.eval_every):
                    state, evaluation = _evaluate(program, state)
                    line |= evaluation
                    solved = _solved(config.run, state.best.episode_return)
                line["seconds"] = round(seconds_before + time.monotonic() - began, 3)
                log.write(line)
                display.update(line)
                if schedule.is_due(update, schedule.checkpoint_every) or solved or stop.signal:
                    keeper.save(update, state)
    finally:
        display.stop()
        log.close()
    if solved:
        display.say(f"reached stop_return={config.run.stop_return:g} after {line['steps']:,} steps")
    elif update < schedule.num_updates:
        display.say(f"{stop.signal.name}: stopped at {line['steps']:,} steps; resume={run_folder.path} goes on")
        return 128 + stop.signal
    training_seconds = time.monotonic() - began
    rate = (update - first) * schedule.steps_per_update * config.run.num_seeds / training_seconds
    lines = _draw(config, run_folder)
    display.table(_closing_rows(lines, run_folder, rate, compile_seconds, training_seconds))
    return 0


def _update(train: TrainState) -> int:
    """The updates made; read by numpy, as jax would compile a program that picks the number."""
    return int(np.asarray(train.update)[0])


def _draw(config: Config, run_folder: RunFolder) -> list[dict[str, Any]]:
    """Draws the learning curve; returns the lines of metrics that it shows."""
    lines = folder.read_metrics(run_folder)
    title = f"{config.choices['algo']} on {config.choices['env']}"
    figures.learning_curve(lines, run_folder.learning_curve, title)
    return lines


class _Keeper:
    """Writes the run's state to `checkpoints/` and its best policy to `best/`."""

    def __init__(self, run_folder: RunFolder, config: Config):
        from jaxpg.run.checkpoint import Checkpoints

        self._checkpoints = Checkpoints(run_folder.checkpoints)
        self._best = Checkpoints(run_folder.best, keep=1)
        self._meta = {"config": config.to_dict()}

    def save(self, update: int, state: RunState) -> None:
        self._checkpoints.save(update, state, self._meta)
        self._best.replace(update, state.best, self._meta)


def _summary(metrics: Metrics) -> dict[str, Any]:
    """One line of metrics for a chunk: means over its updates, and the mean return of the episodes that ended."""
    values = {name: np.asarray(value, np.float64) for name, value in metrics.items()}  # [S, chunk]
    return_sum, episodes = values.pop("return_sum").sum(axis=-1), values.pop("episodes").sum(axis=-1)
    mean_return = np.where(episodes > 0, return_sum / np.maximum(episodes, 1), np.nan)
    means = {name: jsonable(value.mean(axis=-1)) for name, value in values.items()}
    return {"return": jsonable(mean_return), "episodes": jsonable(episodes)} | means


def _evaluate(program: Program, state: RunState) -> tuple[RunState, dict[str, Any]]:
    """The deterministic policy's results, and the state with the best policy kept."""
    policy = current_policy(state.train)
    episodes = program.evaluate(policy)
    values = {"return": episodes.episode_return} | episodes.metrics
    results = {name: np.asarray(value, np.float64).mean(axis=-1) for name, value in values.items()}
    best = better(state.best, Best(policy, results["return"].astype(np.float32)))
    return state._replace(best=best), {f"eval_{name}": jsonable(value) for name, value in results.items()}


def _solved(run: Run, best_returns: np.ndarray) -> bool:
    """Whether all agents, or one of them, have reached the return at which the run ends."""
    if run.stop_return is None:
        return False
    reached = np.asarray(best_returns) >= run.stop_return
    return bool(reached.all() if run.stop_agents == "all" else reached.any())


def _best_returns(lines: list[dict[str, Any]]) -> np.ndarray:
    """The best evaluation of each agent, `[S]`."""
    evaluations = [line for line in lines if "eval_return" in line]
    return figures.series(evaluations, "eval_return")[1].max(axis=1, initial=-np.inf)


def _closing_rows(
    lines: list[dict[str, Any]], run_folder: RunFolder, rate: float, compile_seconds: float, training_seconds: float
) -> dict[str, str]:
    evaluations = [line for line in lines if "eval_return" in line]
    last = evaluations[-1]
    best = _best_returns(lines).tolist()
    rows = {"deterministic return": f"{shown(last['eval_return'])} at the end, {shown(best)} at best"}
    if "eval_success" in last:
        success = np.mean(last["eval_success"])
        rows["success"] = f"{success:.1%} at the end"
    return rows | {
        "speed": f"{rate:,.0f} steps/s",
        "time": f"{compile_seconds:.1f} s compiling, {training_seconds:.1f} s training",
        "run folder": str(run_folder.path),
        "evaluate it": f"python -m jaxpg.evaluate run={run_folder.path}",
    }
