"""The inputs and outputs of a physics step: fields of MuJoCo's data and model, by name.

Names are those of `mjx.Data` and `mjx.Model`; shapes are those of one environment, for every way of stepping.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Collection, Sequence
from typing import TYPE_CHECKING, Any

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
OUTPUTS = (*INPUTS, "qacc", "act_dot", "sensordata", *POSITIONS, *FORCES)


def check_names(model: mujoco.MjModel, inputs: Sequence[str], outputs: Sequence[str]) -> None:
    """Raises ValueError if there is no such field (with the nearest name), or it cannot be an input or output."""
    for name in inputs:
        if name.startswith(MODEL):
            known = list_model_fields(model)
        else:
            known = INPUTS
            if name in OUTPUTS and name not in INPUTS:
                raise ValueError(f"{name} is computed by the step; the inputs can be {', '.join(INPUTS)}")
        if name not in known:
            raise ValueError(_describe_unknown("input", name, known))
    for name in outputs:
        if name not in OUTPUTS:
            raise ValueError(_describe_unknown("output", name, OUTPUTS))
    if not inputs:
        raise ValueError(f"a step needs at least one input, of {', '.join(INPUTS)}")
    for names in (inputs, outputs):
        duplicates = [name for name in names if list(names).count(name) > 1]
        if duplicates:
            raise ValueError(f"{duplicates[0]} is named twice")
    if model.na and "act" not in inputs:
        raise ValueError(f"the model has {model.na} actuator activation states: the inputs {inputs} must include act")


def _describe_unknown(kind: str, name: str, known: Collection[str]) -> str:
    """One line about an unknown name, with the nearest known one."""
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
    return [_find_type(model if name.startswith(MODEL) else data, name.removeprefix(MODEL)) for name in names]


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
    mjx_model: Any, inputs: tuple[str, ...], outputs: tuple[str, ...], advance: Callable
) -> tuple[Callable, list]:
    """One physics step as a function from the named inputs to the named outputs, with example arguments.

    Args:
      mjx_model: an `mjx.Model`.
      inputs, outputs: names as in `compile_step`.
      advance: (mjx.Model, mjx.Data) -> mjx.Data after a step.
    """
    _check_model_fields(mjx_model, inputs)
    initial = import_mjx().make_data(mjx_model)

    def step(*arrays):
        given = dict(zip(inputs, arrays, strict=True))
        changed = {name.removeprefix(MODEL): x for name, x in given.items() if name.startswith(MODEL)}
        data = initial.replace(**{name: x for name, x in given.items() if not name.startswith(MODEL)})
        data = advance(mjx_model.tree_replace(changed), data)
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
