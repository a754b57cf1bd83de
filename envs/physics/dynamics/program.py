"""The step of a model, and the fields of any state, as scalar equations."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import mujoco

from envs.physics.dynamics.constrained import make_inverse_solver, make_solver
from envs.physics.dynamics.data import extend
from envs.physics.dynamics.division import Division, make_within_size
from envs.physics.dynamics.forward import Solver, evaluate, find_inverse, find_kinematics, step_with_flag, unconstrained
from envs.physics.dynamics.sensors import OF_CONSTRAINTS
from envs.physics.dynamics.watch import Bound, may_touch
from envs.physics.features import find_sensors, unsupported_features
from envs.physics.fields import KINEMATICS, MODEL, find_outputs, list_fields, make_single_step
from envs.physics.interpreter import Program, trace
from envs.physics.models import put_model
from envs.physics.pairs import has_constraints
from envs.physics.primitives import UnsupportedPrimitiveError

# Fields that depend on the solution of the constraints.
SOLVED = ("qacc", "qfrc_constraint", "qfrc_inverse", "cfrc_ext")


def trace_step(
    model: mujoco.MjModel, inputs: tuple[str, ...], outputs: tuple[str, ...], differentiable: bool = False
) -> Program:
    """One physics step as scalar equations.

    Args:
      model: a compiled model.
      inputs, outputs: names as in `compile_step`.
      differentiable: with the last round of the solver, by which the derivative passes through constraints.

    Returns:
      The program. If there are pairs of geoms whose contacts it leaves to C MuJoCo, it has one more argument and
      result, a flag: a result of 1.0 says that one of them may touch and the results are void. An argument of 1.0 is
      passed on.

    Raises:
      UnsupportedPrimitiveError: the step has no such form, or a very long one.
      MujocoModelError: MJX does not take the model.
    """
    _check_features(model, outputs)

    def make(division: Division) -> Program:
        return _trace_divided_step(model, inputs, outputs, differentiable, division)

    return make_within_size(model, _list_varying(inputs), make)


def _trace_divided_step(model, inputs: tuple[str, ...], outputs: tuple[str, ...], differentiable: bool, division):
    fields = list_fields(outputs)
    solve = _watch(division.bounds, make_solver(division.chosen, differentiable))
    written_out = differentiable or not has_constraints(model)
    flags = []

    def advance(mx, d):
        d, flag = step_with_flag(model, mx, extend(model, d), solve, also=fields, written_out=written_out)
        flags.append(flag)
        return d

    single, example = _make_single(model, inputs, outputs, advance)

    def single_with_flag(*arrays):
        *given, flag = arrays
        return *single(*given), jnp.maximum(flag, flags[-1])

    return trace(single_with_flag, *example, jnp.zeros(())) if division.bounds else trace(single, *example)


def trace_fields(
    model: mujoco.MjModel,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    inverse: bool = False,
    differentiable: bool = False,
) -> Program:
    """The fields of a state as scalar equations, without a step.

    Args:
      model: a compiled model.
      inputs, outputs: names as in `compile_forward`, or as in `compile_inverse`.
      inverse: whether qacc is given.
      differentiable: as in `trace_step`.

    Returns:
      The program. If an output depends on contacts of which some are left to C MuJoCo, it has one more result, a flag
      as that of `trace_step`.

    Raises:
      As `trace_step`, but for positions alone, which every model has.
    """
    fields = list_fields(outputs)
    if set(fields) <= set(KINEMATICS):

        def place(mx, d):
            return find_kinematics(model, mx, extend(model, d), fields)

        single, example = _make_single(model, inputs, outputs, place)
        return make_within_size(model, (), lambda _: trace(single, *example), has_contacts=False)
    _check_features(model, outputs)

    def make(division: Division) -> Program:
        return _trace_divided_fields(model, inputs, outputs, inverse, differentiable, division)

    return make_within_size(model, _list_varying(inputs), make, has_contacts=_needs_solution(model, outputs))


def _trace_divided_fields(
    model, inputs: tuple[str, ...], outputs: tuple[str, ...], inverse: bool, differentiable: bool, division: Division
) -> Program:
    fields, flags = list_fields(outputs), []
    make = make_inverse_solver if inverse else make_solver
    is_solved = _needs_solution(model, outputs)
    solve = _watch(division.bounds, make(division.chosen, differentiable) if is_solved else unconstrained)

    def compute(mx, d):
        d, smooth = evaluate(model, mx, extend(model, d), solve, also=fields)
        flags.append(smooth.flag)
        return d.replace(qfrc_inverse=find_inverse(model, mx, d, smooth)) if inverse else d

    single, example = _make_single(model, inputs, outputs, compute)

    def single_with_flag(*arrays):
        return *single(*arrays), jnp.asarray(flags[-1])

    return trace(single_with_flag if division.bounds else single, *example)


@jax.ensure_compile_time_eval()  # also where a caller is traced, whose derivative needs another program
def _make_single(model, inputs: tuple[str, ...], outputs: tuple[str, ...], function: Callable) -> tuple[Callable, list]:
    """A function of mjx.Model and mjx.Data as one of the inputs, with example arguments."""
    return make_single_step(put_model(model), inputs, find_outputs(model, outputs), function)


def _needs_solution(model, outputs: tuple[str, ...]) -> bool:
    """Whether an output depends on the constraints."""
    sensors = model.sensor_type[find_sensors(model, outputs)].tolist()
    return not OF_CONSTRAINTS.isdisjoint(sensors) or not set(SOLVED).isdisjoint(list_fields(outputs))


def _check_features(model, outputs: tuple[str, ...]) -> None:
    features = unsupported_features(model, outputs)
    if features:
        raise UnsupportedPrimitiveError(f"{'; '.join(features)}: leave out what the task does not need")


def _list_varying(inputs: tuple[str, ...]) -> list[str]:
    """The fields of the model that are inputs."""
    return [name.removeprefix(MODEL) for name in inputs if name.startswith(MODEL)]


def _watch(bounds: Sequence[Bound], solve: Solver) -> Solver:
    """The solver, which also sets the flag where geoms may touch by one of these bounds."""

    def watch_and_solve(model, mx, d, smooth):
        if bounds:
            smooth.flag = may_touch(d, bounds).astype(float)
        return solve(model, mx, d, smooth)

    return watch_and_solve
