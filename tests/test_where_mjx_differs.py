"""The table "Where MJX differs from C MuJoCo" of docs/physics.md: `scalar` is C MuJoCo's, `mjx` is not."""

import logging
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from envs.physics import MujocoModelError, compile_step, scalar

PAGE = (Path(__file__).parent.parent / "docs" / "physics.md").read_text(encoding="utf-8")
LINK = '<geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" mass="1" contype="0" conaffinity="0"/>'


def arm(actuator="", option="", joint="", sensor="", body=LINK):
    return f"""<mujoco><option timestep="0.002" {option}/><worldbody><body><joint name="a" axis="0 1 0" {joint}/>{body}
    <site name="s" pos=".3 0 0"/></body></worldbody><actuator>{actuator}</actuator><sensor>{sensor}</sensor></mujoco>"""


def four_bar(equality):
    return f"""<mujoco><option timestep="0.001" gravity="0 0 0" iterations="100" tolerance="0"/>
    <default><geom type="capsule" size=".02" mass="1" contype="0" conaffinity="0"/></default>
    <worldbody><body><joint axis="0 1 0"/><geom fromto="0 0 0 0 0 .3"/>
    <body pos="0 0 .3"><joint axis="0 1 0"/><geom fromto="0 0 0 .5 0 0"/>
    <body name="rocker" pos=".5 0 0"><joint axis="0 1 0"/><geom fromto="0 0 0 0 0 -.4"/></body></body></body>
    <body name="pin" pos=".5 0 -.1"><joint axis="0 1 0"/><geom size=".02" type="sphere"/></body></worldbody>
    <equality>{equality}</equality></mujoco>"""


def falling(shape, on, size=".1 .1 .1", option="", geom=""):
    return f"""<mujoco><option timestep="0.002" tolerance="0" {option}/><worldbody><geom {on} {geom}/>
    <body pos=".03 .02 .195"><freejoint/><geom type="{shape}" size="{size}" {geom}/></body></worldbody></mujoco>"""


FREE = """<mujoco><option gravity="0 0 0" integrator="implicitfast"/><worldbody><body><freejoint/>
<geom type="box" size=".1 .2 .3" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""
SERVO = '<position joint="a" kp="2000" kv="400" forcerange="-10 10"/>'
CONE = falling("sphere", 'type="plane" size="1 1 .1" pos="0 0 .1"', ".1", 'cone="elliptic"', 'condim="1"')
UNSPRUNG = arm('<motor joint="a"/>', joint='stiffness="1" damping="1"').replace(
    "<worldbody>", '<option><flag spring="disable"/></option><worldbody>'
)
MUSCLE = '<muscle joint="a" force="300" range=".75 1.05" lengthrange="-1 1"/>'
FILTER = '<general joint="a" dyntype="filter" dynprm="0.1" gainprm="5" {}/>'
MOTOR = "<motor joint='a'/>"
CRANK = arm('<motor cranksite="s" slidersite="rail" cranklength="1"/>').replace(
    "<worldbody>", '<worldbody><site name="rail" pos="1 0 0" quat="1 0 1 0"/>'
)
CHAIN = [20.0, -20.0, 15.0, 0.0]  # velocities that close the loop
BOX = 'type="box" size=".1 .1 .1"'
# by row of the table: models, with velocities and a control, and the number of steps
ROWS = {
    "servos at their force limit": [(arm(SERVO, 'integrator="implicitfast"'), [0.0], 1.0, 1)],
    "muscles": [(arm(MUSCLE, 'integrator="implicitfast"'), [1.0], 0.8, 50)],
    "`connect`, `weld`": [
        (four_bar('<connect body1="rocker" anchor="0 0 -.4"/>'), CHAIN, 0.0, 20),
        (four_bar('<weld body1="rocker" body2="pin"/>'), [20.0, -20.0, 15.0, 15.0], 0.0, 20),
    ],
    "sensors of forces and accelerations without constraints": [
        (arm("<motor joint='a'/>", sensor='<jointactuatorfrc joint="a"/>'), [0.0], 1.0, 1),
        (arm("<motor joint='a'/>", sensor='<accelerometer site="s"/>'), [1.0], 0.0, 1),
    ],
    "`actearly`": [(arm(FILTER.format('actearly="true"')), [0.0], 1.0, 20)],
    "the flag `spring`": [(UNSPRUNG, [3.0], 0.0, 20)],
    "a spinning free body with `implicitfast`": [(FREE, [0.0, 0.0, 0.0, 8.0, 5.0, 6.0], 0.0, 200)],
    "integrator `implicit`": [(arm(SERVO, 'integrator="implicit"'), [0.0], 1.0, 1)],
    "boxes on boxes": [(falling("box", BOX), [0.3, 0.0, 0.0, 4.0, -3.0, 2.0], 0.0, 15)],
    "boxes with cylinders and ellipsoids": [
        (falling("cylinder", BOX), [0.1, 0.0, 0.0, 0.0, 0.3, 0.2], 0.0, 20),
        (falling("ellipsoid", BOX), [0.1, 0.0, 0.0, 0.0, 0.3, 0.2], 0.0, 20),
    ],
    "elliptic cones of contacts without friction": [(CONE, [0.0] * 6, 0.0, 5)],
    "polynomial stiffness and damping": [(arm(MOTOR, joint='stiffness="1 20" damping="1 2"'), [3.0], 0.0, 100)],
    "damping and armature of actuators, disabled groups": [
        (arm(MOTOR.replace("/>", ' damping="3"/>')), [3.0], 0.0, 20),
        (arm(MOTOR.replace("/>", ' armature="3"/>')), [0.0], 1.0, 20),
        (arm(MOTOR.replace("/>", ' group="1"/>'), 'actuatorgroupdisable="1"'), [0.0], 1.0, 20),
    ],
    "slider-cranks": [(CRANK, [1.0], 1.0, 20)],
}
CASES = [pytest.param(*case, id=f"{row} {number}") for row, cases in ROWS.items() for number, case in enumerate(cases)]


def play(model, velocity, control, steps, physics):
    """The state and the sensors after some steps."""
    names = ("qpos", "qvel", "act") if model.na else ("qpos", "qvel")
    step = compile_step(model, steps, inputs=(*names, "ctrl"), outputs=(*names, "sensordata"), physics=physics)
    data = mujoco.MjData(model)
    given = {"qvel": np.array(velocity), "ctrl": np.full(model.nu, control)}
    return jax.jit(step)(*(jnp.asarray(given.get(name, getattr(data, name))) for name in (*names, "ctrl")))


def play_in_c(model, velocity, control, steps):
    data = mujoco.MjData(model)
    data.qvel, data.ctrl = velocity, control
    for _ in range(steps):
        mujoco.mj_step(model, data)
    return data.qpos, data.qvel, *([data.act] if model.na else []), data.sensordata


def find_difference(ours, true):
    return max(np.max(np.abs(a - b), initial=0) for a, b in zip(ours, true, strict=True))


@pytest.mark.parametrize(("text", "velocity", "control", "steps"), CASES)
def test_scalar_is_mujocos_and_mjx_is_not(text, velocity, control, steps, monkeypatch, caplog):
    """After some steps: C MuJoCo's to 1e-8; MJX refuses, or is off by more than 1e-4."""
    monkeypatch.setattr(scalar, "_warned", set())
    model = mujoco.MjModel.from_xml_string(text)
    true = play_in_c(model, velocity, control, steps)
    with jax.enable_x64(True), caplog.at_level(logging.ERROR):
        assert find_difference(play(model, velocity, control, steps, "scalar"), true) < 1e-8
        try:
            theirs = play(model, velocity, control, steps, "mjx")
        except (MujocoModelError, NotImplementedError):
            return
        assert find_difference(theirs, true) > 1e-4


def test_the_table_has_these_rows():
    table = PAGE.partition("## Where MJX differs")[2].partition("\n## ")[0]
    rows = [line for line in table.splitlines() if "test_where_mjx_differs" in line]
    assert len(rows) == len(ROWS)
    named = {re.split(r" \| ", line.strip("| "))[0] for line in rows}
    assert named == set(ROWS)
