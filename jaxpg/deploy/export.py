"""From a run folder to files that were compared with JAX, or to none."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxpg.deploy import c, learning, onnx, stablehlo
from jaxpg.deploy.controller import Controller, commanding, controller, observations
from jaxpg.run import folder, policies
from jaxpg.run.agents import described
from jaxpg.run.cache import physics_cache
from jaxpg.run.checkpoint import Checkpoints
from jaxpg.run.errors import UserError
from jaxpg.run.policies import StoredPolicy
from jaxpg.run.program import make_networks
from jaxpg.run.schema import ExportOptions

TOLERANCE = 1e-5
LEARNING_TOLERANCE = 1e-4


class Format(NamedTuple):
    """A way to write a controller down.

    Attributes:
      write: `write(controller, folder, command) -> paths`; `command` is the controller as JAX computes it.
      load: `load(controller, folder) -> commands`, what was written as a function `[N, n]` to `[N, m]`.
    """

    write: Callable[[Controller, Path, Callable], list[Path]]
    load: Callable[[Controller, Path], Callable[[np.ndarray], np.ndarray]]


FORMATS = {
    "c": Format(lambda control, place, _: c.write(control, place), c.load),
    "onnx": Format(lambda control, place, _: onnx.write(control, place), onnx.load),
    "stablehlo": Format(stablehlo.write, stablehlo.load),
}


def export(options: ExportOptions, say: Callable[[str], None]) -> None:
    """Writes the policy of a run in the formats asked for, each compared with JAX; all of them or nothing.

    Args:
      options: of the command.
      say: takes lines of what was written.

    Raises:
      UserError: no such run, policy or compiler; a package is missing; `out` is no folder; or what was written
        commands something else than JAX does.
    """
    out = Path(options.out or Path(options.run) / "export")
    if out.exists() and not out.is_dir():
        raise UserError(f"out={out}: there is a file of that name")
    with physics_cache(True):
        stored = policies.load(options.run, options.checkpoint, options.agent)
    control, command = controller(stored, origin(options, stored)), jax.jit(commanding(stored))
    obs = observations(stored)
    expected = np.asarray(command(obs), np.float64)
    say(f"{control.origin['policy']}, {control.observation_size} observations to {control.action_size} commands")
    formats = FORMATS if options.format == "all" else {options.format: FORMATS[options.format]}
    with tempfile.TemporaryDirectory() as place:
        written = []
        for name, way in formats.items():
            paths = way.write(control, Path(place), command)
            difference = largest_difference(way.load(control, Path(place))(obs), expected)
            if not difference <= TOLERANCE:
                raise UserError(
                    f"format={name}: its commands differ from JAX's by {difference:.1e}, more than {TOLERANCE:.0e}; "
                    f"nothing is written"
                )
            written += paths
            files = " ".join(str(out / path.name) for path in paths)
            say(f"{name:<10} {files}")
            say(f"{'':<10} differs from JAX by {difference:.1e} at most, {len(obs):,} observations")
            if name == "c" and control.learner:
                apart = _learning_difference(stored, control, Path(place))
                say(f"{'':<10} and in learning by {apart:.1e} at most, {learning.NUM_STEPS:,} updates")
        _move(written, out)


def _learning_difference(stored: StoredPolicy, control: Controller, place: Path) -> float:
    """How far the parameters of the written learner are from JAX's at most, after any of the same steps.

    Raises:
      UserError: further than it may be.
    """
    transition = learning.steps(stored)
    networks = make_networks(stored.config, stored.env)
    expected = learning.learned(networks, control.learner.options, stored.policy, control.learner.log_std, transition)
    found = c.program(control, place / "learn.c")(learning.rows(transition))
    difference = largest_difference(found, np.asarray(expected))
    if not difference <= LEARNING_TOLERANCE:
        raise UserError(
            f"format=c: its learner's parameters differ from JAX's by {difference:.1e} after {learning.NUM_STEPS:,} "
            f"updates, more than {LEARNING_TOLERANCE:.0e}; nothing is written"
        )
    return difference


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
    limits = control.interface.limits
    with tempfile.TemporaryDirectory() as place:
        way.write(control, Path(place), commanding(stored))
        commands = way.load(control, Path(place))

        def action(obs):
            command = commands(np.asarray(obs, np.float32))
            return np.asarray(command if limits is None else command / np.array(limits), np.float32)

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


def largest_difference(found: np.ndarray, expected: np.ndarray) -> float:
    """max |a - b| / max(1, |b|): absolute for small commands, relative for large ones; NaN if there is one.

    >>> largest_difference(np.array([1.5, 200.0]), np.array([1.0, 100.0]))
    1.0
    """
    return float(np.max(np.abs(found - expected) / np.maximum(1, np.abs(expected))))


def _move(paths: list[Path], out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        for path in paths:
            shutil.copyfile(path, out / path.name)
    except OSError as error:
        raise UserError(f"out={out}: cannot be written ({error.strerror})") from error
