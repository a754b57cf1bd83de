"""Reads and compiles MuJoCo models, and finds their features that MJX ignores."""

from __future__ import annotations

import contextlib
import copy
import hashlib
import io
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from envs.physics.features import CONTACT_FIELDS, SENSOR_FIELDS
from envs.physics.missing import leave_out_missing_files

if TYPE_CHECKING:
    import mujoco


# Fields of mjModel that MJX 3.17 never reads: the feature is not simulated, although one of its values is not 0.
IGNORED_FIELDS = {
    "jnt_stiffnesspoly": "higher stiffness coefficients of joints",
    "dof_dampingpoly": "higher damping coefficients of joints",
    "tendon_stiffnesspoly": "higher stiffness coefficients of tendons",
    "tendon_dampingpoly": "higher damping coefficients of tendons",
    "actuator_delay": "delay of actuators",
    "actuator_damping": "damping of actuators",
    "actuator_dampingpoly": "higher damping coefficients of actuators",
    "actuator_armature": "armature of actuators",
    **CONTACT_FIELDS,
    **SENSOR_FIELDS,
}
# Sensors of forces and accelerations, which MJX leaves at 0 in a model without constraints.
ACCELERATION_SENSORS = ("ACCELEROMETER", "FORCE", "TORQUE", "FRAMELINACC", "FRAMEANGACC")


class MujocoModelError(ValueError):
    """A model file that MuJoCo cannot read or compile, or that MJX cannot step."""


def load_spec(path: str | Path) -> mujoco.MjSpec:
    """The editable specification in an MJCF file, without the meshes whose files are missing.

    One logged line says what was left out with the missing files (`missing.leave_out_missing_files`).

    Raises:
      MujocoModelError: the file is missing or is not MJCF; the message has the path and MuJoCo's message with the line.
        Or a moving body has no inertia without a missing mesh.
    """
    mujoco = import_mujoco()
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        leave_out_missing_files(spec)
        return spec
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


def find_control_ranges(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """(lowest, highest) control of each actuator, `[nu]`; -1 and 1 for one without limits."""
    is_limited = model.actuator_ctrllimited.astype(bool)[:, None]
    low, high = np.where(is_limited, model.actuator_ctrlrange, [-1.0, 1.0]).T
    return low, high


def put_model(model: mujoco.MjModel):
    """The MJX model from which `envs.physics.dynamics` takes its numbers: for motion without constraints.

    What MJX looks at before it knows whether it needs it is taken from a copy of the model: shapes and collision (all
    geoms become spheres that touch nothing), the cone, the solver, the integrator, flags, and the types of actuators,
    equalities and sensors that it does not have. All numbers are those of the model. So types and flags are to be read
    from the model itself, and `mjx.step` of this model is not its step.

    Raises:
      MujocoModelError: MJX refuses the model for something else, such as flexible bodies; the message has it.
    """
    import mujoco

    prepared = copy.copy(model)
    prepared.geom_type[:] = mujoco.mjtGeom.mjGEOM_SPHERE
    prepared.geom_contype[:] = prepared.geom_conaffinity[:] = 0
    for field, kind, types in _list_types():
        values = getattr(prepared, field)
        values[~np.isin(values, [int(each) for each in types])] = int(kind)
    option, disable = prepared.opt, mujoco.mjtDisableBit
    option.disableflags |= int(disable.mjDSBL_CONSTRAINT | disable.mjDSBL_CONTACT)
    option.enableflags = 0
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE  # of which the mass matrix takes its form in MJX
    option.noslip_iterations = 0
    return _put_in_mjx(prepared)


def _list_types():
    """Fields of types that MJX looks at, with the type that stands for those that it lacks, and those it has."""
    import mujoco

    mjx = import_mjx()
    yield "actuator_trntype", mujoco.mjtTrn.mjTRN_JOINT, mjx.TrnType
    yield "actuator_dyntype", mujoco.mjtDyn.mjDYN_NONE, mjx.DynType
    yield "actuator_gaintype", mujoco.mjtGain.mjGAIN_FIXED, mjx.GainType
    yield "actuator_biastype", mujoco.mjtBias.mjBIAS_NONE, mjx.BiasType
    yield "eq_type", mujoco.mjtEq.mjEQ_CONNECT, mjx.EqType
    sensors = set(mjx.SensorType) - {mjx.SensorType.CONTACT}  # which MJX refuses by what they match
    yield "sensor_type", mujoco.mjtSensor.mjSENS_CLOCK, sensors


def put_whole_model(model: mujoco.MjModel):
    """The model in MJX as it is, for `mjx.step`; raises MujocoModelError with the feature that MJX does not support."""
    import mujoco

    if not model.nmat and mujoco.mjtSensor.mjSENS_RANGEFINDER in model.sensor_type:
        raise MujocoModelError(
            f"{model_name(model)}: MJX cannot step it: rangefinder sensors in a model without a material; add "
            '<asset><material name="any"/></asset>'
        )
    return _put_in_mjx(model)


def _put_in_mjx(model: mujoco.MjModel):
    try:
        return import_mjx().put_model(model)
    except (NotImplementedError, ValueError, TypeError) as error:
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
    return bool(mjx.make_data(put_whole_model(model))._impl.efc_J.size)
