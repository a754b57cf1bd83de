"""The fields of any state, without a step: kinematics, forward and inverse dynamics.

`compile_forward` is C MuJoCo's `mj_forward` and `compile_inverse` its `mj_inverse`, each as a function of one
environment of the few arrays that change, like `compile_step`. Only what the outputs need is computed: of a function
from qpos to site_xpos, the kinematics of that site.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from envs.physics.callback import make_callback_fields
from envs.physics.collision import change_collision
from envs.physics.fields import (
    INPUTS,
    INVERSE,
    KINEMATICS,
    check_names,
    convert_arguments,
    find_types,
    list_fields,
)
from envs.physics.interpreter import Program
from envs.physics.scalar import StepFn, make_scalar_function, remember
from envs.physics.stages import Stage
from envs.physics.storage import make_name

if TYPE_CHECKING:
    import mujoco


def compile_forward(
    model: mujoco.MjModel,
    *,
    inputs: tuple[str, ...] = ("qpos",),
    outputs: tuple[str, ...] = ("site_xpos", "site_xmat"),
    physics: str = "scalar",
    collision: str | None = None,
) -> StepFn:
    """The fields of any state, as by C MuJoCo's `mj_forward`: what a step would compute before it moves anything.

    Fields that `compile_step` returns belong to the state before its last substep. These belong to the given one, also
    after a reset.

    Args:
      model: a compiled model.
      inputs: the arguments, as of `compile_step`. All other fields are those of `mjx.make_data`: velocities,
        activations and controls are 0.
      outputs: what to return, as of `compile_step`.
      physics: "scalar": scalar equations, or C MuJoCo where they do not reach, as in `compile_step`; "mujoco": C
        MuJoCo, which cannot be differentiated.
      collision: which geoms collide, as in `compile_step`.

    Returns:
      A function of the inputs of one environment; it raises as the one of `compile_step`.

    Raises:
      ValueError, MujocoModelError: as `compile_step`.

    >>> place = compile_forward(model, outputs=("site_xpos[hand]", "site_jacp[hand]"))  # doctest: +SKIP
    >>> position, jacobian = place(qpos)  # [3] in m, [3, nv]  # doctest: +SKIP
    """
    check_names(model, inputs, outputs, needs_act=False)
    return _compile(model, inputs, outputs, physics, collision, inverse=False)


def compile_inverse(
    model: mujoco.MjModel,
    *,
    inputs: tuple[str, ...] = ("qpos", "qvel", "qacc"),
    outputs: tuple[str, ...] = ("qfrc_inverse",),
    physics: str = "scalar",
    collision: str | None = None,
) -> StepFn:
    """The force that an acceleration needs, as by C MuJoCo's `mj_inverse`.

        qfrc_inverse = M(q) a + c(q, v) - tau_passive(q, v) - J(q)' f(q, v, a)

    with the mass matrix M, the bias force c, the forces of springs, dampers and fluids, and the constraints' forces f,
    which follow from the acceleration without iterations. It is the sum of what actuators and applied forces must give.

    Args:
      model: a compiled model.
      inputs: the arguments, of which qacc, the acceleration, is one; the others are as of `compile_step`.
      outputs: of `fields.INVERSE`: qfrc_inverse, qfrc_constraint, qfrc_bias, qfrc_passive, and fields of positions.
      physics, collision: as of `compile_forward`.

    Returns:
      A function of the inputs of one environment; it raises as the one of `compile_step`.

    Raises:
      ValueError, MujocoModelError: as `compile_step`.

    Source: Todorov, "Convex and analytically-invertible dynamics with contacts and constraints" (ICRA 2014).
    """
    check_names(model, inputs, outputs, needs_act=False, inputs_known=(*INPUTS, "qacc"), outputs_known=INVERSE)
    return _compile(model, inputs, outputs, physics, collision, inverse=True)


def normalize_quaternions(model: mujoco.MjModel, qpos: jax.Array) -> jax.Array:
    """The positions with quaternions of unit length, as `mjx.forward` leaves them and C MuJoCo's `mj_forward` does not.

    Args:
      model: a compiled model.
      qpos: `[nq]`.
    """
    from envs.physics.dynamics.integrators import integrate_position  # loads mujoco

    return integrate_position(model, jnp.asarray(qpos), np.zeros(model.nv), 0.0)


def _compile(model, inputs, outputs, physics: str, collision: str | None, inverse: bool) -> StepFn:
    makers = {"scalar": _make_scalar_fields, "mujoco": make_callback_fields}
    if physics not in makers:
        raise ValueError(f"physics is {physics!r}; it must be one of {', '.join(makers)}")
    model = model if collision is None else change_collision(model, collision)
    compute = makers[physics](model, inputs, outputs, inverse)

    def function(*arrays):
        return tuple(compute(*convert_arguments(inputs, find_types(model, inputs), arrays)))

    return function


def _make_scalar_fields(model: mujoco.MjModel, inputs: tuple[str, ...], outputs: tuple[str, ...], inverse: bool):
    """The fields as scalar equations, or for a model without this form by C MuJoCo, with a warning."""

    def make_function(program: Program, stages: list[Stage]):
        return lambda *arrays: tuple(program.join(program.run(program.split(arrays), stages)))

    make_program = functools.partial(_make_program, inputs=inputs, outputs=outputs, inverse=inverse)
    make_floor = functools.partial(make_callback_fields, inputs=inputs, outputs=outputs, inverse=inverse)
    reads_contacts = not set(list_fields(outputs)) <= set(KINEMATICS)
    return make_scalar_function(model, len(outputs), make_program, make_function, make_floor, reads_contacts)


def _make_program(model, inputs, outputs, inverse: bool, differentiable: bool = False) -> Program:
    """The scalar equations, from the store if they are there; raises as `trace_fields`."""

    def make():
        from envs.physics.dynamics.program import trace_fields  # loads mujoco

        return trace_fields(model, inputs, outputs, inverse, differentiable)

    return remember(make_name(model, inputs, outputs, "inverse" if inverse else "forward", differentiable), make)
