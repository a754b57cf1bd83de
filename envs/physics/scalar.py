"""A function of a model by scalar equations, or where they do not reach by C MuJoCo, with a line that says why."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

import jax

from envs.physics.collision import change_collision, describe_meshes
from envs.physics.interpreter import Program
from envs.physics.models import MujocoModelError, model_digest, model_name
from envs.physics.primitives import UnsupportedPrimitiveError
from envs.physics.stages import Stage
from envs.physics.storage import load_or_make
from envs.physics.tiles import make_tiled

if TYPE_CHECKING:
    import mujoco

logger = logging.getLogger(__name__)

StepFn = Callable[..., tuple[jax.Array, ...]]

_latest: dict[str, Program] = {}  # the last program made, by its name: a check and its step need the same one
_warned: set[bytes] = set()  # digests of the models that `_warn_once` has warned about


class MakeProgram(Protocol):
    """The program of a model, which may be one with derivatives; raises as `dynamics.program.trace_step`."""

    def __call__(self, model: mujoco.MjModel, /, *, differentiable: bool = False) -> Program: ...


class MakeFloor(Protocol):
    """The same function by C MuJoCo, which may have a mask as `callback.make_callback_step`."""

    def __call__(self, model: mujoco.MjModel, /, *, masked: bool = False) -> StepFn: ...


def make_scalar_function(
    model: mujoco.MjModel,
    num_outputs: int,
    make_program: MakeProgram,
    make_function: Callable[[Program, list[Stage]], StepFn],
    make_floor: MakeFloor,
    reads_contacts: bool = True,
) -> StepFn:
    """The function as scalar equations, or for a model without this form by C MuJoCo, with a warning.

    If the program has one more result than outputs, the flag, C MuJoCo computes the environments in which it is not 0.

    Args:
      model: a compiled model; meshes do not collide.
      num_outputs: how many arrays the function returns.
      make_program: makes the equations.
      make_function: makes the function from a program and from its stages, or from others that compute the same.
      make_floor: makes the function by C MuJoCo.
      reads_contacts: whether it matters that meshes do not collide.
    """
    colliding = change_collision(model, "primitives")
    try:
        program = make_program(colliding)
    except (UnsupportedPrimitiveError, MujocoModelError) as error:
        _warn_once(model, _describe_floor(describe_reason(model, error)))
        return make_floor(model)
    if reads_contacts and (meshes := describe_meshes(model)):
        _warn_once(model, meshes)

    def differentiable(*arrays):
        derived = make_program(colliding, differentiable=True)
        return make_function(derived, derived.stages)(*arrays)

    is_watching = len(program.outputs) > num_outputs
    return make_tiled(
        program,
        functools.partial(make_function, program),
        differentiable=differentiable,
        replace=make_floor(colliding, masked=True) if is_watching else None,
    )


def remember(name: str, make: Callable[[], Program]) -> Program:
    """The program with this name: the last one, or from the store, or else from `make`."""
    if name not in _latest:
        program = load_or_make(name, make)
        _latest.clear()
        _latest[name] = program
    return _latest[name]


def describe_reason(model: mujoco.MjModel, error: Exception) -> str:
    """Why there are no equations, without the model's name."""
    return str(error).removeprefix(f"{model_name(model)}: ")


def _describe_floor(reason: str) -> str:
    return (
        "it has no form as scalar equations and is stepped by C MuJoCo, at its speed and without gradients, because "
        f"of: {reason}. See docs/physics.md"
    )


def _warn_once(model: mujoco.MjModel, line: str) -> None:
    """Logs a line about how the model is stepped, once for each model in this process."""
    digest = model_digest(model)
    if digest not in _warned:
        _warned.add(digest)
        logger.warning("%s: %s", model_name(model), line)
