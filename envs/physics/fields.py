"""The inputs and outputs of a physics step: fields of MuJoCo's data and model, by name.

Names are those of `mjx.Data` and `mjx.Model`, and of what C MuJoCo's data or functions have besides (`ADDED`); shapes
are those of one environment, for every way of stepping. An output can be the part of a field that belongs to one
object: `site_xpos[hand]`, `sensordata[imu]`, `qpos[elbow]`.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.physics.models import import_mjx

if TYPE_CHECKING:
    import mujoco

MODEL = "model."  # prefix of the fields of the model
FLAG = "flag"  # of a step whose contacts are not all part of its equations
STATE = ("qpos", "qvel", "act", "qacc_warmstart", "time")  # carried from one step to the next
INPUTS = (*STATE, "ctrl", "qfrc_applied", "xfrc_applied", "eq_active", "mocap_pos", "mocap_quat")
POSITIONS = ("xpos", "xquat", "xmat", "xipos", "ximat", "xanchor", "xaxis", "ten_length", "geom_xpos", "geom_xmat")
POSITIONS += ("site_xpos", "site_xmat", "cam_xpos", "cam_xmat", "subtree_com", "cvel", "cdof", "cdof_dot")
FORCES = ("qfrc_bias", "qfrc_gravcomp", "qfrc_fluid", "qfrc_passive", "qfrc_actuator", "actuator_force")
FORCES += ("actuator_length", "qfrc_smooth", "qacc_smooth", "qfrc_constraint", "qfrc_inverse")
COMPUTED = ("qacc", "act_dot", "sensordata", *POSITIONS, *FORCES)
# Jacobians of the origins of sites and bodies, as of mj_jacSite and mj_jacBody: velocity = jacp qvel, spin = jacr qvel.
JACOBIANS = ("site_jacp", "site_jacr", "body_jacp", "body_jacr")
ADDED = ("energy", "cfrc_ext", *JACOBIANS)  # not in mjx.Data
OUTPUTS = (*INPUTS, *COMPUTED, *ADDED)
# What follows from positions alone.
KINEMATICS = (*(name for name in POSITIONS if name not in ("cvel", "cdof_dot")), *JACOBIANS)
# What inverse dynamics compute.
INVERSE = ("qfrc_inverse", "qfrc_constraint", "qfrc_bias", "qfrc_passive", *KINEMATICS)
# The objects that the rows of a field belong to, and those whose parts of a field have several numbers.
BODY_FIELDS = ("xpos", "xquat", "xmat", "xipos", "ximat", "subtree_com", "cvel", "cfrc_ext", "xfrc_applied")
PREFIXES = {"site_": "site", "body_": "body", "geom_": "geom", "cam_": "camera", "actuator_": "actuator"}
PREFIXES |= {"ten_": "tendon", "qfrc_": "joint", "qacc": "joint", "cdof": "joint"}
OWNERS = {"ctrl": "actuator", "sensordata": "sensor", "eq_active": "equality"}
OWNERS |= dict.fromkeys(BODY_FIELDS, "body") | dict.fromkeys(("qpos", "qvel", "xanchor", "xaxis"), "joint")


class Output(NamedTuple):
    """A field, and which part of it: all if `place` is None."""

    field: str
    place: int | slice | None


def find_outputs(model: mujoco.MjModel, names: Iterable[str]) -> list[Output]:
    """The fields that names mean, as "xpos", or as "xpos[hand]" for what belongs to the body called hand.

    Of fields with one row for each object, a part is that row: `xpos[hand]` is `[3]`, `ten_length[cable]` a scalar. A
    joint's part of fields of positions, velocities and forces, and a sensor's of sensordata, are one or more numbers.

    Raises:
      ValueError: there is no such field or object (with the nearest name), or the field's parts belong to no object.
    """
    return [_find_output(model, name) for name in names]


def list_fields(names: Iterable[str]) -> tuple[str, ...]:
    """The fields of which outputs are parts, each once."""
    return tuple(dict.fromkeys(name.partition("[")[0] for name in names))


def _find_output(model, name: str) -> Output:
    match = re.fullmatch(r"(\w+)(?:\[(.*)\])?", name)
    field, key = match.groups() if match else (name, None)
    if field not in OUTPUTS:
        raise ValueError(_describe_unknown("output", field, OUTPUTS))
    if key is None:
        return Output(field, None)
    return Output(field, _find_place(model, field, key))


def _find_place(model, field: str, key: str) -> int | slice:
    """Where the part of a field that belongs to the object called `key` is."""
    import mujoco

    kind = OWNERS.get(field) or next((kind for prefix, kind in PREFIXES.items() if field.startswith(prefix)), None)
    if kind is None:
        raise ValueError(f"{field}[{key}]: the parts of {field} have no names")
    number = mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), key)
    if number < 0:
        raise ValueError(f"{field}[{key}]: {_describe_unknown(kind, key, _list_names(model, kind))}")
    if field == "sensordata":
        return slice(int(model.sensor_adr[number]), int(model.sensor_adr[number] + model.sensor_dim[number]))
    if kind != "joint" or field in ("xanchor", "xaxis"):
        return number
    positions, velocities = _count_coordinates(int(model.jnt_type[number]))
    if field == "qpos":
        return slice(int(model.jnt_qposadr[number]), int(model.jnt_qposadr[number]) + positions)
    return slice(int(model.jnt_dofadr[number]), int(model.jnt_dofadr[number]) + velocities)


def _count_coordinates(joint_type: int) -> tuple[int, int]:
    """How many positions and velocities a joint has."""
    import mujoco

    kinds = mujoco.mjtJoint
    return {int(kinds.mjJNT_FREE): (7, 6), int(kinds.mjJNT_BALL): (4, 3)}.get(joint_type, (1, 1))


def _list_names(model, kind: str) -> list[str]:
    import mujoco

    code = getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
    names = (mujoco.mj_id2name(model, code, i) for i in range(_count_objects(model, kind)))
    return [name for name in names if name]


def _count_objects(model, kind: str) -> int:
    sizes = {"joint": "njnt", "camera": "ncam", "actuator": "nu", "equality": "neq"}
    return int(getattr(model, sizes.get(kind, f"n{kind}")))


def check_names(
    model: mujoco.MjModel,
    inputs: Sequence[str],
    outputs: Sequence[str],
    needs_act: bool = True,
    inputs_known: Sequence[str] = INPUTS,
    outputs_known: Sequence[str] = OUTPUTS,
) -> None:
    """Raises ValueError if there is no such field (with the nearest name), or it cannot be an input or output."""
    for name in inputs:
        if name.startswith(MODEL):
            known = list_model_fields(model)
        else:
            known = inputs_known
            if name in OUTPUTS and name not in known:
                raise ValueError(f"{name} is computed by the step; the inputs can be {', '.join(known)}")
        if name not in known:
            raise ValueError(_describe_unknown("input", name, known))
    for output in find_outputs(model, outputs):
        if output.field not in outputs_known:
            raise ValueError(f"{output.field} is not computed here; the outputs can be {', '.join(outputs_known)}")
    if not inputs:
        raise ValueError(f"a step needs at least one input, of {', '.join(inputs_known)}")
    for names in (inputs, outputs):
        duplicates = [name for name in names if list(names).count(name) > 1]
        if duplicates:
            raise ValueError(f"{duplicates[0]} is named twice")
    if needs_act and model.na and "act" not in inputs:
        raise ValueError(f"the model has {model.na} actuator activation states: the inputs {inputs} must include act")


def check_model_names(model: mujoco.MjModel, names: Sequence[str]) -> None:
    """Raises ValueError if the model has no real-valued field of one of these names (with the nearest one)."""
    known = list_model_fields(model)
    for name in names:
        if name not in known:
            raise ValueError(_describe_unknown("field", name, known))


def _describe_unknown(kind: str, name: str, known: Collection[str]) -> str:
    """One line about an unknown name, with the nearest known one."""
    if not known:
        return f"unknown {kind} '{name}': the model has none with a name"
    (nearest,) = difflib.get_close_matches(name, known, n=1, cutoff=0)
    return f"unknown {kind} '{name}': did you mean '{nearest}'?"


def list_model_fields(model: mujoco.MjModel) -> list[str]:
    """The names of the real-valued fields of a model and of its options, each prefixed with `model.`."""
    owners = {MODEL: model, MODEL + "opt.": model.opt}
    return [
        prefix + name
        for prefix, owner in owners.items()
        for name in dir(owner)
        if not name.startswith("_") and _is_real(getattr(owner, name))
    ]


def _is_real(value: Any) -> bool:
    return isinstance(value, float) or (isinstance(value, np.ndarray) and value.dtype.kind == "f")


def find_types(model: mujoco.MjModel, names: Sequence[str]) -> list[jax.ShapeDtypeStruct]:
    """Shapes and dtypes of the fields of one environment; real numbers have jax's default precision."""
    import mujoco

    data = mujoco.MjData(model)
    return [
        _find_type(model, name.removeprefix(MODEL)) if name.startswith(MODEL) else _find_output_type(model, data, name)
        for name in names
    ]


def _find_output_type(model, data: Any, name: str) -> jax.ShapeDtypeStruct:
    output = _find_output(model, name)
    whole = (
        _find_type(data, output.field) if output.field not in JACOBIANS else _find_jacobian_type(model, output.field)
    )
    if output.place is None:
        return whole
    return jax.ShapeDtypeStruct(np.empty(whole.shape, bool)[output.place].shape, whole.dtype)


def _find_jacobian_type(model, field: str) -> jax.ShapeDtypeStruct:
    number = model.nsite if field.startswith("site") else model.nbody
    return jax.ShapeDtypeStruct((number, 3, model.nv), jnp.result_type(float))


def _find_type(owner: Any, name: str) -> jax.ShapeDtypeStruct:
    for part in name.split("."):
        owner = getattr(owner, part)
    shape = np.shape(owner)
    if "mat" in name and shape[1:] == (9,):  # C MuJoCo stores matrices as rows of 9 numbers
        shape = (shape[0], 3, 3)
    return jax.ShapeDtypeStruct(shape, bool if name == "eq_active" else jnp.result_type(float))


def convert_arguments(
    names: Sequence[str], types: Sequence[jax.ShapeDtypeStruct], values: Sequence[Any]
) -> list[jax.Array]:
    """Converts the values to arrays of the fields' types.

    Raises:
      TypeError: the number of values is wrong, or a value is not real (for eq_active: not bool or integer).
      ValueError: a value has a different shape from its field.
    """
    if len(values) != len(names):
        raise TypeError(f"the step is a function of {', '.join(names)}; got {len(values)} arguments")
    return [_convert_argument(name, expected, x) for name, expected, x in zip(names, types, values, strict=True)]


def _convert_argument(name: str, expected: jax.ShapeDtypeStruct, value: Any) -> jax.Array:
    array = jnp.asarray(value)
    if array.shape != expected.shape:
        raise ValueError(
            f"{name} has the shape {array.shape}; in one environment it is {expected.shape}, and batches are made by "
            "jax.vmap of the step"
        )
    kinds = (jnp.bool_, jnp.integer) if expected.dtype == bool else (jnp.floating, jnp.integer)
    if not any(jnp.issubdtype(array.dtype, kind) for kind in kinds):
        raise TypeError(f"{name} has the dtype {array.dtype}; it must be {expected.dtype.name}, or integers")
    return array.astype(expected.dtype)


# --- a step as a function of fields -----------------------------------------------------------------------------------


def make_single_step(
    mjx_model: Any, inputs: tuple[str, ...], outputs: Sequence[Output], advance: Callable
) -> tuple[Callable, list]:
    """One physics step as a function from the named inputs to the outputs, with example arguments.

    Args:
      mjx_model: an `mjx.Model`.
      inputs: names as in `compile_step`.
      outputs: fields and parts of them.
      advance: (mjx.Model, mjx.Data) -> mjx.Data after a step.
    """
    check_varying(mjx_model, inputs)
    initial = import_mjx().make_data(mjx_model)

    def step(*arrays):
        given = dict(zip(inputs, arrays, strict=True))
        changed = {name.removeprefix(MODEL): x for name, x in given.items() if name.startswith(MODEL)}
        data = initial.replace(**{name: x for name, x in given.items() if not name.startswith(MODEL)})
        data = advance(mjx_model.tree_replace(changed), data)
        return tuple(
            getattr(data, field) if place is None else jnp.asarray(getattr(data, field))[place]
            for field, place in outputs
        )

    return step, [_get_field(mjx_model if name.startswith(MODEL) else initial, name) for name in inputs]


def check_varying(mjx_model: Any, inputs: Sequence[str]) -> None:
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
