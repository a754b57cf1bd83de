"""One control step of a MuJoCo model, as a function of the few arrays that change.

`compile_step` gives MJX's step as scalar equations (`envs.physics.interpreter`); what has no such form is stepped by
`mjx.step` itself, and on demand all is by C MuJoCo (`envs.physics.callback`). Either way it is a function of one
environment, and batches are made by `jax.vmap` of it.
"""

from __future__ import annotations

import copy
import functools
import logging
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from envs.physics.callback import callback_step
from envs.physics.fields import MODEL, STATE, as_arguments, check_names, types_of
from envs.physics.interpreter import Program, trace
from envs.physics.models import import_mjx, model_digest, model_name, put_model
from envs.physics.obstacles import likely_obstacles, obstacles
from envs.physics.primitives import UnsupportedPrimitiveError
from envs.physics.stages import Stage
from envs.physics.storage import kept, name_of
from envs.physics.tiles import in_tiles

if TYPE_CHECKING:
    import mujoco

logger = logging.getLogger(__name__)

StepFn = Callable[..., tuple[jax.Array, ...]]

_warned: set[bytes] = set()  # digests of the models that `_warn_once` has spoken of


def compile_step(
    model: mujoco.MjModel,
    num_substeps: int = 1,
    *,
    inputs: tuple[str, ...] = ("qpos", "qvel", "ctrl"),
    outputs: tuple[str, ...] = ("qpos", "qvel"),
    physics: str = "scalar",
) -> StepFn:
    """`num_substeps` times `mjx.step` with all but the state held.

    Args:
      model: a compiled model.
      num_substeps: physics steps of `model.opt.timestep` seconds in one control step.
      inputs: what the step is a function of, in this order: fields of `mjx.Data` (`fields.INPUTS`: qpos, qvel, act,
        ctrl, mocap_pos, qfrc_applied, qacc_warmstart, ...) and, as `model.` and its name, of `mjx.Model`
        (model.body_mass, model.dof_damping, model.opt.gravity, ...), for models that differ between the environments.
        All else is as `mjx.make_data` and the model have it.
      outputs: the fields of `mjx.Data` (`fields.OUTPUTS`) that the step returns, in this order, as they are after the
        last substep. As in MuJoCo, what is derived from the positions (xpos, site_xpos, sensordata, ...) belongs to the
        state before that substep.
      physics: "scalar": scalar equations, or `mjx.step` with a logged line that names the model's feature if it has
        none; "mjx": `mjx.step`; "mujoco": C MuJoCo's step in double precision, which cannot be differentiated.

    Returns:
      A function of the inputs (SI units; ctrl in the actuators' units) of one environment, in jax's default precision.
      A NaN in the state stays in the state. By "mujoco" all that is returned of an environment is NaN where it has
      diverged, as `callback_step` says. The function raises ValueError for a shape, and TypeError for a dtype or a
      number of arguments, that does not fit the inputs.

    Raises:
      ValueError: a name is unknown (with the nearest one), is not what a step is a function of, or cannot differ
        between environments; the model's state is not among the inputs (activations); or `physics` is unknown.
      MujocoModelError: MJX cannot step the model.
    """
    if physics not in PHYSICS:
        raise ValueError(f"physics is {physics!r}; it must be one of {', '.join(PHYSICS)}")
    check_names(model, inputs, outputs)
    carried = _carried(inputs)
    results = carried + tuple(name for name in outputs if name not in carried)
    repeated = PHYSICS[physics](model, num_substeps, inputs, results)

    def step(*arrays):
        arguments = as_arguments(inputs, types_of(model, inputs), arrays)
        values = dict(zip(results, repeated(*arguments), strict=True))
        return tuple(values[name] for name in outputs)

    return step


def scalar_step(model: mujoco.MjModel, num_substeps: int, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> StepFn:
    """The substeps as scalar equations, or as `mjx_step` of a model that has no such form, which is logged.

    Args:
      model, num_substeps, inputs: as in `compile_step`.
      outputs: the inputs that a step changes, in their order, and others after them.
    """
    try:
        program = scalar_program(model, inputs, outputs)
        return in_tiles(program, functools.partial(_program_step, program, inputs, _carried(inputs), num_substeps))
    except UnsupportedPrimitiveError as error:
        _warn_once(model, "; ".join(likely_obstacles(model)) or str(error))
    return mjx_step(_without_lapack(model), num_substeps, inputs, outputs)


def mjx_step(model: mujoco.MjModel, num_substeps: int, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> StepFn:
    """The substeps as `mjx.step`; arguments as in `scalar_step`."""
    once, _ = single_step(model, inputs, outputs)

    def repeated(*arrays):
        return _repeat(lambda values: once(*values), inputs, _carried(inputs), num_substeps, arrays)

    return repeated


PHYSICS = {"scalar": scalar_step, "mjx": mjx_step, "mujoco": callback_step}


def _carried(inputs: tuple[str, ...]) -> tuple[str, ...]:
    """The inputs that a step changes, and the next one begins with."""
    return tuple(name for name in inputs if name in STATE)


def scalar_program(model: mujoco.MjModel, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> Program:
    """One physics step as scalar equations, kept if `storage.kept_in` says where; then MJX is not even imported.

    Raises:
      UnsupportedPrimitiveError: it has no such form.
    """

    def make():
        found = obstacles(model)
        if found and "qpos" in inputs and "qvel" in outputs:
            raise UnsupportedPrimitiveError("; ".join(found))
        step, example = single_step(model, inputs, outputs)
        return trace(step, *example)

    return kept(name_of(model, inputs, outputs), make)


def _warn_once(model: mujoco.MjModel, reason: str) -> None:
    """Says that a model has no scalar equations, and what to do, when it is met for the first time in this process."""
    digest = model_digest(model)
    if digest not in _warned:
        _warned.add(digest)
        logger.warning(
            "%s has no form as scalar equations and is stepped by mjx.step, which takes long to compile and is slow on "
            "a CPU (physics='mujoco' is faster there): %s. See docs/physics.md",
            model_name(model),
            reason,
        )


def single_step(model: mujoco.MjModel, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> tuple[Callable, list]:
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

    return step, [_field(mjx_model if name.startswith(MODEL) else initial, name) for name in inputs]


def _check_model_fields(mjx_model, inputs: tuple[str, ...]) -> None:
    """Raises ValueError for a field of the model that is a constant to MJX."""
    paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(mjx_model)]
    known = [MODEL + jax.tree_util.keystr(path, simple=True, separator=".") for path in paths]
    for name in inputs:
        if name.startswith(MODEL) and name not in known:
            raise ValueError(f"MJX does not compute with a changed {name}: it cannot be an input")


def _field(owner, name: str) -> jax.Array:
    for part in name.removeprefix(MODEL).split("."):
        owner = getattr(owner, part)
    return jnp.asarray(owner)


def _program_step(program: Program, inputs, carried, num_substeps: int, stages: list[Stage]) -> Callable:
    """The substeps of scalar equations; the elements stay apart until the end."""
    names = [name for name, array in zip(inputs, program.inputs, strict=True) for _ in array.flat]

    def step(*arrays):
        elements = program.split(arrays)
        return tuple(program.join(_repeat(lambda x: program.run(x, stages), names, carried, num_substeps, elements)))

    return step


def _repeat(function: Callable[[list], Sequence], names, carried, length: int, values: Sequence) -> tuple:
    """`function` of the named values, `length` times with the carried ones fed back: the last of all its results.

    The results begin with the carried ones, in the values' order.
    """
    is_carried = [name in carried for name in names]
    num_carried = sum(is_carried)

    def substep(state, _):
        state = iter(state)
        results = function([next(state) if fed_back else x for fed_back, x in zip(is_carried, values, strict=True)])
        return tuple(results[:num_carried]), tuple(results[num_carried:])

    state = tuple(x for fed_back, x in zip(is_carried, values, strict=True) if fed_back)
    if length == 1:
        state, others = substep(state, None)
        return (*state, *others)
    state, others = jax.lax.scan(substep, state, length=length)
    return (*state, *(other[-1] for other in others))


def _without_lapack(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model with sparse matrices and the conjugate-gradient solver, in whose step MJX calls no LAPACK.

    Some jaxlib releases hang when batched LAPACK calls fill their thread pool. Both solvers find the minimum of the
    same convex function.
    """
    import mujoco

    model = copy.copy(model)
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    model.opt.solver = mujoco.mjtSolver.mjSOL_CG
    return model
