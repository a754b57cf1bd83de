"""Features of a model that scalar equations do not simulate: with one of them the model is stepped by C MuJoCo."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING

import numpy as np

from envs.physics.pairs import SHAPES, colliding_pairs, get_shapes

if TYPE_CHECKING:
    import mujoco

# Fields of mjModel with a feature that is not simulated, if one of their values is not 0, and what it is called. First
# those of bodies and actuators,
FIELDS = {"nflex": "flexible bodies (<flex>)", "nplugin": "plugins", "actuator_delay": "delay of actuators"}
# those of sensors, which matter only where `sensordata` is an output,
SENSOR_FIELDS = {"sensor_delay": "delay of sensors", "sensor_interval": "sampling interval of sensors"}
SENSORS = ("GEOMDIST", "GEOMNORMAL", "GEOMFROMTO", "TACTILE", "PLUGIN")
FORCE_SENSORS = ("FORCE", "TORQUE")  # which leave out tendons around geoms
CONTACT_SIZES = (1, 3, 3, 1, 3, 3, 3)  # numbers of the values of a contact, as mjtConDataField
# and those of contacts.
CONTACT_FIELDS = {
    "geom_surfacevel": "surface velocity of geoms",
    "geom_adhesion": "adhesion of geoms",
    "pair_adhesion": "adhesion of contact pairs",
}
# Fields of types of actuators, with MuJoCo's enumeration and the simulated values.
ACTUATOR_TYPES = {
    "actuator_trntype": ("mjtTrn", "transmission", ("JOINT", "JOINTINPARENT", "TENDON", "SITE", "SLIDERCRANK")),
    "actuator_dyntype": ("mjtDyn", "dynamics", ("NONE", "INTEGRATOR", "FILTER", "FILTEREXACT", "MUSCLE")),
    "actuator_gaintype": ("mjtGain", "gain", ("FIXED", "AFFINE", "MUSCLE")),
    "actuator_biastype": ("mjtBias", "bias", ("NONE", "AFFINE", "MUSCLE")),
}
EQUALITIES = ("CONNECT", "WELD", "JOINT", "TENDON")
# Shapes whose contacts need the data of a file, or the shape of a function.
UNSUPPORTED_SHAPES = {"hfield": "height fields", "sdf": "signed distance fields"}


def unsupported_features(model: mujoco.MjModel, outputs: Collection[str] = ("qpos", "qvel")) -> list[str]:
    """The features of a model that only C MuJoCo simulates, one phrase each; empty if there are none.

    Args:
      model: a compiled model.
      outputs: the fields of `mjx.Data` that are wanted; features of sensors count only with `sensordata`.
    """
    return [*list_smooth_features(model, outputs), *list_constraint_features(model)]


def list_smooth_features(model: mujoco.MjModel, outputs: Collection[str]) -> list[str]:
    """Those of the motion without constraints, and of sensors."""
    import mujoco

    sensors = find_sensors(model, outputs)
    fields = FIELDS | (SENSOR_FIELDS if sensors.size else {})
    features = _list_fields(model, fields)
    for field, (kind, name, supported) in ACTUATOR_TYPES.items():
        found = {getattr(mujoco, kind)(int(x)).name.split("_", 1)[1] for x in getattr(model, field)} - set(supported)
        features += [f"actuators with the {name} type {', '.join(sorted(found)).lower()}"] if found else []
    pulls = any(name.split("[")[0] == "cfrc_ext" for name in outputs) and wraps_around_geoms(model)
    features += ["cfrc_ext with tendons around geoms"] if pulls else []
    return [*features, *_list_options(model), *_list_sensors(model, sensors)]


def find_sensors(model: mujoco.MjModel, outputs: Collection[str]) -> np.ndarray:
    """The numbers of the sensors whose values are among the outputs, as "sensordata" or "sensordata[name]"."""
    import mujoco

    names = [name[len("sensordata[") : -1] for name in outputs if name.startswith("sensordata[")]
    if "sensordata" in outputs:
        return np.arange(model.nsensor)
    return np.array([mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, name) for name in names], int)


def _list_sensors(model: mujoco.MjModel, sensors: np.ndarray) -> list[str]:
    """One phrase about those of these sensors that are not simulated."""
    import mujoco

    names = {int(i): mujoco.mjtSensor(int(model.sensor_type[i])).name.removeprefix("mjSENS_") for i in sensors}
    found = sorted({name.lower() for i, name in names.items() if _is_unread(model, i, name)})
    return [f"sensors of type {', '.join(found)}"] if found else []


def _is_unread(model: mujoco.MjModel, sensor: int, name: str) -> bool:
    """Whether a sensor of this type needs C MuJoCo."""
    if name in FORCE_SENSORS:
        return wraps_around_geoms(model)
    if name == "RANGEFINDER":
        return _sees_too_much(model, sensor)
    return name in SENSORS or (name == "CONTACT" and not _is_ordered(model, sensor))


def _sees_too_much(model: mujoco.MjModel, sensor: int) -> bool:
    """Whether a rangefinder sees shapes that are not simple, or has more values than the distance."""
    import mujoco

    is_plain = model.sensor_objtype[sensor] == mujoco.mjtObj.mjOBJ_SITE and model.sensor_dim[sensor] == 1
    is_distance = model.sensor_intprm[sensor, 0] == 1 << int(mujoco.mjtRayDataField.mjRAYDATA_DIST)
    complex_shapes = [SHAPES.index(name) for name in ("hfield", "mesh", "sdf")]
    return not (is_plain and is_distance) or bool(np.isin(model.geom_type, complex_shapes).any())


def _is_ordered(model: mujoco.MjModel, sensor: int) -> bool:
    """Whether the values of a contact sensor do not depend on the order in which C MuJoCo finds contacts."""
    data, reduce = model.sensor_intprm[sensor, :2]
    if model.geom_gap.any() or model.pair_gap.any():
        return False  # contacts that are found and do not act
    slots = sum(size for place, size in enumerate(CONTACT_SIZES) if data >> place & 1)
    if data >> len(CONTACT_SIZES):
        return False
    return data == 1 or reduce == 3 or (reduce in (1, 2) and model.sensor_dim[sensor] == slots)


def _list_fields(model: mujoco.MjModel, fields: dict[str, str]) -> list[str]:
    return [meaning for field, meaning in fields.items() if np.any(getattr(model, field, 0))]


def _list_options(model: mujoco.MjModel) -> Iterator[str]:
    import mujoco

    option = model.opt
    if option.integrator == int(mujoco.mjtIntegrator.mjINT_DISCRETE):
        yield 'the integrator "discrete"'
    if option.enableflags & int(mujoco.mjtEnableBit.mjENBL_SLEEP):
        yield "sleeping islands"
    if wraps_around_geoms(model) and model.tendon_armature.any():
        yield "armature of tendons around geoms"
    if model.nu != len(model.actuator_trntype):
        yield "actuators with several inputs"
    has_fluid = option.density > 0 or option.viscosity > 0
    if has_fluid and model.geom_fluid.reshape(-1, mujoco.mjNFLUID)[:, 0].any():
        yield "fluid forces on ellipsoids"


def wraps_around_geoms(model: mujoco.MjModel) -> bool:
    """Whether a tendon goes around a sphere or a cylinder."""
    import mujoco

    around = int(mujoco.mjtWrap.mjWRAP_SPHERE), int(mujoco.mjtWrap.mjWRAP_CYLINDER)
    return bool(np.isin(model.wrap_type, around).any())


def list_constraint_features(model: mujoco.MjModel) -> list[str]:
    """Those of contacts, equalities and the constraints' solver."""
    import mujoco

    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT):
        return []
    option, flags, pairs = model.opt, mujoco.mjtEnableBit, colliding_pairs(model)
    has_friction = bool(pairs) or model.dof_frictionloss.any() or model.tendon_frictionloss.any()
    kinds = {mujoco.mjtEq(int(x)).name.removeprefix("mjEQ_") for x in model.eq_type} - set(EQUALITIES)
    shapes = {shape for pair in pairs for shape in get_shapes(model, pair)}
    checks = {
        "noslip iterations of the solver": option.noslip_iterations and has_friction,
        "the flag diagexact": option.enableflags & int(flags.mjENBL_DIAGEXACT),
        f"equality constraints of type {', '.join(sorted(kinds)).lower()}": kinds,
        **{f"contacts of {name}": shape in shapes for shape, name in UNSUPPORTED_SHAPES.items()},
    }
    features = [feature for feature, here in checks.items() if here]
    return (_list_fields(model, CONTACT_FIELDS) if pairs else []) + features
