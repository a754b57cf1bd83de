"""Reads and compiles MuJoCo models, and finds their features that MJX ignores."""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import mujoco


# Fields of mjModel that MJX 3.17 never reads: the feature is not simulated, although one of its values is not 0.
IGNORED_FIELDS = {
    "geom_surfacevel": "surface velocity of geoms",
    "geom_adhesion": "adhesion of geoms",
    "geom_gap": "gap of geoms",
    "pair_adhesion": "adhesion of contact pairs",
    "pair_gap": "gap of contact pairs",
    "jnt_stiffnesspoly": "higher stiffness coefficients of joints",
    "dof_dampingpoly": "higher damping coefficients of joints",
    "tendon_stiffnesspoly": "higher stiffness coefficients of tendons",
    "tendon_dampingpoly": "higher damping coefficients of tendons",
    "actuator_delay": "delay of actuators",
    "actuator_damping": "damping of actuators",
    "actuator_armature": "armature of actuators",
    "sensor_delay": "delay of sensors",
    "sensor_interval": "sampling interval of sensors",
}
# Sensors of forces and accelerations, which MJX leaves at 0 in a model without constraints.
ACCELERATION_SENSORS = ("ACCELEROMETER", "FORCE", "TORQUE", "FRAMELINACC", "FRAMEANGACC")


class MujocoModelError(ValueError):
    """A model file that MuJoCo cannot read or compile, or that MJX cannot step."""


def load_spec(path: str | Path) -> mujoco.MjSpec:
    """The editable specification in an MJCF file.

    Raises:
      MujocoModelError: the file is missing or is not MJCF; the message has the path and MuJoCo's message with the line.
    """
    mujoco = import_mujoco()
    try:
        return mujoco.MjSpec.from_file(str(path))
    except (ValueError, OSError) as error:
        raise MujocoModelError(f"{path}: {' '.join(str(error).split())}") from error


def import_mujoco():
    """Imports `mujoco`; raises MujocoModelError if that fails because of the value of MUJOCO_GL."""
    try:
        import mujoco
    except (ImportError, RuntimeError, AttributeError) as error:  # the last if an OpenGL library is missing
        value = os.environ.get("MUJOCO_GL")
        if value is None:
            raise
        raise MujocoModelError(f"MUJOCO_GL={value}: MuJoCo cannot be imported with it ({error}); unset it") from error
    return mujoco


def compile_model(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compiles a specification; raises MujocoModelError with MuJoCo's message if it cannot be compiled."""
    try:
        return spec.compile()
    except ValueError as error:
        raise MujocoModelError(f"{spec.modelname}: {' '.join(str(error).split())}") from error


def model_name(model: mujoco.MjModel) -> str:
    """The name in the MJCF, which is the first of MuJoCo's zero-terminated names."""
    return model.names.split(b"\0", 1)[0].decode() or "MuJoCo model"


def model_digest(model: mujoco.MjModel) -> bytes:
    """A digest of the whole content of a compiled model."""
    import mujoco

    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    return hashlib.sha256(content.data).digest()


def put_model(model: mujoco.MjModel):
    """The MJX model; raises MujocoModelError with the name of the feature that MJX does not support."""
    import mujoco

    if not model.nmat and mujoco.mjtSensor.mjSENS_RANGEFINDER in model.sensor_type:
        raise MujocoModelError(
            f"{model_name(model)}: MJX cannot step it: rangefinder sensors in a model without a material; add "
            '<asset><material name="any"/></asset>'
        )
    try:
        return import_mjx().put_model(model)
    except (NotImplementedError, ValueError) as error:
        raise MujocoModelError(f"{model_name(model)}: MJX cannot step it: {error}") from error


def import_mjx():
    """Imports `mujoco.mjx`, without the two lines that it prints about Warp, its optional GPU backend.

    The import takes seconds, so it is done only when needed and not for `--help`.
    """
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx


def ignored_features(model: mujoco.MjModel) -> list[str]:
    """The features of a model that MJX silently ignores, one phrase each; empty if there are none."""
    import mujoco

    features = [meaning for field, meaning in IGNORED_FIELDS.items() if np.any(getattr(model, field, 0))]
    if model.opt.noslip_iterations:
        features.append("noslip iterations of the solver")
    if model.opt.disableactuator:
        features.append("disabled groups of actuators")
    if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        features.append("sleeping islands")
    sensors = {mujoco.mjtSensor(int(kind)).name.removeprefix("mjSENS_") for kind in model.sensor_type}
    sensors &= set(ACCELERATION_SENSORS)
    if sensors and not _has_constraints(model):
        names = ", ".join(sorted(sensors)).lower()
        features.append(f"sensors of accelerations and forces without a constraint ({names})")
    return features


def _has_constraints(model: mujoco.MjModel) -> bool:
    """Whether MJX makes constraint rows: equalities, friction loss, limits or possible contacts."""
    mjx = import_mjx()
    return bool(mjx.make_data(put_model(model))._impl.efc_J.size)
