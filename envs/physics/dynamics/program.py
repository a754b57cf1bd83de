"""The step of a model, and the fields of any state, as scalar equations."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import mujoco

from envs.physics.dynamics.choice import choose_pairs
from envs.physics.dynamics.constrained import make_inverse_solver, make_solver
from envs.physics.dynamics.data import extend
from envs.physics.dynamics.forward import Solver, evaluate, find_inverse, find_kinematics, step_with_flag, unconstrained
from envs.physics.dynamics.sensors import OF_CONSTRAINTS
from envs.physics.dynamics.watch import may_touch
from envs.physics.features import find_sensors, unsupported_features
from envs.physics.fields import KINEMATICS, MODEL, find_outputs, list_fields, make_single_step
from envs.physics.interpreter import Program, trace
from envs.physics.models import put_model
from envs.physics.pairs import Pair, candidate_pairs, has_constraints
from envs.physics.primitives import UnsupportedPrimitiveError

# A program with more equations takes minutes to compile, and is not faster than C MuJoCo.
LARGEST_PROGRAM = 30_000


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
    fields = list_fields(outputs)
    _check_features(model, outputs)
    pairs, watched = _divide_pairs(model, inputs)
    solve = _watch(watched, make_solver(pairs, differentiable))
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

    return _check_size(trace(single_with_flag, *example, jnp.zeros(())) if watched else trace(single, *example))


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
    fields, flags = list_fields(outputs), []
    if set(fields) <= set(KINEMATICS):

        def place(mx, d):
            return find_kinematics(model, mx, extend(model, d), fields)

        single, example = _make_single(model, inputs, outputs, place)
        return _check_size(trace(single, *example))
    _check_features(model, outputs)
    is_solved = _needs_solution(model, outputs)
    pairs, watched = _divide_pairs(model, inputs) if is_solved else ([], [])
    make = make_inverse_solver if inverse else make_solver
    solve = _watch(watched, make(pairs, differentiable) if is_solved else unconstrained)

    def compute(mx, d):
        d, smooth = evaluate(model, mx, extend(model, d), solve, also=fields)
        flags.append(smooth.flag)
        return d.replace(qfrc_inverse=find_inverse(model, mx, d, smooth)) if inverse else d

    single, example = _make_single(model, inputs, outputs, compute)

    def single_with_flag(*arrays):
        return *single(*arrays), jnp.asarray(flags[-1])

    return _check_size(trace(single_with_flag if watched else single, *example))


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


def _divide_pairs(model, inputs: tuple[str, ...]) -> tuple[list[Pair], list[Pair]]:
    """The pairs of geoms whose contacts are equations, and those that are watched."""
    varying = [name.removeprefix(MODEL) for name in inputs if name.startswith(MODEL)]
    return choose_pairs(model, candidate_pairs(model, varying), varying)


def _watch(watched: Sequence[Pair], solve: Solver) -> Solver:
    """The solver, which also sets the flag where one of these pairs may touch."""

    def watch_and_solve(model, mx, d, smooth):
        if watched:
            smooth.flag = may_touch(model, d, watched).astype(float)
        return solve(model, mx, d, smooth)

    return watch_and_solve


def _check_size(program: Program) -> Program:
    if len(program) > LARGEST_PROGRAM:
        raise UnsupportedPrimitiveError(
            f"its {len(program):,} equations take too long to compile: <contact><exclude body1= body2=/></contact> or "
            "contype and conaffinity leave out contacts that are not needed"
        )
    return program
