"""What a physics step is a function of and what it gives: fields of MuJoCo's data and model, by their names.

The names are those of `mjx.Data` and `mjx.Model`, the shapes those of one environment, whichever way it is stepped.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

if TYPE_CHECKING:
    import mujoco

MODEL = "model."  # before the name of a field of the model
STATE = ("qpos", "qvel", "act", "qacc_warmstart", "time")  # what a step hands on to the next one
INPUTS = (*STATE, "ctrl", "qfrc_applied", "xfrc_applied", "eq_active", "mocap_pos", "mocap_quat")
POSITIONS = ("xpos", "xquat", "xmat", "xipos", "ximat", "xanchor", "xaxis", "ten_length", "geom_xpos", "geom_xmat")
POSITIONS += ("site_xpos", "site_xmat", "cam_xpos", "cam_xmat", "subtree_com", "cvel", "cdof", "cdof_dot")
FORCES = ("qfrc_bias", "qfrc_gravcomp", "qfrc_fluid", "qfrc_passive", "qfrc_actuator", "actuator_force")
FORCES += ("actuator_length", "qfrc_smooth", "qacc_smooth", "qfrc_constraint", "qfrc_inverse")
OUTPUTS = (*INPUTS, "qacc", "act_dot", "sensordata", *POSITIONS, *FORCES)


def check_names(model: mujoco.MjModel, inputs: Sequence[str], outputs: Sequence[str]) -> None:
    """Raises ValueError, with the nearest name, where there is no such field, or the step is no function of it."""
    for name in inputs:
        if name.startswith(MODEL):
            known = model_fields(model)
        else:
            known = INPUTS
            if name in OUTPUTS and name not in INPUTS:
                raise ValueError(f"{name} is what the step computes; it is a function of {', '.join(INPUTS)}")
        if name not in known:
            raise ValueError(_unknown("input", name, known))
    for name in outputs:
        if name not in OUTPUTS:
            raise ValueError(_unknown("output", name, OUTPUTS))
    if not inputs:
        raise ValueError(f"a step is a function of some of {', '.join(INPUTS)}; the inputs name none")
    for names in (inputs, outputs):
        twice = [name for name in names if list(names).count(name) > 1]
        if twice:
            raise ValueError(f"{twice[0]} is named twice")
    if model.na and "act" not in inputs:
        raise ValueError(f"the model has {model.na} actuator activation states, which the inputs {inputs} do not carry")


def _unknown(kind: str, name: str, known: Collection[str]) -> str:
    """One line for a name that there is not, with the nearest one that there is."""
    (nearest,) = difflib.get_close_matches(name, known, n=1, cutoff=0)
    return f"unknown {kind} '{name}': did you mean '{nearest}'?"


def model_fields(model: mujoco.MjModel) -> list[str]:
    """The real numbers of a model and of its options, each as `model.` and its name."""
    owners = {MODEL: model, MODEL + "opt.": model.opt}
    return [
        prefix + name
        for prefix, owner in owners.items()
        for name in dir(owner)
        if not name.startswith("_") and _is_real(getattr(owner, name))
    ]


def _is_real(value: Any) -> bool:
    return isinstance(value, float) or (isinstance(value, np.ndarray) and value.dtype.kind == "f")


def types_of(model: mujoco.MjModel, names: Sequence[str]) -> list[jax.ShapeDtypeStruct]:
    """Shapes and dtypes of the fields in one environment; real numbers have jax's default precision."""
    import mujoco

    data = mujoco.MjData(model)
    return [_type_of(model if name.startswith(MODEL) else data, name.removeprefix(MODEL)) for name in names]


def _type_of(owner: Any, name: str) -> jax.ShapeDtypeStruct:
    for part in name.split("."):
        owner = getattr(owner, part)
    shape = np.shape(owner)
    if "mat" in name and shape[1:] == (9,):  # C MuJoCo has its matrices as rows
        shape = (shape[0], 3, 3)
    return jax.ShapeDtypeStruct(shape, bool if name == "eq_active" else jnp.result_type(float))


def as_arguments(names: Sequence[str], types: Sequence[jax.ShapeDtypeStruct], values: Sequence[Any]) -> list[jax.Array]:
    """The values as arrays of the fields' types.

    Raises:
      TypeError: another number of values, or a value that is no real number (for eq_active: no truth value).
      ValueError: a value has another shape than its field.
    """
    if len(values) != len(names):
        raise TypeError(f"the step is a function of {', '.join(names)}; got {len(values)} arguments")
    return [_as_argument(name, wanted, x) for name, wanted, x in zip(names, types, values, strict=True)]


def _as_argument(name: str, wanted: jax.ShapeDtypeStruct, value: Any) -> jax.Array:
    array = jnp.asarray(value)
    if array.shape != wanted.shape:
        raise ValueError(
            f"{name} has the shape {array.shape}; in one environment it is {wanted.shape}, and batches are made by "
            "jax.vmap of the step"
        )
    kinds = (jnp.bool_, jnp.integer) if wanted.dtype == bool else (jnp.floating, jnp.integer)
    if not any(jnp.issubdtype(array.dtype, kind) for kind in kinds):
        raise TypeError(f"{name} has the dtype {array.dtype}; it must be {wanted.dtype.name}, or integers")
    return array.astype(wanted.dtype)
