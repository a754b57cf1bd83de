"""One control step of a MuJoCo model, as a function of the few arrays that change.

`compile_step` returns MJX's step as scalar equations (`envs.physics.interpreter`). A model without this form is stepped
by `mjx.step` itself, and any model can be stepped by C MuJoCo (`envs.physics.callback`). Each is a function of one
environment; use `jax.vmap` for batches.
"""

from __future__ import annotations

import copy
import functools
import logging
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from envs.physics.callback import make_callback_step
from envs.physics.fields import MODEL, STATE, check_names, convert_arguments, find_types
from envs.physics.interpreter import Program, trace
from envs.physics.models import import_mjx, model_digest, model_name, put_model
from envs.physics.obstacles import find_likely_obstacles, find_obstacles
from envs.physics.primitives import UnsupportedPrimitiveError
from envs.physics.stages import Stage
from envs.physics.storage import load_or_make, make_name
from envs.physics.tiles import make_tiled

if TYPE_CHECKING:
    import mujoco

logger = logging.getLogger(__name__)

StepFn = Callable[..., tuple[jax.Array, ...]]

_warned: set[bytes] = set()  # digests of the models that `_warn_once` has warned about


def compile_step(
    model: mujoco.MjModel,
    num_substeps: int = 1,
    *,
    inputs: tuple[str, ...] = ("qpos", "qvel", "ctrl"),
    outputs: tuple[str, ...] = ("qpos", "qvel"),
    physics: str = "scalar",
) -> StepFn:
    """`num_substeps` times `mjx.step`, with everything but the state held constant.

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
      physics: "scalar": scalar equations, or for a model without this form `mjx.step`, with a warning that names the
        feature; "mjx": `mjx.step`; "mujoco": C MuJoCo's step in double precision, which cannot be differentiated.

    Returns:
      A function of the inputs (SI units; ctrl in the actuators' units) of one environment, in jax's default precision.
      A NaN in the state stays in the state. With "mujoco", all outputs of an environment that has diverged are NaN; see
      `make_callback_step`. The function raises ValueError for a wrong shape, and TypeError for a wrong dtype or number
      of arguments.

    Raises:
      ValueError: a name is unknown (with the nearest one), cannot be an input, or cannot differ between environments;
        the inputs lack the activations of the model; or `physics` is unknown.
      MujocoModelError: MJX cannot step the model.
    """
    if physics not in PHYSICS:
        raise ValueError(f"physics is {physics!r}; it must be one of {', '.join(PHYSICS)}")
    check_names(model, inputs, outputs)
    carried = _find_carried(inputs)
    results = carried + tuple(name for name in outputs if name not in carried)
    compute = PHYSICS[physics](model, num_substeps, inputs, results)

    def step(*arrays):
        arguments = convert_arguments(inputs, find_types(model, inputs), arrays)
        values = dict(zip(results, compute(*arguments), strict=True))
        return tuple(values[name] for name in outputs)

    return step


def make_scalar_step(
    model: mujoco.MjModel, num_substeps: int, inputs: tuple[str, ...], outputs: tuple[str, ...]
) -> StepFn:
    """The substeps as scalar equations, or for a model without this form as `mjx.step`, with a warning.

    Args:
      model, num_substeps, inputs: as in `compile_step`.
      outputs: the inputs that a step changes, in their order, followed by other outputs.
    """
    try:
        program = make_scalar_program(model, inputs, outputs)
        carried = _find_carried(inputs)
        return make_tiled(program, functools.partial(_make_program_step, program, inputs, carried, num_substeps))
    except UnsupportedPrimitiveError as error:
        _warn_once(model, "; ".join(find_likely_obstacles(model)) or str(error))
    return make_mjx_step(_avoid_lapack(model), num_substeps, inputs, outputs)


def make_mjx_step(
    model: mujoco.MjModel, num_substeps: int, inputs: tuple[str, ...], outputs: tuple[str, ...]
) -> StepFn:
    """The substeps by `mjx.step`; arguments as in `make_scalar_step`."""
    substep, _ = make_single_step(model, inputs, outputs)

    def step(*arrays):
        return _repeat(lambda values: substep(*values), inputs, _find_carried(inputs), num_substeps, arrays)

    return step


PHYSICS = {"scalar": make_scalar_step, "mjx": make_mjx_step, "mujoco": make_callback_step}


def _find_carried(inputs: tuple[str, ...]) -> tuple[str, ...]:
    """The inputs that each step passes on to the next one."""
    return tuple(name for name in inputs if name in STATE)


def make_scalar_program(model: mujoco.MjModel, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> Program:
    """One physics step as scalar equations; if they are in the store of `storage.use_store`, MJX is not even imported.

    Raises:
      UnsupportedPrimitiveError: the step has no such form.
    """

    def make():
        obstacles = find_obstacles(model)
        if obstacles and "qpos" in inputs and "qvel" in outputs:
            raise UnsupportedPrimitiveError("; ".join(obstacles))
        step, example = make_single_step(model, inputs, outputs)
        return trace(step, *example)

    return load_or_make(make_name(model, inputs, outputs), make)


def _warn_once(model: mujoco.MjModel, reason: str) -> None:
    """Warns, once for each model in this process, that it has no scalar equations, and says what to do."""
    digest = model_digest(model)
    if digest not in _warned:
        _warned.add(digest)
        logger.warning(
            "%s has no form as scalar equations and is stepped by mjx.step, which takes long to compile and is slow on "
            "a CPU (physics='mujoco' is faster there): %s. See docs/physics.md",
            model_name(model),
            reason,
        )


def make_single_step(model: mujoco.MjModel, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> tuple[Callable, list]:
    """`mjx.step` as a function from the named inputs to the named outputs, with example arguments."""
    mjx = import_mjx()
    mjx_model = put_model(model)
    _check_model_fields(mjx_model, inputs)
    initial = mjx.make_data(mjx_model)

    def step(*arrays):
        given = dict(zip(inputs, arrays, strict=True))
        changed = {name.removeprefix(MODEL): x for name, x in given.items() if name.startswith(MODEL)}
        data = initial.replace(**{name: x for name, x in given.items() if not name.startswith(MODEL)})
        data = mjx.step(mjx_model.tree_replace(changed), data)
        return tuple(getattr(data, name) for name in outputs)

    return step, [_get_field(mjx_model if name.startswith(MODEL) else initial, name) for name in inputs]


def _check_model_fields(mjx_model, inputs: tuple[str, ...]) -> None:
    """Raises ValueError for a field of the model that MJX treats as a constant."""
    paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(mjx_model)]
    known = [MODEL + jax.tree_util.keystr(path, simple=True, separator=".") for path in paths]
    for name in inputs:
        if name.startswith(MODEL) and name not in known:
            raise ValueError(f"MJX treats {name} as a constant: it cannot be an input")


def _get_field(owner, name: str) -> jax.Array:
    for part in name.removeprefix(MODEL).split("."):
        owner = getattr(owner, part)
    return jnp.asarray(owner)


def _make_program_step(program: Program, inputs, carried, num_substeps: int, stages: list[Stage]) -> Callable:
    """The substeps by scalar equations; elements are joined into arrays only at the end."""
    names = [name for name, array in zip(inputs, program.inputs, strict=True) for _ in array.flat]

    def step(*arrays):
        elements = program.split(arrays)
        return tuple(program.join(_repeat(lambda x: program.run(x, stages), names, carried, num_substeps, elements)))

    return step


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


def _avoid_lapack(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model with sparse matrices and the conjugate-gradient solver, for which MJX does not call LAPACK.

    Some jaxlib releases hang when batched LAPACK calls fill their thread pool. Both solvers minimise the same convex
    function.
    """
    import mujoco

    model = copy.copy(model)
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    model.opt.solver = mujoco.mjtSolver.mjSOL_CG
    return model
