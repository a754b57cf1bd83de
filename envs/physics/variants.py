"""Finds all fields in which variants of a model differ, for example if their masses differ."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.physics.fields import list_model_fields
from envs.physics.models import import_mjx

if TYPE_CHECKING:
    import mujoco


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
