"""The features of models that `envs.physics.dynamics` does not compute."""

from __future__ import annotations

import mujoco
import numpy as np

from envs.physics.dynamics.codes import BIAS, DYNAMICS, GAIN, INTEGRATOR, SENSOR, TRANSMISSION
from envs.physics.features import wraps_around_geoms

ACTUATORS = {
    "adhesion actuators": ("trntype", (TRANSMISSION.BODY,)),
    "actuators of rotations (so3)": ("trntype", (TRANSMISSION.SO3,)),
    "DC motors": ("gaintype", (GAIN.DCMOTOR,)),
    "PID actuators": ("gaintype", (GAIN.PID,)),
    "user-defined actuators": ("gaintype", (GAIN.USER,)),
    "user-defined biases of actuators": ("biastype", (BIAS.USER, BIAS.DCMOTOR, BIAS.SO3)),
    "user-defined dynamics of actuators": ("dyntype", (DYNAMICS.USER, DYNAMICS.PID, DYNAMICS.DCMOTOR)),
}
SENSORS = ("RANGEFINDER", "INSIDESITE", "GEOMDIST", "GEOMNORMAL", "GEOMFROMTO", "TACTILE", "PLUGIN")


def list_unsupported(model: mujoco.MjModel) -> list[str]:
    """The features of a model that are not computed, one phrase each; constraints and contacts are not looked at."""
    checks = {
        "no joints": not model.nv,
        "the discrete integrator": model.opt.integrator == INTEGRATOR.DISCRETE,
        "sleeping islands": model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP,
        "flexible bodies": model.nflex,
        "plugins": model.nplugin,
        "delays of actuators": np.any(model.actuator_delay),
        "delays and intervals of sensors": np.any(model.sensor_delay) or np.any(model.sensor_interval),
        "actuators with several inputs": model.nu != len(model.actuator_trntype),
        "ellipsoids in a fluid": (model.opt.density or model.opt.viscosity) and np.any(model.geom_fluid[:, :1] > 0),
        "armature of tendons around geoms": wraps_around_geoms(model) and np.any(model.tendon_armature),
        "force sensors with tendons around geoms": wraps_around_geoms(model)
        and np.isin(model.sensor_type, (SENSOR.FORCE, SENSOR.TORQUE)).any(),
    }
    found = [feature for feature, here in checks.items() if here]
    for feature, (field, codes) in ACTUATORS.items():
        if np.isin(getattr(model, f"actuator_{field}"), codes).any():
            found.append(feature)
    sensors = [name.lower() for name in SENSORS if getattr(SENSOR, name) in model.sensor_type]
    return found + ([f"sensors: {', '.join(sensors)}"] if sensors else [])
