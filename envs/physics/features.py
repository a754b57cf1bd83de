"""Features of a model that scalar equations do not simulate: with one of them the model is stepped by C MuJoCo."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING

import numpy as np

from envs.physics.pairs import colliding_pairs, get_shapes

if TYPE_CHECKING:
    import mujoco

# Fields of mjModel with a feature that is not simulated, if one of their values is not 0, and what it is called. First
# those of joints, tendons and actuators,
JOINT_FIELDS = {
    "jnt_stiffnesspoly": "higher stiffness coefficients of joints",
    "dof_dampingpoly": "higher damping coefficients of joints",
    "tendon_stiffnesspoly": "higher stiffness coefficients of tendons",
    "tendon_dampingpoly": "higher damping coefficients of tendons",
    "actuator_delay": "delay of actuators",
    "actuator_damping": "damping of actuators",
    "actuator_armature": "armature of actuators",
}
OTHER_FIELDS = {
    "nflex": "flexible bodies (<flex>)",
    "nplugin": "plugins",
    "actuator_dampingpoly": "higher damping coefficients of actuators",
}
# those of sensors, which matter only where `sensordata` is an output,
SENSOR_FIELDS = {"sensor_delay": "delay of sensors", "sensor_interval": "sampling interval of sensors"}
SENSORS = ("TOUCH", "CONTACT", "RANGEFINDER", "INSIDESITE", "GEOMDIST", "GEOMNORMAL", "GEOMFROMTO", "TACTILE", "PLUGIN")
SENSORS += tuple(f"{kind}LIMIT{what}" for kind in ("JOINT", "TENDON") for what in ("POS", "VEL", "FRC"))
FORCE_SENSORS = ("FORCE", "TORQUE")  # which leave out contacts, points that are held, and tendons around geoms
# and those of contacts.
CONTACT_FIELDS = {
    "geom_surfacevel": "surface velocity of geoms",
    "geom_adhesion": "adhesion of geoms",
    "geom_gap": "gap of geoms",
    "pair_adhesion": "adhesion of contact pairs",
    "pair_gap": "gap of contact pairs",
}
# Fields of types of actuators, with MuJoCo's enumeration and the simulated values.
ACTUATOR_TYPES = {
    "actuator_trntype": ("mjtTrn", "transmission", ("JOINT", "JOINTINPARENT", "TENDON", "SITE")),
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

    fields = OTHER_FIELDS | JOINT_FIELDS | (SENSOR_FIELDS if "sensordata" in outputs else {})
    features = _list_fields(model, fields)
    for field, (kind, name, supported) in ACTUATOR_TYPES.items():
        found = {getattr(mujoco, kind)(int(x)).name.split("_", 1)[1] for x in getattr(model, field)} - set(supported)
        features += [f"actuators with the {name} type {', '.join(sorted(found)).lower()}"] if found else []
    return [*features, *_list_options(model), *(_list_sensors(model) if "sensordata" in outputs else [])]


def _list_sensors(model: mujoco.MjModel) -> list[str]:
    """One phrase about the sensors that are not simulated; those of forces, if more acts on bodies than they know."""
    import mujoco

    rigid = int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)
    is_held = np.isin(model.eq_type, rigid).any() or colliding_pairs(model) or wraps_around_geoms(model)
    names = (mujoco.mjtSensor(int(kind)).name.removeprefix("mjSENS_") for kind in model.sensor_type)
    found = sorted({name.lower() for name in names if name in SENSORS or (is_held and name in FORCE_SENSORS)})
    return [f"sensors of type {', '.join(found)}"] if found else []


def _list_fields(model: mujoco.MjModel, fields: dict[str, str]) -> list[str]:
    return [meaning for field, meaning in fields.items() if np.any(getattr(model, field, 0))]


def _list_options(model: mujoco.MjModel) -> Iterator[str]:
    import mujoco

    option = model.opt
    if option.integrator == int(mujoco.mjtIntegrator.mjINT_DISCRETE):
        yield 'the integrator "discrete"'
    if option.enableflags & int(mujoco.mjtEnableBit.mjENBL_SLEEP):
        yield "sleeping islands"
    if any(0 <= group < 31 and option.disableactuator >> group & 1 for group in model.actuator_group.tolist()):
        yield "disabled groups of actuators"
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
        "the flag override": option.enableflags & int(flags.mjENBL_OVERRIDE) and pairs,
        f"equality constraints of type {', '.join(sorted(kinds)).lower()}": kinds,
        **{f"contacts of {name}": shape in shapes for shape, name in UNSUPPORTED_SHAPES.items()},
    }
    features = [feature for feature, here in checks.items() if here]
    return (_list_fields(model, CONTACT_FIELDS) if pairs else []) + features
