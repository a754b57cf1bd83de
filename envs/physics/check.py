"""Checks whether MJX simulates a model as C MuJoCo does."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from envs.physics.callback import INITIAL_COUNT, has_diverged
from envs.physics.models import compile_model, ignored_features, load_spec, model_digest, model_name
from envs.physics.step import compile_step

if TYPE_CHECKING:
    import mujoco

logger = logging.getLogger(__name__)

_checked: set[bytes] = set()  # digests of the models that `check_once` has seen


def load_model(path: str | Path) -> mujoco.MjModel:
    """The compiled model in an MJCF file, checked by `check_once`.

    Raises:
      MujocoModelError: the file is missing or is not MJCF, or MJX cannot step the model.
    """
    model = compile_model(load_spec(path))
    check_once(model)
    return model


def check_once(model: mujoco.MjModel) -> None:
    """Logs the problems from `check_model` as warnings, once for each model in this process."""
    digest = model_digest(model)
    if digest not in _checked:
        _checked.add(digest)
        for line in check_model(model):
            logger.warning("%s: %s", model_name(model), line)


def check_model(model: mujoco.MjModel, num_steps: int = 50, tolerance: float = 1e-3) -> list[str]:
    """Problems of stepping a model by MJX, one line each; empty if there are none.

    Lists the features that MJX silently ignores, then takes `num_steps` steps by `compile_step` and by C
    MuJoCo from the initial state under the same random controls, and compares positions and velocities.

    Args:
      model: a compiled model.
      num_steps: steps to compare. Rounding limits the comparison, with contacts to some ten steps and in chaotic motion
        to some hundred.
      tolerance: allowed difference, relative to the largest position or velocity (at least 1).

    Raises:
      MujocoModelError: MJX cannot step the model.
    """
    import mujoco

    lines = [f"MJX leaves out: {feature}" for feature in ignored_features(model)]
    state = ("qpos", "qvel", "act", "qacc_warmstart") if model.na else ("qpos", "qvel", "qacc_warmstart")
    step = jax.jit(compile_step(model, inputs=(*state, "ctrl"), outputs=state))
    data = mujoco.MjData(model)
    data.warning.number[:] = INITIAL_COUNT
    random = np.random.default_rng(0)
    limit = np.where(model.actuator_ctrllimited, model.actuator_ctrlrange[:, 1], 1.0)
    ours = [jnp.asarray(getattr(data, name)) for name in state]
    for number in range(1, num_steps + 1):
        data.ctrl[:] = limit * random.uniform(-1, 1, model.nu)
        ours = step(*ours, jnp.asarray(data.ctrl))
        mujoco.mj_step(model, data)
        if has_diverged(data.warning.number):
            return [*lines, f"C MuJoCo's own motion diverges in step {number}: the timestep is too long for it"]
        for name, mine in zip(state[:2], ours, strict=False):
            true = getattr(data, name)
            error = np.max(np.abs(mine - true), initial=0.0) / max(1.0, np.max(np.abs(true), initial=0.0))
            if not error <= tolerance:
                return [*lines, f"{name} differs from C MuJoCo's by {error:.1g} of its size after {number} steps"]
    return lines
