"""MJX's data with the fields that C MuJoCo has besides."""

# without `from __future__ import annotations`: MJX decides by a field's type, not by its name, whether it is an array

import dataclasses
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import mujoco

from envs.physics.fields import ADDED, find_types
from envs.physics.models import import_mjx

if TYPE_CHECKING:
    from mujoco import mjx
else:
    mjx = import_mjx()


class Data(mjx.Data):
    """`mjx.Data` with the fields of `fields.ADDED`.

    Attributes:
      energy: potential and kinetic, J, `[2]`.
      cfrc_ext: torque about the centre of mass of its tree and force, from outside, on each body, `[nbody, 6]`.
      site_jacp, site_jacr: velocity and angular velocity of each site per velocity, `[nsite, 3, nv]`.
      body_jacp, body_jacr: the same of each body's origin, `[nbody, 3, nv]`.
    """

    energy: jax.Array
    cfrc_ext: jax.Array
    site_jacp: jax.Array
    site_jacr: jax.Array
    body_jacp: jax.Array
    body_jacr: jax.Array


def extend(model: mujoco.MjModel, d: "mjx.Data") -> Data:
    """The data with the other fields, which are 0."""
    added = {name: jnp.zeros(x.shape, x.dtype) for name, x in zip(ADDED, find_types(model, ADDED), strict=True)}
    return Data(**{field.name: getattr(d, field.name) for field in dataclasses.fields(d)}, **added)
