"""From a run folder to files that were compared with the formula of the policy, or to none."""

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
from jaxpg.deploy import c, learning, onnx, reference, sealing, stablehlo
from jaxpg.deploy.controller import Controller, commanding, controller, drawn, played
from jaxpg.errors import UserError
from jaxpg.program.agents import described
from jaxpg.program.networks import make_networks
from jaxpg.store import folder, policies
from jaxpg.store.cache import physics_cache
from jaxpg.store.checkpoint import Checkpoints
from jaxpg.store.policies import StoredPolicy

TOLERANCE = 1e-5  # of the limit
STEEP = 16  # an error may be so many times what float arithmetic itself costs a network
LEARNING_TOLERANCE = 1e-4


class Format(NamedTuple):
    """A way to write a controller down.

    Attributes:
      check: raises UserError where something is missing that writing or trying out needs.
      write: `write(controller, folder, command) -> paths`; `command` is the controller as JAX computes it.
      load: `load(controller, folder) -> commands`, what was written as a function `[N, n]` to `[N, m]`.
    """

    check: Callable[[], object]
    write: Callable[[Controller, Path, Callable], list[Path]]
    load: Callable[[Controller, Path], Callable[[np.ndarray], np.ndarray]]


def _check_packages(form: str, *names: str) -> None:
    """Raises UserError where one of the packages cannot be loaded."""
    for name in names:
        try:
            importlib.import_module(name)
        except ImportError:
            raise UserError(f"format={form} needs {name}, which cannot be loaded: {pip_install(*names)}") from None


FORMATS = {
    "c": Format(c.compiler, lambda control, place, _: c.write(control, place), c.load),
    "onnx": Format(
        lambda: _check_packages("onnx", "onnx", "onnxruntime"),
        lambda control, place, _: onnx.write(control, place),
        onnx.load,
    ),
    "stablehlo": Format(lambda: _check_packages("stablehlo", "flatbuffers"), stablehlo.write, stablehlo.load),
}


class Trial(NamedTuple):
    """What a controller is tried on.

    Attributes:
      obs: observations, `[N, n]`.
      exact: the commands for them in float64, `[N, m]`.
      unit: what errors are counted in, `[m]`.
      tolerance: the largest error allowed.
    """

    obs: np.ndarray
    exact: np.ndarray
    unit: np.ndarray
    tolerance: float

    def error(self, commands: np.ndarray) -> float:
        return reference.largest_error(commands, self.exact, self.unit)


def trial(control: Controller, obs: np.ndarray) -> Trial:
    """A trial on observations `[N, n]`.

    The tolerance is `TOLERANCE`, or `STEEP` times what float32 costs in numpy where that is more: floats come no closer
    where a network is steep.
    """
    exact = reference.commands(control, obs)
    unit, _ = reference.units(control, exact)
    return Trial(obs, exact, unit, max(TOLERANCE, STEEP * reference.rounding(control, obs, exact)))


def export(options: ExportOptions, say: Callable[[str], None]) -> None:
    """Writes the policy of a run in the formats asked for, each compared with its formula; all of them or nothing.

    Args:
      options: of the command.
      say: takes lines of what was written.

    Raises:
      UserError: no such run, policy or compiler; a package is missing; `out` is no folder, or holds files of these
        names that no export has left so; or what was written commands something else than the formula.
    """
    formats = FORMATS if options.format == "all" else {options.format: FORMATS[options.format]}
    for way in formats.values():
        way.check()
    out = Path(options.out or Path(options.run) / "export")
    sealing.check_folder(out)
    with physics_cache(True):
        stored = policies.load(options.run, options.checkpoint, options.agent)
    control, command = controller(stored, origin(options, stored), options.name), jax.jit(commanding(stored))
    seen = played(stored)
    tried = trial(control, np.concatenate([seen, drawn(stored, seen)]))
    _say_what_is_tried(control, tried, len(seen), say)
    say(f"{'jax':<10} error {_checked(control, 'jax', tried, np.asarray(command(tried.obs))):.1e} at most")
    with tempfile.TemporaryDirectory() as place:
        written = []
        for name, way in formats.items():
            paths = way.write(control, Path(place), command)
            error = _checked(control, f"format={name}", tried, way.load(control, Path(place))(tried.obs))
            written += paths
            say(f"{name:<10} error {error:.1e} at most: {' '.join(str(out / path.name) for path in paths)}")
            if name == "c" and control.learner:
                say(f"{'':<10} {_try_learner(stored, control, Path(place))}")
        if not options.overwrite:
            sealing.check_replaceable([path.name for path in written], out)
        sealing.move(written, out)


def _say_what_is_tried(control: Controller, tried: Trial, num_played: int, say: Callable[[str], None]) -> None:
    say(f"{control.origin['policy']}, {control.observation_size} observations to {control.action_size} commands")
    _, unit = reference.units(control, tried.exact)
    say(
        f"{'tried':<10} on {len(tried.obs):,} observations, {num_played:,} of them played and the others drawn; "
        f"errors in units of {unit}, against float64"
    )


def _checked(control: Controller, what: str, tried: Trial, commands: np.ndarray) -> float:
    """The largest error of the commands.

    Raises:
      UserError: it is too large.
    """
    error = tried.error(commands)
    if not error <= tried.tolerance:
        raise UserError(
            f"{what}: its commands differ from the formula's by {error:.1e} of "
            f"{reference.units(control, tried.exact)[1]}, more than {tried.tolerance:.0e}; nothing is written"
        )
    return error


def _try_learner(stored: StoredPolicy, control: Controller, place: Path) -> str:
    """How far the parameters of the written learner are from JAX's at most, after any of the same steps, in words.

    The tolerance is `LEARNING_TOLERANCE`, or `STEEP` times what rounding makes of the steps so far where that is more:
    nothing bounds a step, and where the learning itself runs away floats come no closer.

    Raises:
      UserError: further than it may be.
    """
    transition = learning.steps(stored)
    if not len(transition.reward):
        return "in learning not tried: none of the episodes played would be learned from"
    networks, learner = make_networks(stored.config, stored.env), control.learner
    learned = functools.partial(learning.learned, networks, learner.options, stored.policy, learner.log_std)
    expected = np.asarray(learned(transition))
    errors = learning.differences(c.program(control, place / "learn.c")(learning.rows(transition)), expected)
    tolerance = np.maximum(LEARNING_TOLERANCE, STEEP * learning.rounding(learned, transition, expected))
    wrong = np.flatnonzero(~(errors <= tolerance) & np.isfinite(tolerance))
    if wrong.size:
        raise UserError(
            f"format=c: its learner's parameters differ from JAX's by {errors[wrong[0]]:.1e} after update "
            f"{wrong[0] + 1:,}, more than {tolerance[wrong[0]]:.0e}; nothing is written"
        )
    exact = int(np.sum(tolerance <= LEARNING_TOLERANCE))
    later = f"; in the {len(errors) - exact:,} after these rounding may make more" if exact < len(errors) else ""
    return (
        f"in learning differs from JAX by {np.max(errors[:exact], initial=0.0):.1e} at most, {exact:,} updates{later}"
    )


@contextlib.contextmanager
def as_written(stored: StoredPolicy, form: str) -> Iterator[StoredPolicy]:
    """The stored policy, acting by what is written of it in this format, inside.

    Args:
      stored: the policy.
      form: a name in `FORMATS`.

    Raises:
      UserError: a compiler or a package is missing.
    """
    control, way = controller(stored, {}), FORMATS[form]
    way.check()
    limits = control.interface.limits
    unit = np.ones(control.action_size) if limits is None else np.where(limits, limits, 1.0)  # a limit of 0 commands 0
    with tempfile.TemporaryDirectory() as place:
        way.write(control, Path(place), commanding(stored))
        commands = way.load(control, Path(place))

        def action(obs):
            return np.asarray(commands(np.asarray(obs, np.float32)) / unit, np.float32)

        def act(policy, obs):
            return jax.pure_callback(action, jax.ShapeDtypeStruct((len(obs), control.action_size), np.float32), obs)

        yield stored._replace(act=act)


def origin(options: ExportOptions, stored: StoredPolicy) -> dict[str, str]:
    """Where the policy comes from, in words."""
    run_folder = folder.find(options.run)
    which = run_folder.best if options.checkpoint == "best" else run_folder.checkpoints
    return {
        "policy": f"{described(stored.config)}, {stored.described(options.checkpoint)}",
        "run": run_folder.path.resolve().name,
        "digest": Checkpoints(which, read_only=True).digest(stored.update),
    }
