"""One control step of a MuJoCo model, as a function of the few arrays that change.

`compile_step` returns C MuJoCo's step (`envs.physics.dynamics`) as scalar equations (`envs.physics.interpreter`). A
model without this form is stepped by C MuJoCo itself (`envs.physics.callback`), as is any model with
`physics="mujoco"`, and by `mjx.step` only where it is asked for. Each is a function of one environment; use `jax.vmap`
for batches.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from envs.physics.callback import make_callback_step
from envs.physics.collision import change_collision
from envs.physics.fields import (
    ADDED,
    FLAG,
    STATE,
    check_names,
    convert_arguments,
    find_outputs,
    find_types,
    list_fields,
    make_single_step,
)
from envs.physics.interpreter import Program
from envs.physics.models import MujocoModelError, import_mjx, put_whole_model
from envs.physics.pairs import has_constraints
from envs.physics.primitives import UnsupportedPrimitiveError
from envs.physics.scalar import StepFn, describe_reason, make_scalar_function, remember
from envs.physics.stages import Stage
from envs.physics.storage import make_name

if TYPE_CHECKING:
    import mujoco

WARMSTART = "qacc_warmstart"


def compile_step(
    model: mujoco.MjModel,
    num_substeps: int = 1,
    *,
    inputs: tuple[str, ...] = ("qpos", "qvel", "ctrl"),
    outputs: tuple[str, ...] = ("qpos", "qvel"),
    physics: str = "scalar",
    collision: str | None = None,
) -> StepFn:
    """`num_substeps` times C MuJoCo's step, with everything but the state held constant.

    Args:
      model: a compiled model.
      num_substeps: physics steps of `model.opt.timestep` seconds in one control step.
      inputs: the arguments of the step, in this order: fields of `mjx.Data` (`fields.INPUTS`: qpos, qvel, act, ctrl,
        mocap_pos, qfrc_applied, qacc_warmstart, ...) and, prefixed with `model.`, of `mjx.Model` (model.body_mass,
        model.dof_damping, model.opt.gravity, ...), for models that differ between environments. All other fields are
        those of `mjx.make_data` and of the model.
      outputs: the fields of `mjx.Data` (`fields.OUTPUTS`) that the step returns, in this order, after the last substep.
        As in MuJoCo, fields derived from the positions (xpos, site_xpos, sensordata, ...) belong to the state before
        that substep.
      physics: "scalar": scalar equations, or for a model without this form C MuJoCo, with a warning that names the
        feature, and for a step in which geoms may touch whose contacts have no equations C MuJoCo without one; "mjx":
        `mjx.step`; "mujoco": C MuJoCo's step in double precision, which cannot be differentiated.
      collision: which geoms collide: "all", "hull" (meshes as boxes and capsules around them), "primitives" (all but
        meshes) or "none". By default, all of them with C MuJoCo and `mjx.step`, and with scalar equations all but
        meshes, which one line says if there are such.

    Returns:
      A function of the inputs (SI units; ctrl in the actuators' units) of one environment, in jax's default precision.
      A NaN in the state stays in the state. With "mujoco", all outputs of an environment that has diverged are NaN; see
      `make_callback_step`. The function raises ValueError for a wrong shape, and TypeError for a wrong dtype or number
      of arguments.

    Raises:
      ValueError: a name is unknown (with the nearest one), cannot be an input, or cannot differ between environments;
        the inputs lack the activations of the model; or `physics` or `collision` is unknown.
      MujocoModelError: MJX cannot step the model, with "mjx", or `mujoco.batch` cannot.
    """
    if physics not in PHYSICS:
        raise ValueError(f"physics is {physics!r}; it must be one of {', '.join(PHYSICS)}")
    check_names(model, inputs, outputs)
    results = _order_results(inputs, outputs)
    if collision is not None:
        model = change_collision(model, collision)
    compute = PHYSICS[physics](model, num_substeps, inputs, results)

    def step(*arrays):
        arguments = convert_arguments(inputs, find_types(model, inputs), arrays)
        values = dict(zip(results, compute(*arguments), strict=True))
        return tuple(values[name] for name in outputs)

    return step


def make_scalar_step(
    model: mujoco.MjModel, num_substeps: int, inputs: tuple[str, ...], outputs: tuple[str, ...]
) -> StepFn:
    """The substeps as scalar equations, or for a model without this form by C MuJoCo, with a warning.

    Args:
      model, num_substeps, inputs: as in `compile_step`.
      outputs: the inputs that a step changes, in their order, followed by other outputs.
    """
    hidden = _find_hidden(change_collision(model, "primitives"), inputs, outputs) if num_substeps > 1 else ()
    if hidden:
        return _make_continued_step(model, num_substeps, inputs, outputs, hidden)
    make_program = functools.partial(make_scalar_program, inputs=inputs, outputs=outputs)
    make_function = functools.partial(_make_program_step, inputs, num_substeps)
    make_floor = functools.partial(make_callback_step, num_substeps=num_substeps, inputs=inputs, outputs=outputs)
    return make_scalar_function(model, len(outputs), make_program, make_function, make_floor)


def _find_hidden(model: mujoco.MjModel, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> tuple[str, ...]:
    """What a substep hands to the next one besides the inputs: where the solver starts, and a time that is read."""
    import mujoco

    fields = list_fields(outputs)
    has_clock = "sensordata" in fields and mujoco.mjtSensor.mjSENS_CLOCK in model.sensor_type
    needed = {WARMSTART: has_constraints(model), "time": "time" in fields or has_clock}
    return tuple(name for name, here in needed.items() if here and name not in inputs)


def _make_continued_step(
    model: mujoco.MjModel, num_substeps: int, inputs: tuple[str, ...], outputs: tuple[str, ...], hidden: tuple[str, ...]
) -> StepFn:
    """The step in which each substep hands the hidden fields, first 0, to the next one.

    With `qacc_warmstart` the solver may start from the acceleration of the last substep.
    """
    place = len(_find_carried(inputs))
    extended = (*outputs[:place], *hidden, *outputs[place:])
    step = make_scalar_step(model, num_substeps, (*inputs, *hidden), extended)

    def start(*arrays):
        results = step(*arrays, *(jnp.zeros(x.shape, x.dtype) for x in find_types(model, hidden)))
        return (*results[:place], *results[place + len(hidden) :])

    return start


def make_mjx_step(
    model: mujoco.MjModel, num_substeps: int, inputs: tuple[str, ...], outputs: tuple[str, ...]
) -> StepFn:
    """The substeps by `mjx.step`; arguments as in `make_scalar_step`."""
    missing = [name for name in list_fields(outputs) if name in ADDED]
    if missing:
        raise ValueError(f"{missing[0]}: mjx.step does not compute it; physics 'scalar' and 'mujoco' do")
    outputs_found = find_outputs(model, outputs)
    substep, _ = make_single_step(put_whole_model(model), inputs, outputs_found, import_mjx().step)

    def step(*arrays):
        return _repeat(lambda values: substep(*values), inputs, _find_carried(inputs), num_substeps, arrays)

    return step


PHYSICS = {"scalar": make_scalar_step, "mjx": make_mjx_step, "mujoco": make_callback_step}


def _find_carried(inputs: tuple[str, ...]) -> tuple[str, ...]:
    """The inputs that each step passes on to the next one."""
    return tuple(name for name in inputs if name in STATE)


def find_reason(model: mujoco.MjModel, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> str:
    """Why a step with these inputs and outputs has no scalar equations, in one line; empty if it has."""
    try:
        make_scalar_program(model, inputs, _order_results(inputs, outputs))
    except (UnsupportedPrimitiveError, MujocoModelError) as error:
        return describe_reason(model, error)
    return ""


def count_equations(model: mujoco.MjModel, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> int:
    """The number of scalar equations of one physics step; raises as `make_scalar_program`."""
    return len(make_scalar_program(model, inputs, _order_results(inputs, outputs)))


def _order_results(inputs: tuple[str, ...], outputs: tuple[str, ...]) -> tuple[str, ...]:
    """The inputs that a step changes, in their order, followed by other outputs."""
    carried = _find_carried(inputs)
    return carried + tuple(name for name in outputs if name not in carried)


def make_scalar_program(
    model: mujoco.MjModel, inputs: tuple[str, ...], outputs: tuple[str, ...], differentiable: bool = False
) -> Program:
    """One physics step as scalar equations; if they are in the store of `storage.use_store`, nothing is traced.

    Args:
      model, inputs, outputs: as in `make_scalar_step`.
      differentiable: as in `trace_step`.

    Raises:
      UnsupportedPrimitiveError: the step has no such form, or a very long one.
      MujocoModelError: MJX does not take the model.
    """

    def make():
        from envs.physics.dynamics.program import trace_step  # loads mujoco

        return trace_step(model, inputs, outputs, differentiable)

    return remember(make_name(model, inputs, outputs, differentiable), make)


def _make_program_step(inputs, num_substeps: int, program: Program, stages: list[Stage]) -> Callable:
    """The substeps by scalar equations; elements are joined into arrays only at the end.

    If the program has a flag as its last argument and result (`trace_step`), it is 0 in the beginning.
    """
    is_watching = len(program.inputs) > len(inputs)
    names = [name for name, array in zip((*inputs, FLAG), program.inputs, strict=False) for _ in array.flat]
    carried = (*_find_carried(inputs), FLAG)
    num_carried = sum(name in carried for name in names)

    def run(elements: list) -> list:
        return (
            _move(program.run(elements, stages), -1, num_carried - 1) if is_watching else program.run(elements, stages)
        )

    def step(*arrays):
        batch = arrays[0].shape[: arrays[0].ndim - program.inputs[0].ndim]
        elements = program.split((*arrays, jnp.zeros(batch)) if is_watching else arrays)
        results = list(_repeat(run, names, carried, num_substeps, elements))
        return tuple(program.join(_move(results, num_carried - 1, len(results) - 1) if is_watching else results))

    return step


def _move(items: list, begin: int, end: int) -> list:
    """The list with one item moved."""
    item = items.pop(begin)
    return [*items[:end], item, *items[end:]]


def _repeat(function: Callable[[list], Sequence], names, carried, length: int, values: Sequence) -> tuple:
    """Applies `function` to the named values `length` times, feeding back the carried ones; returns the last results.

    Results begin with the carried values, in their order.
    """
    is_carried = [name in carried for name in names]
    num_carried = sum(is_carried)

    def substep(state, _):
        state = iter(state)
        results = function([next(state) if carry else x for carry, x in zip(is_carried, values, strict=True)])
        return tuple(results[:num_carried]), tuple(results[num_carried:])

    state = tuple(x for carry, x in zip(is_carried, values, strict=True) if carry)
    if length == 1:
        state, others = substep(state, None)
        return (*state, *others)
    state, others = jax.lax.scan(substep, state, length=length)
    return (*state, *(other[-1] for other in others))
