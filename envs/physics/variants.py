"""Models that differ in their numbers only: what a mass, a length or a friction changes besides itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.physics.fields import model_fields
from envs.physics.models import import_mjx

if TYPE_CHECKING:
    import mujoco


def differing_fields(models: Sequence[mujoco.MjModel]) -> dict[str, jax.Array]:
    """The numbers in which compiled models differ: name as an input of `compile_step` -> `[K, ...]`, model by model.

    As it compiles a model MuJoCo derives further numbers from a mass: moments of inertia, weights of constraints
    (dof_invweight0, body_invweight0), gains of servos with a dampratio. A step that is given `model.body_mass` alone
    keeps these of the first model, and is the step of no model at all. Here they are all found, by comparison.

    Args:
      models: compiled from the same MJCF with other numbers in it.

    Raises:
      ValueError: the models differ in more than numbers: in sizes, or in what is counted or switched.
    """
    _check_same_structure(models)
    found = {}
    for name in model_fields(models[0]):
        values = [np.asarray(_value(model, name)) for model in models]
        if _is_mjxs(name) and any((value != values[0]).any() for value in values):
            found[name] = jnp.asarray(np.stack(values))
    return found


def _check_same_structure(models: Sequence[mujoco.MjModel]) -> None:
    first = models[0]
    for name in (name for name in dir(first) if not name.startswith("_")):
        values = [np.asarray(getattr(model, name)) for model in models]
        sized = any(value.shape != values[0].shape for value in values)
        if sized or (values[0].dtype.kind in "iub" and any((value != values[0]).any() for value in values)):
            raise ValueError(f"model.{name} differs, which is no number of the physics but its structure")


def _is_mjxs(name: str) -> bool:
    """Whether MJX has such a field; what it has not, such as a tree of bounding boxes, its step does not look at."""
    mjx, parts = import_mjx(), name.split(".")[1:]
    owner = mjx.Option if len(parts) == 2 else mjx.Model
    return parts[-1] in {field.name for field in dataclasses.fields(owner)}


def _value(model: mujoco.MjModel, name: str) -> Any:
    for part in name.split(".")[1:]:
        model = getattr(model, part)
    return model
