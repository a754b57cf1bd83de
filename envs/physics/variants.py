"""All fields in which variants of a model differ, for example if their masses differ: compared, or derived."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxpr_as_fun

from envs.physics.fields import (
    MODEL,
    check_model_names,
    check_varying,
    convert_arguments,
    find_types,
    list_model_fields,
)
from envs.physics.models import import_mjx, put_model

if TYPE_CHECKING:
    import mujoco

MASS, INERTIA = MODEL + "body_mass", MODEL + "body_inertia"
COMPLETED = (MODEL + "actuator_biasprm", MODEL + "eq_data")  # of which only a part follows from other fields


def differing_fields(models: Sequence[mujoco.MjModel]) -> dict[str, jax.Array]:
    """The fields in which K compiled models differ: name as an input of `compile_step` -> values, `[K, ...]`.

    When MuJoCo compiles a model, it derives other numbers from a mass: moments of inertia, weights of constraints
    (dof_invweight0, body_invweight0), gains of servos with a dampratio. With `model.body_mass` as the only input, a
    step would keep these of the first model, and match no model at all. This function finds them all, by comparison.

    Args:
      models: models compiled from the same MJCF with different numbers.

    Raises:
      ValueError: the models differ in more than real numbers: in sizes, integers or flags.
    """
    _check_same_structure(models)
    fields = {}
    for name in list_model_fields(models[0]):
        values = [np.asarray(_get_value(model, name)) for model in models]
        if _is_mjx_field(name) and any((value != values[0]).any() for value in values):
            fields[name] = jnp.asarray(np.stack(values))
    return fields


def _check_same_structure(models: Sequence[mujoco.MjModel]) -> None:
    first = models[0]
    for name in (name for name in dir(first) if not name.startswith("_")):
        values = [np.asarray(getattr(model, name)) for model in models]
        is_resized = any(value.shape != values[0].shape for value in values)
        if is_resized or (values[0].dtype.kind in "iub" and any((value != values[0]).any() for value in values)):
            raise ValueError(f"model.{name} differs; models may differ only in real numbers of the physics")


def _is_mjx_field(name: str) -> bool:
    """Whether MJX has this field; the equations do not use others, such as the tree of bounding boxes."""
    mjx, parts = import_mjx(), name.split(".")[1:]
    owner = mjx.Option if len(parts) == 2 else mjx.Model
    return parts[-1] in {field.name for field in dataclasses.fields(owner)}


def _get_value(model: mujoco.MjModel, name: str) -> Any:
    for part in name.split(".")[1:]:
        model = getattr(model, part)
    return model


# --- fields that follow from others -----------------------------------------------------------------------------------


def derive_fields(
    model: mujoco.MjModel, changed: Mapping[str, Any], dampratio: Sequence[str] = ()
) -> dict[str, jax.Array]:
    """The changed fields of a model, with all that follow from them, as MuJoCo's `mj_setConst` derives them.

    With the mass matrix M at `qpos0`: `dof_M0`, its diagonal; `dof_invweight0`, `body_invweight0` and
    `tendon_invweight0`, the diagonals of J M^-1 J'; `body_subtreemass`; `tendon_length0`; `actuator_acc0`, where
    muscles need it; and the relative poses of `connect` and `weld` in `eq_data`. Besides, `body_inertia` is scaled with
    `body_mass`, as by a change of density, unless it is given itself. Fields that the changed ones have no influence on
    are left out.

    Can be traced, differentiated and, for fields that differ between environments, be mapped by `jax.vmap`:

        step = compile_step(model, inputs=("qpos", "qvel", "ctrl", *fields))
        qpos, qvel = step(qpos, qvel, ctrl, *fields.values())

    Args:
      model: a compiled model.
      changed: values of fields, named as inputs of `compile_step` (`model.body_mass` in kg, ...), with the shapes that
        they have in the model. A field that would be derived keeps the value that is given here;
        `actuator_biasprm` and `eq_data` do so but for what is derived.
      dampratio: names of position servos whose damping MuJoCo derived from a `dampratio` when it compiled the model,
        which does not say so any more. They keep this ratio z: `actuator_biasprm` gets their damping 2 z sqrt(k / w),
        with the gain k and the inverse inertia w that they see. In a specification, they are those with
        `actuator.biasprm[2] > 0`.

    Returns:
      Values by name, sorted by names.

    Raises:
      ValueError: there is no such field, or MJX treats it as a constant; a value has another shape; or there is no
        such servo with damping.
      TypeError: a value is not real.
      MujocoModelError: MJX refuses the model, for example because of flexible bodies.

    Source: MuJoCo's documentation, `mj_setConst`, and chapter XML Reference, `position`.
    """
    names = tuple(changed)
    check_model_names(model, names)
    values = convert_arguments(names, find_types(model, names), list(changed.values()))
    derive = _make_derivation(model, names, _find_servos(model, dampratio))
    closed, shapes = jax.make_jaxpr(derive, return_shape=True)(*values)
    depends = _find_dependent(closed.jaxpr)
    derived = dict(zip(shapes, jax.jit(jaxpr_as_fun(closed))(*values), strict=True))
    return {name: x for (name, x), follows in zip(derived.items(), depends, strict=True) if follows}


def _make_derivation(model, names: tuple[str, ...], servos: np.ndarray) -> Callable[..., dict[str, jax.Array]]:
    """The named fields -> all that they may have an influence on, sorted by name."""
    from envs.physics.dynamics.constants import find_constants, scale_inertia  # loads mujoco

    with jax.ensure_compile_time_eval():
        mx = put_model(model)
        start = import_mjx().make_data(mx)
    check_varying(mx, names)
    mocap = np.flatnonzero(model.body_mocapid >= 0)[np.argsort(model.body_mocapid[model.body_mocapid >= 0])]

    def derive(*values):
        changed = dict(zip(names, values, strict=True))
        if MASS in changed:
            changed.setdefault(INERTIA, scale_inertia(model, changed[MASS]))
        varied = mx.tree_replace({name.removeprefix(MODEL): x for name, x in changed.items()})
        d = start.replace(qpos=varied.qpos0, mocap_pos=varied.body_pos[mocap], mocap_quat=varied.body_quat[mocap])
        derived = {MODEL + name: x for name, x in find_constants(model, varied, d, servos).items() if np.size(x)}
        kept = {name: x for name, x in changed.items() if name not in COMPLETED}
        return dict(sorted((changed | derived | kept).items()))

    return derive


def _find_dependent(jaxpr) -> list[bool]:
    """Whether each result of a traced function depends on its arguments."""
    known = {id(x) for x in jaxpr.invars}
    for equation in jaxpr.eqns:
        if any(id(x) in known for x in equation.invars):
            known.update(map(id, equation.outvars))
    return [id(x) in known for x in jaxpr.outvars]


def _find_servos(model: mujoco.MjModel, names: Sequence[str]) -> np.ndarray:
    """Numbers of these position servos; raises ValueError if there is no such servo with damping."""
    known = {model.actuator(i).name: i for i in range(model.nu)}
    gain, (_, stiffness, damping) = model.actuator_gainprm[:, 0], model.actuator_biasprm[:, :3].T
    is_servo = (gain > 0) & (gain == -stiffness) & (damping < 0)
    for name in names:
        if name not in known or not is_servo[known[name]]:
            servos = ", ".join(name for name, i in known.items() if is_servo[i]) or "none"
            raise ValueError(f"dampratio: {name!r} is no position servo with damping; those of the model: {servos}")
    return np.array([known[name] for name in names], int)
