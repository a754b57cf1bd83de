"""Models that differ in their numbers only: what a mass, a length or a friction changes besides itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

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
    found = {}
    for name in _names():
        values = [np.asarray(_value(model, name)) for model in models]
        if any(value.shape != values[0].shape for value in values):
            raise ValueError(f"model.{name} differs in its size: {', '.join(str(value.shape) for value in values)}")
        if any((value != values[0]).any() for value in values):
            if values[0].dtype.kind != "f":
                raise ValueError(f"model.{name} differs, which is no number of the physics but its structure")
            found[f"model.{name}"] = jnp.asarray(np.stack(values))
    return found


def _names() -> Iterator[str]:
    """Fields of `mjx.Model`, in which MJX looks for a model's numbers; `opt` and `stat` have fields of their own."""
    import mujoco

    mjx = import_mjx()
    for field in dataclasses.fields(mjx.Model):
        if field.name in ("opt", "stat"):
            kind = {"opt": mujoco.MjOption, "stat": mujoco.MjStatistic}[field.name]
            inner = {"opt": mjx.Option, "stat": mjx.Statistic}[field.name]
            yield from (f"{field.name}.{part.name}" for part in dataclasses.fields(inner) if hasattr(kind, part.name))
        elif hasattr(mujoco.MjModel, field.name) and field.name not in ("names", "signature"):
            yield field.name


def _value(model: mujoco.MjModel, name: str) -> Any:
    for part in name.split("."):
        model = getattr(model, part)
    return model
