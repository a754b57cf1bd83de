"""One control step of a MuJoCo model by MJX.

Everything that the rest of the package knows of the physics is a function `(qpos, qvel, ctrl) -> (qpos, qvel)` of one
environment; batches are made by `jax.vmap` of it.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import jax

if TYPE_CHECKING:
    import mujoco

# qpos [nq], qvel [nv], ctrl [nu] -> qpos [nq], qvel [nv]
StepFn = Callable[[jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array]]


class MujocoModelError(ValueError):
    """A model file that MuJoCo cannot read or compile."""


def load_spec(path: str | Path) -> mujoco.MjSpec:
    """The editable specification in an MJCF file.

    Raises:
      MujocoModelError: the file is missing or is not MJCF; MuJoCo's own message, which has the line, after the path.
    """
    import mujoco

    try:
        return mujoco.MjSpec.from_file(str(path))
    except (ValueError, OSError) as error:
        raise MujocoModelError(f"{path}: {' '.join(str(error).split())}") from error


def compile_model(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """The compiled model of a specification; raises MujocoModelError with MuJoCo's message where it has none."""
    try:
        return spec.compile()
    except ValueError as error:
        raise MujocoModelError(f"{spec.modelname}: {' '.join(str(error).split())}") from error


def mjx_step(model: mujoco.MjModel, num_substeps: int) -> StepFn:
    """`num_substeps` times `mjx.step` with the control held, from and to (qpos, qvel) alone.

    Args:
      model: a compiled model without activation states (`na == 0`): qpos and qvel are then its whole state.
      num_substeps: physics steps of `model.opt.timestep` seconds in one control step.

    Returns:
      A function of qpos `[nq]`, qvel `[nv]` (SI units) and ctrl `[nu]` (the actuators' units) of one environment.

    Raises:
      ValueError: the model has activation states.
    """
    if model.na:
        raise ValueError(f"the model has {model.na} actuator activation states, which (qpos, qvel) does not carry")
    mjx = _import_mjx()
    mjx_model = mjx.put_model(model)
    initial = mjx.make_data(mjx_model)

    def substep(state, ctrl):
        qpos, qvel = state
        data = mjx.step(mjx_model, initial.replace(qpos=qpos, qvel=qvel, ctrl=ctrl))
        return data.qpos, data.qvel

    def step(qpos, qvel, ctrl):
        if num_substeps == 1:
            return substep((qpos, qvel), ctrl)
        state, _ = jax.lax.scan(lambda state, _: (substep(state, ctrl), None), (qpos, qvel), length=num_substeps)
        return state

    return step


def _import_mjx():
    """`mujoco.mjx`, imported where it is first needed and without its two printed lines about Warp.

    The import takes seconds, which nobody should pay who only asks for `--help`; Warp is its optional GPU backend.
    """
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx
