"""Sensors are C MuJoCo's to 1e-12 in float64, in models without constraints too."""

import dynamics
import jax
import mujoco
import numpy as np
import pytest
from dynamics import BODIES, TENDONS, compile_unconstrained, draw_state, make_function, write_mjcf

from envs.physics.interpreter import trace

ACTUATORS = """<actuator><motor name="m" joint="j1" gear="3"/><position joint="j1" kp="3"/><motor tendon="t1"/>
<motor tendon="t2"/></actuator>"""
LISTED = """
accelerometer site="s3" | velocimeter site="s3" | gyro site="s3" | gyro site="w" | accelerometer site="s6"
force site="s2" | torque site="s2" | force site="s4" | torque site="s3" | force site="s6" | torque site="s6"
magnetometer site="s3" | clock | e_potential | e_kinetic | camprojection site="s3" camera="cam"
jointpos joint="j1" | jointvel joint="j3" | jointactuatorfrc joint="j1" | ballquat joint="j4" | ballangvel joint="j4"
tendonpos tendon="t2" | tendonvel tendon="t2" | tendonactuatorfrc tendon="t1"
actuatorpos actuator="m" | actuatorvel actuator="m" | actuatorfrc actuator="m" | actuatorfrc actuator="m" cutoff=".5"
framepos objtype="site" objname="s3" cutoff=".2" | framepos objtype="body" objname="c" reftype="site" refname="s5"
framequat objtype="geom" objname="g" reftype="body" refname="f" | framequat objtype="body" objname="c"
framequat objtype="xbody" objname="c" | framequat objtype="camera" objname="cam" | framequat objtype="site" objname="s6"
framexaxis objtype="site" objname="s3" reftype="xbody" refname="e" | framezaxis objtype="camera" objname="cam"
frameyaxis objtype="geom" objname="g" | framelinvel objtype="site" objname="s3" reftype="body" refname="e"
frameangvel objtype="site" objname="s3" reftype="body" refname="e" | framelinvel objtype="camera" objname="cam"
frameangvel objtype="geom" objname="g" | framelinacc objtype="geom" objname="g"
framelinacc objtype="xbody" objname="c" | clock
frameangacc objtype="body" objname="c" | subtreecom body="b" | subtreelinvel body="b" | subtreeangmom body="b"
subtreeangmom body="a" | accelerometer site="w" | accelerometer site="s7" | framelinacc objtype="body" objname="still"
force site="s7" | torque site="s7" | subtreelinvel body="still" | subtreeangmom body="still"
user dim="2" needstage="vel"
"""
STILL = """<body name="still" pos="0 0 3"><geom size=".1" pos=".1 0 0"/><site name="s7" pos=".1 .2 0"/>
<body pos="0 0 -.5"><joint axis="0 1 0"/><geom size=".1" pos="0 .1 -.2"/></body></body>"""
NAMES = [sensor.strip() for line in LISTED.strip().splitlines() for sensor in line.split("|")]
SENSORS = "<sensor>" + "".join(f"<{sensor}/>" for sensor in NAMES) + "</sensor>"
TEXT = write_mjcf(STILL + BODIES, TENDONS + ACTUATORS + SENSORS)


@pytest.fixture(scope="module")
def values():
    """Ours and C MuJoCo's values of all sensors on random states, [states, nsensordata] each, and the model."""
    model = compile_unconstrained(TEXT)
    rng = np.random.default_rng(0)
    batch = [draw_state(model, rng) for _ in range(20)]
    arguments = [np.stack([np.array(getattr(d, field)) for d in batch]) for field in ("qpos", "qvel", "act", "ctrl")]
    with jax.enable_x64(True):
        function = make_function(model, ("sensordata",), "forward")
        program = trace(lambda *args: function(*args)["sensordata"], *(x[0] for x in arguments))
    (ours,) = dynamics.evaluate(program, arguments)
    for d in batch:
        mujoco.mj_forward(model, d)
    return ours, np.stack([d.sensordata for d in batch]), model


@pytest.mark.parametrize("number", range(len(NAMES)), ids=NAMES)
def test_sensor(number, values):
    """The sensor's values, relative to the largest."""
    ours, true, model = values
    here = slice(model.sensor_adr[number], model.sensor_adr[number] + model.sensor_dim[number])
    size = np.maximum(1.0, np.abs(true[:, here]).max())
    np.testing.assert_allclose(ours[:, here] / size, true[:, here] / size, rtol=0, atol=1e-12)


def test_kinetic_energy_is_that_of_the_bodies(values):
    """sum (m |v|^2 + omega I omega) / 2, without armature."""
    ours, _, model = values
    rng = np.random.default_rng(0)
    model.dof_armature[:] = model.tendon_armature[:] = 0
    d = draw_state(model, rng)
    mujoco.mj_forward(model, d)
    energy, velocity = 0.0, np.zeros(6)
    for body in range(1, model.nbody):
        mujoco.mj_objectVelocity(model, d, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 1)
        energy += 0.5 * (model.body_mass[body] * velocity[3:] @ velocity[3:])
        energy += 0.5 * velocity[:3] @ (model.body_inertia[body] * velocity[:3])
    with jax.enable_x64(True):
        function = make_function(model, ("sensordata",), "forward")
        arguments = [np.array(getattr(d, field)) for field in ("qpos", "qvel", "act", "ctrl")]
        (ours,) = dynamics.compute(lambda *args: function(*args)["sensordata"], *arguments)
    address = model.sensor_adr[NAMES.index("e_kinetic")]
    np.testing.assert_allclose(ours[address], energy, rtol=1e-12)
