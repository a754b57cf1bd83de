"""What constraints exert is C MuJoCo's in float64: sensors of limits and contacts, forces on bodies, rays."""

import jax
import mujoco
import numpy as np
import pytest
from constrained import converge

from envs.physics.dynamics.program import trace_fields
from envs.physics.numeric import evaluate

INPUTS = ("qpos", "qvel", "ctrl", "xfrc_applied")
LIMITED = """<mujoco><option timestep="0.005"/><default><geom contype="0"/></default>
<worldbody><site name="w" pos="0 0 1"/>
<body name="a" pos="0 0 1"><joint name="hinge" axis="0 1 0" range="-20 30" margin=".05"/>
  <geom type="capsule" size=".03" fromto="0 0 0 .4 0 0"/><site name="s1" pos=".2 0 .03"/>
  <body name="b" pos=".4 0 0"><joint name="slide" type="slide" axis="0 1 0" range="-.05 .05"/>
    <geom type="box" size=".05 .05 .05"/><site name="s2" pos="0 .05 .02" quat="1 .2 .3 .1"/>
    <body name="c" pos=".1 0 0"><joint name="ball" type="ball" range="0 40" frictionloss=".1"/>
      <geom type="box" size=".1 .02 .03" pos=".1 0 0"/><site name="s3" pos=".2 .01 0"/>
      <body name="e" pos=".2 0 0"><joint name="narrow" axis="0 0 1" range="-1 1" margin=".1"/>
      <geom type="box" size=".05 .02 .03" pos=".05 0 0"/></body></body></body></body>
<body name="f" pos=".9 .1 1.1"><freejoint/>
  <geom type="box" size=".05 .04 .03"/><site name="s4" pos=".03 .01 .02"/></body>
</worldbody>
<tendon><spatial name="t1" range="0 .2" margin=".1" limited="true"><site site="w"/><site site="s2"/></spatial>
<spatial name="t2" frictionloss="2" stiffness="3"><site site="s1"/><site site="s3"/></spatial>
<spatial name="t3" range=".3 1"><site site="w"/><site site="s4"/></spatial>
<spatial name="t4"><site site="s1"/><site site="s4"/></spatial>
<fixed name="t5" frictionloss=".3" limited="true" range="-.1 .1"><joint joint="narrow" coef="2"/>
  <joint joint="slide" coef="-1"/></fixed></tendon>
<equality><tendon tendon1="t3" tendon2="t4" polycoef="1.5 .5 .3 0 0"/><connect body1="c" body2="f" anchor=".3 0 .1"/>
<weld body1="f" body2="b" relpose=".3 .1 .1 1 .2 .1 .3" torquescale=".7" anchor=".1 .2 .3"/>
<weld site1="s3" site2="s4" torquescale="2"/><connect site1="s1" site2="s4"/>
<connect body1="f" anchor="0 0 .1"/></equality>
<actuator><motor joint="hinge" gear="5"/><motor tendon="t2" gear="3"/></actuator>
<sensor>SENSORS</sensor></mujoco>"""
LIMITS = [f"{kind}limit{what} {kind}='{name}'" for kind, names in (
    ("joint", ("hinge", "slide", "ball", "narrow")), ("tendon", ("t1", "t3", "t5"))
) for name in names for what in ("pos", "vel", "frc")]  # fmt: skip
FORCES = [f"{kind} site='{site}'" for kind in ("force", "torque") for site in ("s1", "s2", "s3", "s4")]
FORCES.append("force site='w'")  # C MuJoCo adds up torques of several trees about different points
TOUCHING = """<mujoco><option timestep="0.005" cone="CONE"/><default><geom solref=".01 1"/></default><worldbody>
<geom name="floor" type="plane" size="2 2 1"/><site name="zone" type="box" size=".3 .3 .05"/>
<body name="a" pos="0 0 .095"><freejoint/><geom name="box" type="box" size=".1 .1 .1" condim="4" friction="1 .1 .01"/>
  <site name="ball" type="sphere" size=".05" pos=".1 .1 -.1"/><site name="whole" type="box" size=".2 .2 .2"/>
  <site name="roll" type="cylinder" size=".1 .02" pos="0 .1 -.1"/><site name="top" size=".05" pos="0 0 .2"/></body>
<body name="b" pos=".05 0 .24"><freejoint/><geom name="ball" size=".05" condim="6"/>
  <site name="egg" type="ellipsoid" size=".03 .04 .02" pos="0 0 -.05"/></body>
<body name="c" pos=".4 0 .045"><joint type="slide" axis="0 0 1"/><joint axis="0 1 0"/>
  <geom name="rod" type="capsule" size=".05 .1" quat="1 0 1 0" condim="1"/>
  <site name="pill" type="capsule" size=".06 .02" pos=".1 0 0"/>
  <body name="d" pos="0 .2 0"><geom name="end" size=".05"/></body></body>
</worldbody><contact><exclude body1="a" body2="c"/><exclude body1="a" body2="d"/><exclude body1="b" body2="c"/>
<exclude body1="b" body2="d"/></contact><sensor>SENSORS</sensor></mujoco>"""
CONTACTS = [f"touch site='{site}'" for site in ("ball", "whole", "roll", "top", "egg", "pill")]
CONTACTS += ["force site='whole'", "torque site='egg'", "force site='pill'", "torque site='pill'"]
CONTACTS += [f"contact {which}" for which in (
    "geom1='box' geom2='floor' reduce='netforce' data='found force torque dist pos normal tangent'",
    "geom1='floor' geom2='box' reduce='netforce' data='force torque'", "subtree1='c' num='3'",
    "body1='a' reduce='maxforce' data='found force torque dist pos normal tangent'", "site='zone' num='12'",
    "body2='b' reduce='mindist' data='force torque dist pos normal tangent'", "body1='d' body2='b' data='found'",
    "geom1='floor' body2='c' reduce='maxforce' data='force torque normal'", "reduce='netforce' data='force'",
)]  # fmt: skip


def list_states(model, number, change):
    random = np.random.default_rng(0)
    states = []
    for _ in range(number):
        d = mujoco.MjData(model)
        mujoco.mj_integratePos(model, d.qpos, change(random, model.nv), 1.0)
        d.qvel[:] = random.normal(size=model.nv)
        d.ctrl[:] = random.uniform(-1, 1, model.nu)
        d.xfrc_applied[1:] = random.normal(size=(model.nbody - 1, 6))
        states.append(d)
    return states


def compare(model, states, outputs=("sensordata", "cfrc_ext")):
    """The fields by ours and by C MuJoCo, `[states, size]` each."""
    with jax.enable_x64(True):
        program = trace_fields(model, INPUTS, outputs)
    arguments = [np.stack([np.array(getattr(d, name)) for d in states]) for name in INPUTS]
    ours = evaluate(program, arguments)
    assert len(ours) == len(outputs), "nothing is watched"
    for d in states:
        mujoco.mj_forward(model, d)
        mujoco.mj_rnePostConstraint(model, d)
    return [
        (mine.reshape(len(states), -1), np.stack([getattr(d, name).ravel() for d in states]))
        for name, mine in zip(outputs, ours, strict=True)
    ]


def make(text, sensors):
    return converge(
        mujoco.MjModel.from_xml_string(text.replace("SENSORS", "".join(f"<{sensor}/>" for sensor in sensors)))
    )


def check_sensors(model, sensors, ours, true, tolerance):
    for number, name in enumerate(sensors):
        here = slice(model.sensor_adr[number], model.sensor_adr[number] + model.sensor_dim[number])
        size = max(1.0, np.abs(true[:, here]).max())
        np.testing.assert_allclose(ours[:, here] / size, true[:, here] / size, rtol=0, atol=tolerance, err_msg=name)


def test_limits_tendons_and_points_that_are_held():
    """Sensors of limits, and forces and torques between bodies; cfrc_ext with those of equalities and tendons."""
    sensors = [*LIMITS, *FORCES]
    model = make(LIMITED, sensors)
    states = list_states(model, 30, lambda random, nv: 0.6 * random.normal(size=nv))
    (ours, true), (wrench, true_wrench) = compare(model, states)
    check_sensors(model, sensors, ours, true, 1e-9)
    np.testing.assert_allclose(wrench, true_wrench, rtol=0, atol=1e-9 * np.abs(true_wrench).max())
    for number, name in enumerate(sensors[: len(LIMITS)]):
        pulled = "frc tendon='t3'" in name  # by the equality, out of its limit
        assert pulled or true[:, model.sensor_adr[number]].any(), f"{name} is exceeded sometimes"


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_contacts(cone):
    """Touch, contact, force and torque sensors, and cfrc_ext, with contacts of all dimensions."""
    model = make(TOUCHING.replace("CONE", cone), CONTACTS)
    states = list_states(model, 30, lambda random, nv: 0.01 * random.normal(size=nv))
    (ours, true), (wrench, true_wrench) = compare(model, states)
    check_sensors(model, CONTACTS, ours, true, 1e-8)
    np.testing.assert_allclose(wrench, true_wrench, rtol=0, atol=1e-8 * np.abs(true_wrench).max())
    for number, name in enumerate(CONTACTS):
        if not name.endswith(("'top'", "'found'")):
            assert np.abs(true[:, model.sensor_adr[number]]).max() > 0, name


RAYS = """<mujoco><worldbody><geom type="plane" size="2 2 1" quat="1 .02 .03 0"/>
<geom type="plane" size="1 1 1" pos="0 0 4" quat="0 1 0 0"/>
<geom type="capsule" size=".2 .3" pos="1 0 1"/><geom type="ellipsoid" size=".2 .3 .4" pos="-1 0 1"/>
<geom type="cylinder" size=".3 .2" pos="0 1 1"/><geom type="box" size=".2 .3 .4" pos="0 -1 1" quat="1 .2 .3 .4"/>
<geom size=".3" pos="1 1 2"/><geom size=".3" pos="-1 1 2" rgba="0 0 0 0"/>
<site name="capsule" type="capsule" size=".5 .5" pos=".5 0 1"/><site name="egg" type="ellipsoid" size=".9 .6 .8"/>
<site name="tin" type="cylinder" size=".9 .8" pos="0 0 1"/><site name="crate" type="box" size=".5 .9 .4" pos="0 0 1"/>
<site name="sphere" size="1" pos="0 .5 1"/>
<body name="eye" pos="0 0 1"><freejoint/><geom name="own" size=".1"/><site name="z" pos=".2 0 0"/></body></worldbody>
<sensor><rangefinder site="z"/><rangefinder site="z" cutoff="1"/>SENSORS</sensor></mujoco>"""
INSIDE = [
    f"insidesite objtype='{kind}' objname='{name}' site='{site}'"
    for kind, name in (("site", "z"), ("body", "eye"))
    for site in ("capsule", "egg", "tin", "crate", "sphere")
]


def test_rays_and_zones():
    """A ray from anywhere to the first of shapes of all kinds, also from within; and which points are in sites."""
    model = make(RAYS, INSIDE)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    states = list_states(model, 1000, lambda random, nv: random.normal(size=nv) * [0.9, 0.9, 0.9, 3, 3, 3])
    ((ours, true),) = compare(model, states, ("sensordata",))
    np.testing.assert_allclose(ours, true, rtol=0, atol=1e-9)
    assert 0.1 < (true[:, 0] < 0).mean() < 0.9
    assert ((true[:, 2:].mean(0) > 0.05) & (true[:, 2:].mean(0) < 0.95)).all()
