"""How strongly constraints act: stiffness, damping and impedance from MuJoCo's `solref` and `solimp`.

Source: MuJoCo's documentation, chapter Modeling, section Solver parameters.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.dynamics.codes import DISABLED
from envs.physics.dynamics.forces import is_disabled
from envs.physics.dynamics.numbers import get_number

if TYPE_CHECKING:
    from mujoco import mjx

DEFAULT_SOLREF = np.array([0.02, 1.0])
MIN_IMPEDANCE, MAX_IMPEDANCE = mujoco.mjMINIMP, mujoco.mjMAXIMP


def find_impedance(
    model: mujoco.MjModel, mx: mjx.Model, solref: jax.Array, solimp: jax.Array, position: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """(k, b, d): stiffness and damping of the reference acceleration, -b v - k d x, and the impedance d in (0, 1).

    For solref = (time constant t, damping ratio z): b = 2 / (d_max t), k = 1 / (d_max t z)^2; for negative numbers
    (-stiffness, -damping): k = stiffness / d_max^2, b = damping / d_max. If only one number is positive, both are
    MuJoCo's defaults. The impedance rises from d_min to d_max as
    |position| rises from 0 to the width, along two powers that meet at the midpoint.

    Args:
      solref, solimp: MuJoCo's parameters, `[n, 2]` and `[n, 5]` (d_min, d_max, width, midpoint, power).
      position: distance from the constraint, `[n]`.
    """
    is_mixed = (solref[:, 0] > 0) != (solref[:, 1] > 0)
    first, second = jnp.where(is_mixed[:, None], DEFAULT_SOLREF, solref).T
    low, high, middle = (jnp.clip(solimp[:, i], MIN_IMPEDANCE, MAX_IMPEDANCE) for i in (0, 1, 3))
    width, power = jnp.maximum(solimp[:, 2], mujoco.mjMINVAL), jnp.maximum(solimp[:, 4], 1.0)
    time = (
        first if is_disabled(model, DISABLED.REFSAFE) else jnp.maximum(first, 2 * get_number(model, mx, "opt.timestep"))
    )
    is_standard = first > 0
    safe_time, ratio = jnp.where(is_standard, time, 1.0), jnp.where(is_standard, second, 1.0)
    stiffness = jnp.where(
        is_standard, 1 / jnp.maximum(mujoco.mjMINVAL, (high * safe_time * ratio) ** 2), -first / high**2
    )
    damping = jnp.where(is_standard, 2 / jnp.maximum(mujoco.mjMINVAL, high * safe_time), -second / high)
    x = jnp.minimum(jnp.abs(position) / width, 1.0)
    rising = x**power / middle ** (power - 1)
    settling = 1 - (1 - x) ** power / (1 - middle) ** (power - 1)
    shape = jnp.where(x <= middle, rising, settling)
    is_flat = (low == high) | (solimp[:, 2] <= mujoco.mjMINVAL)
    return stiffness, damping, jnp.where(is_flat, (low + high) / 2, low + shape * (high - low))


def find_regularization(impedance: jax.Array, weight: jax.Array) -> jax.Array:
    """R = 1 / D = w (1 - d) / d: at impedance d, the constraint does the share d of what would be needed."""
    return jnp.maximum(mujoco.mjMINVAL, weight * (1 - impedance) / impedance)
