"""Exports the policy of a run, after comparing each format with the policy's formula."""

from __future__ import annotations

import contextlib
import functools
import importlib
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from envs.hints import pip_install
from jaxpg.config.command_options import ExportOptions
from jaxpg.deploy import c, learner_replay, onnx, reference, sealing, stablehlo
from jaxpg.deploy.controller import (
    Controller,
    Learner,
    draw_observations,
    make_command,
    make_controller,
    play_observations,
)
from jaxpg.errors import UserError
from jaxpg.program.agents import describe_run
from jaxpg.program.networks import make_networks
from jaxpg.store import folder, policies
from jaxpg.store.cache import physics_cache
from jaxpg.store.checkpoint import Checkpoints
from jaxpg.store.policies import StoredPolicy

TOLERANCE = 1e-5  # in units of the limit
ROUNDING_FACTOR = 16  # allowed error as a multiple of the rounding error of float arithmetic
LEARNING_TOLERANCE = 1e-4


class Format(NamedTuple):
    """An export format.

    Attributes:
      check: raises UserError if writing or testing the format needs something that is missing.
      write: `write(controller, folder, command) -> paths`; `command` is the controller in JAX.
      load: `load(controller, folder) -> commands`, the exported controller as a function `[N, n]` to `[N, m]`.
    """

    check: Callable[[], object]
    write: Callable[[Controller, Path, Callable], list[Path]]
    load: Callable[[Controller, Path], Callable[[np.ndarray], np.ndarray]]


def _check_packages(form: str, *names: str) -> None:
    """Raises UserError if one of the packages cannot be imported."""
    for name in names:
        try:
            importlib.import_module(name)
        except ImportError:
            raise UserError(f"format={form} needs {name}, which cannot be imported: {pip_install(*names)}") from None


FORMATS = {
    "c": Format(c.find_compiler, lambda control, place, _: c.write(control, place), c.load),
    "onnx": Format(
        lambda: _check_packages("onnx", "onnx", "onnxruntime"),
        lambda control, place, _: onnx.write(control, place),
        onnx.load,
    ),
    "stablehlo": Format(lambda: _check_packages("stablehlo", "flatbuffers"), stablehlo.write, stablehlo.load),
}


class Trial(NamedTuple):
    """Data that an export is tested on.

    Attributes:
      obs: observations, `[N, n]`.
      exact: their commands in float64, `[N, m]`.
      unit: unit of the errors, `[m]`.
      tolerance: largest error allowed.
    """

    obs: np.ndarray
    exact: np.ndarray
    unit: np.ndarray
    tolerance: float

    def error(self, commands: np.ndarray) -> float:
        return reference.largest_error(commands, self.exact, self.unit)


def make_trial(control: Controller, obs: np.ndarray) -> Trial:
    """A trial on observations `[N, n]`.

    The tolerance is the larger of `TOLERANCE` and `ROUNDING_FACTOR` times the rounding error of float32 in numpy: for a
    steep network floats are no more exact than that.
    """
    exact = reference.compute_commands(control, obs)
    unit, _ = reference.error_units(control, exact)
    return Trial(obs, exact, unit, max(TOLERANCE, ROUNDING_FACTOR * reference.rounding_error(control, obs, exact)))


def export(options: ExportOptions, say: Callable[[str], None]) -> None:
    """Writes the policy of a run in the requested formats, each compared with its formula; all of them or none.

    Args:
      options: options of the command.
      say: takes lines for the user.

    Raises:
      UserError: the run, policy, compiler or a package is missing; `out` is not a folder, or holds files of these names
        that no export wrote; or an exported controller differs from the formula.
    """
    formats = FORMATS if options.format == "all" else {options.format: FORMATS[options.format]}
    for target in formats.values():
        target.check()
    assert options.run is not None  # the command has asked for it
    out = Path(options.out or Path(options.run) / "export")
    sealing.check_folder(out)
    with physics_cache(True):
        stored = policies.load(options.run, options.checkpoint, options.agent)
    control = make_controller(stored, describe_origin(options.run, options.checkpoint, stored), options.name)
    command = jax.jit(make_command(stored))
    played = play_observations(stored)
    trial = make_trial(control, np.concatenate([played, draw_observations(stored, played)]))
    _describe_trial(control, trial, len(played), say)
    say(f"{'jax':<10} error {_check_error(control, 'jax', trial, np.asarray(command(trial.obs))):.1e} at most")
    with tempfile.TemporaryDirectory() as place:
        all_paths = []
        for name, target in formats.items():
            paths = target.write(control, Path(place), command)
            error = _check_error(control, f"format={name}", trial, target.load(control, Path(place))(trial.obs))
            all_paths += paths
            say(f"{name:<10} error {error:.1e} at most: {' '.join(str(out / path.name) for path in paths)}")
            if name == "c" and control.learner:
                say(f"{'':<10} {_check_learner(stored, control, control.learner, Path(place))}")
        if not options.overwrite:
            sealing.check_replaceable([path.name for path in all_paths], out)
        sealing.move_into(all_paths, out)


def _describe_trial(control: Controller, trial: Trial, num_played: int, say: Callable[[str], None]) -> None:
    say(f"{control.origin['policy']}, {control.observation_size} observations to {control.action_size} commands")
    _, unit = reference.error_units(control, trial.exact)
    say(
        f"{'tested':<10} on {len(trial.obs):,} observations, {num_played:,} from episodes and the others random; "
        f"errors relative to {unit}, against float64"
    )


def _check_error(control: Controller, what: str, trial: Trial, commands: np.ndarray) -> float:
    """The largest error of the commands.

    Raises:
      UserError: the error is too large.
    """
    error = trial.error(commands)
    if not error <= trial.tolerance:
        raise UserError(
            f"{what}: the commands differ from the formula's by {error:.1e} of "
            f"{reference.error_units(control, trial.exact)[1]}, more than {trial.tolerance:.0e}; nothing is written"
        )
    return error


def _check_learner(stored: StoredPolicy, control: Controller, learner: Learner, place: Path) -> str:
    """Compares the exported learner's parameters with JAX's after each of the same steps; returns a line on the result.

    The tolerance is the larger of `LEARNING_TOLERANCE` and `ROUNDING_FACTOR` times the effect of rounding up to that
    step: steps are not bounded, and where learning diverges floats are no more exact than that.

    Raises:
      UserError: the difference exceeds the tolerance.
    """
    transition = learner_replay.collect_steps(stored)
    if not len(transition.reward):
        return "learning not tested: no episode that was played can be learned from"
    networks = make_networks(stored.config, stored.env)
    learn = functools.partial(learner_replay.learn, networks, learner.options, stored.policy, learner.log_std)
    expected = np.asarray(learn(transition))
    parameters = c.compile_example(control, place / "learn.c")(learner_replay.to_rows(transition))
    errors = learner_replay.compare(parameters, expected)
    rounding = learner_replay.rounding_effect(learn, transition, expected)
    tolerance = np.maximum(LEARNING_TOLERANCE, ROUNDING_FACTOR * rounding)
    wrong = np.flatnonzero(~(errors <= tolerance) & np.isfinite(tolerance))
    if wrong.size:
        raise UserError(
            f"format=c: the learner's parameters differ from JAX's by {errors[wrong[0]]:.1e} after update "
            f"{wrong[0] + 1:,}, more than {tolerance[wrong[0]]:.0e}; nothing is written"
        )
    exact = int(np.sum(tolerance <= LEARNING_TOLERANCE))
    later = f"; rounding may add more in the other {len(errors) - exact:,}" if exact < len(errors) else ""
    return f"learning differs from JAX by {np.max(errors[:exact], initial=0.0):.1e} at most in {exact:,} updates{later}"


@contextlib.contextmanager
def replace_by_export(stored: StoredPolicy, form: str) -> Iterator[StoredPolicy]:
    """The stored policy, acting through its export in this format.

    Args:
      stored: the policy.
      form: a name in `FORMATS`.

    Raises:
      UserError: a compiler or a package is missing.
    """
    control, target = make_controller(stored, {}), FORMATS[form]
    target.check()
    limits = control.interface.limits
    unit = np.ones(control.action_size) if limits is None else np.where(limits, limits, 1.0)  # a limit of 0 commands 0
    with tempfile.TemporaryDirectory() as place:
        target.write(control, Path(place), make_command(stored))
        commands = target.load(control, Path(place))

        def action(obs):
            return np.asarray(commands(np.asarray(obs, np.float32)) / unit, np.float32)

        def act(policy, obs):
            return jax.pure_callback(action, jax.ShapeDtypeStruct((len(obs), control.action_size), np.float32), obs)

        yield stored._replace(act=act)


def describe_origin(run: str, checkpoint: str, stored: StoredPolicy) -> dict[str, str]:
    """A description of where the policy comes from."""
    run_folder = folder.find(run)
    which = run_folder.best if checkpoint == "best" else run_folder.checkpoints
    return {
        "policy": f"{describe_run(stored.config)}, {stored.describe(checkpoint)}",
        "run": run_folder.path.resolve().name,
        "digest": Checkpoints(which, read_only=True).digest(stored.update),
    }
