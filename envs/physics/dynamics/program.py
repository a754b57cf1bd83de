"""The step of a model as scalar equations."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco

from envs.physics.dynamics.choice import choose_pairs
from envs.physics.dynamics.constrained import make_solver
from envs.physics.dynamics.forward import step_with_flag
from envs.physics.dynamics.watch import may_touch
from envs.physics.features import unsupported_features
from envs.physics.fields import MODEL, make_single_step
from envs.physics.interpreter import Program, trace
from envs.physics.models import put_model
from envs.physics.pairs import candidate_pairs, has_constraints
from envs.physics.primitives import UnsupportedPrimitiveError

# A program with more equations takes minutes to compile, and is not faster than C MuJoCo.
LARGEST_PROGRAM = 30_000


@jax.ensure_compile_time_eval()  # also where a caller is traced, whose derivative needs another program
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
    features = unsupported_features(model, outputs)
    if features:
        raise UnsupportedPrimitiveError(f"{'; '.join(features)}: leave out what the task does not need")
    varying = [name.removeprefix(MODEL) for name in inputs if name.startswith(MODEL)]
    pairs, watched = choose_pairs(model, candidate_pairs(model, varying), varying)
    solve = make_solver(pairs, differentiable)

    def watch_and_solve(model, mx, d, smooth):
        if watched:
            smooth.flag = may_touch(model, d, watched).astype(float)
        return solve(model, mx, d, smooth)

    written_out = differentiable or not has_constraints(model)
    flags = []

    def advance(mx, d):
        d, flag = step_with_flag(model, mx, d, watch_and_solve, also=outputs, written_out=written_out)
        flags.append(flag)
        return d

    single, example = make_single_step(put_model(model), inputs, outputs, advance)

    def single_with_flag(*arrays):
        *given, flag = arrays
        return *single(*given), jnp.maximum(flag, flags[-1])

    program = trace(single_with_flag, *example, jnp.zeros(())) if watched else trace(single, *example)
    if len(program) > LARGEST_PROGRAM:
        raise UnsupportedPrimitiveError(
            f"its {len(program):,} equations take too long to compile: <contact><exclude body1= body2=/></contact> or "
            "contype and conaffinity leave out contacts that are not needed"
        )
    return program
