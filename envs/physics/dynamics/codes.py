"""MuJoCo's enumerations as plain integers: its own members do not equal NumPy's integers from the right."""

from __future__ import annotations

from types import SimpleNamespace

import mujoco


def _list_codes(enum, prefix: str) -> SimpleNamespace:
    return SimpleNamespace(**{name.removeprefix(prefix): int(code) for name, code in enum.__members__.items()})


BIAS = _list_codes(mujoco.mjtBias, "mjBIAS_")
DATA = _list_codes(mujoco.mjtDataType, "mjDATATYPE_")
DISABLED = _list_codes(mujoco.mjtDisableBit, "mjDSBL_")
DYNAMICS = _list_codes(mujoco.mjtDyn, "mjDYN_")
GAIN = _list_codes(mujoco.mjtGain, "mjGAIN_")
INTEGRATOR = _list_codes(mujoco.mjtIntegrator, "mjINT_")
JOINT = _list_codes(mujoco.mjtJoint, "mjJNT_")
OBJECT = _list_codes(mujoco.mjtObj, "mjOBJ_")
SENSOR = _list_codes(mujoco.mjtSensor, "mjSENS_")
TRANSMISSION = _list_codes(mujoco.mjtTrn, "mjTRN_")
WRAP = _list_codes(mujoco.mjtWrap, "mjWRAP_")
