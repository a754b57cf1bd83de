"""Robots: what actuators do in C MuJoCo under the controls that ask for it, servos made of motors, twists, goals."""

import sys
import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import published
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from envs.options import OptionError
from envs.physics import compile_model
from envs.robots import controls, load_robot, make_control, read_arm
from envs.robots.arms import NoArmError
from envs.robots.controls import ControlOptions
from envs.robots.drives import read_drive
from envs.robots.goals import draw_poses, find_goal_ranges, measure_free_share
from envs.robots.sources import name_parts
from envs.robots.twists import DAMPING, damped_least_squares, limit_velocities

OPTIONS = ControlOptions(control="velocity", torque=0.5, speed=None, step=0.2, dt=0.02)

# --- drives -----------------------------------------------------------------------------------------------------------


def joint(actuator, kind="hinge", more=""):
    """A model of one joint on an actuator."""
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><compiler angle="radian"/><option gravity="0 0 0" timestep="0.001"/><worldbody><body>
        <joint name="j" type="{kind}" axis="0 1 0" {more}/><geom size="0.1" mass="50"/></body></worldbody>
        <actuator>{actuator}</actuator></mujoco>"""
    )


def torque_of(model, ctrl, qpos=0.0, qvel=0.0):
    """The joint's torque by its actuator, in C MuJoCo."""
    data = mujoco.MjData(model)
    data.ctrl[:], data.qpos[:], data.qvel[:] = ctrl, qpos, qvel
    mujoco.mj_forward(model, data)
    return float(data.qfrc_actuator[0])


OFFSETS = st.floats(-3, 3).map(lambda x: round(x, 3))
NUMBERS = st.floats(0.1, 20).map(lambda x: round(x, 3))
SIGNED = st.tuples(NUMBERS, st.sampled_from([-1, 1])).map(lambda pair: pair[0] * pair[1])
general = '<general joint="j" gear="{}" gainprm="{}" biastype="affine" biasprm="{} {} {}" ctrlrange="{} {}"/>'.format


@settings(max_examples=40, deadline=None)
@given(SIGNED, SIGNED, OFFSETS, st.sampled_from([(-1, 1), (0, 255), (-1, 0), (-2, 7)]), st.data())
def test_a_motor_gives_the_torque_that_its_control_asks_for(gear, gain, offset, ends, data):
    model = joint(general(gear, gain, offset, 0, 0, *ends))
    drive = read_drive(model, 0)
    assert drive.kind == "motor"
    low, high = drive.quantity_range()
    np.testing.assert_allclose(sorted(torque_of(model, end) for end in ends), (low, high), rtol=1e-9)
    assert drive.torque == (low, high)
    torque = data.draw(st.floats(low, high))
    assert torque_of(model, drive.control_of(torque), 0.3, 0.2) == pytest.approx(torque, abs=1e-9 * (high - low))


@settings(max_examples=40, deadline=None)
@given(SIGNED, SIGNED, OFFSETS, NUMBERS, NUMBERS, st.sampled_from([(-1, 1), (0, 255), (-1, 0)]), st.data())
def test_a_position_servo_rests_where_its_control_asks_for(gear, gain, offset, stiffness, damping, ends, data):
    model = joint(general(gear, gain, offset, -stiffness, -damping, *ends))
    drive = read_drive(model, 0)
    assert drive.kind == "position"
    low, high = drive.quantity_range()
    angle = data.draw(st.floats(low, high))
    ctrl = drive.control_of(angle)
    width = high - low
    assert ends[0] - 1e-9 <= ctrl <= ends[1] + 1e-9
    assert torque_of(model, ctrl, angle) == pytest.approx(0, abs=1e-9 * (1 + abs(gear * gain) * 255))
    assert torque_of(model, ctrl, angle + width) < 0 < torque_of(model, ctrl, angle - width)


@settings(max_examples=40, deadline=None)
@given(SIGNED, SIGNED, OFFSETS, NUMBERS, st.sampled_from([(-1, 1), (0, 255), (-1, 0)]), st.data())
def test_a_velocity_servo_keeps_the_speed_that_its_control_asks_for(gear, gain, offset, damping, ends, data):
    model = joint(general(gear, gain, offset, 0, -damping, *ends))
    drive = read_drive(model, 0)
    assert drive.kind == "velocity"
    low, high = drive.quantity_range()
    speed = data.draw(st.floats(low, high))
    ctrl = drive.control_of(speed)
    assert torque_of(model, ctrl, 1.7, speed) == pytest.approx(0, abs=1e-9 * (1 + abs(gear * gain) * 255))
    assert torque_of(model, ctrl, 1.7, speed + 1) < 0 < torque_of(model, ctrl, 1.7, speed - 1)


@pytest.mark.parametrize("gear", [1.0, -2.5])
def test_an_integrating_servo_keeps_the_speed_that_its_control_asks_for(gear):
    model = joint(f'<intvelocity joint="j" kp="900" kv="20" gear="{gear}" actrange="-9 9" ctrlrange="-4 4"/>')
    drive = read_drive(model, 0)
    assert (drive.kind, drive.integral) == ("velocity", 0)
    np.testing.assert_allclose(drive.quantity_range(), (-4 / abs(gear), 4 / abs(gear)))
    data = mujoco.MjData(model)
    data.ctrl[:] = drive.control_of(0.8)
    mujoco.mj_step(model, data, 1500)
    assert data.qvel[0] == pytest.approx(0.8, rel=1e-3)


@pytest.mark.parametrize(
    ("actuator", "more", "limits"),
    [
        ('<motor joint="j" gear="-2" ctrlrange="-1 3"/>', "", (-6, 2)),
        ('<motor joint="j" gear="2" ctrlrange="-9 9" forcerange="-1 3"/>', "", (-2, 6)),
        ('<motor joint="j" gear="2" ctrlrange="-9 9"/>', 'actuatorfrcrange="-5 4"', (-5, 4)),
        ('<position joint="j" kp="900" gear="-2" forcerange="-1 3"/>', "", (-6, 2)),
        ('<velocity joint="j" kv="900" gear="0.5" forcerange="-8 8"/>', 'actuatorfrcrange="-3 3"', (-3, 3)),
        ('<general joint="j" dyntype="filter" dynprm="0.1" gainprm="2" ctrlrange="-1 3"/>', "", (-2, 6)),
    ],
)
def test_torque_limits_are_those_of_c_mujoco(actuator, more, limits):
    model = joint(actuator, more=more)
    assert read_drive(model, 0).torque == limits
    data = mujoco.MjData(model)
    torques = []
    for sign in (-1, 1):  # however large the control, and however long
        mujoco.mj_resetData(model, data)
        data.ctrl[:] = 1e3 * sign
        model.opt.timestep = 1.0
        data.act[:] = model.actuator_ctrlrange[0][int(sign > 0)] if model.na else 0
        mujoco.mj_forward(model, data)
        torques.append(float(data.qfrc_actuator[0]))
    np.testing.assert_allclose(sorted(torques), limits)


@pytest.mark.parametrize(
    ("actuator", "kind"),
    [
        ('<muscle joint="j" lengthrange="0 1"/>', "other"),
        ('<damper joint="j" kv="1" ctrlrange="0 1"/>', "other"),
        ('<motor joint="j" gear="0"/>', "other"),
        ('<general joint="j" gainprm="1" biastype="affine" biasprm="0 0 1"/>', "other"),  # it speeds up
        ('<general joint="j" dyntype="integrator" gainprm="1"/>', "other"),
    ],
)
def test_an_actuator_of_another_kind_is_taken_for_none_of_these(actuator, kind):
    assert read_drive(joint(actuator), 0).kind == kind


def test_of_several_actuators_a_known_one_drives_the_joint():
    model = joint('<damper joint="j" kv="1" ctrlrange="0 1"/><motor joint="j" ctrlrange="-1 1"/>')
    assert read_drive(model, 0).actuator == 1
    assert read_drive(joint('<motor joint="j"/><position joint="j"/>'), 0).actuator == 0


# --- arms -------------------------------------------------------------------------------------------------------------

MOTOR = '<motor joint="{name}" ctrlrange="-60 40" gear="2"/>'
SERVO = '<position joint="{name}" kp="4000" kv="400" ctrlrange="-1 1.5" forcerange="-200 200"/>'
SPEED = '<velocity joint="{name}" kv="400" ctrlrange="-3 3" forcerange="-200 200"/>'
INTEGRAL = '<intvelocity joint="{name}" kp="4000" kv="400" ctrlrange="-3 3" actrange="-2 2" gear="-1"/>'
NAMES = tuple(f"j{i}" for i in range(6))


def arm(actuator, number=6, ranged='range="-2 2"', end="", floor=""):
    """An arm of six hinges with gravity, in no special pose."""
    spec = mujoco.MjSpec.from_string(arm_xml(actuator, number, ranged, end, floor))
    name_parts(spec)
    return spec


def arm_xml(actuator, number=6, ranged='range="-2 2"', end="", floor=""):
    axes = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "0 0 1")
    bodies = "".join(
        f'<body name="link{i}" pos="{0.05 * (i % 2)} 0 0.25"><joint name="{name}" axis="{axes[i]}" {ranged}/>'
        f'<geom type="capsule" size="0.04" fromto="0 0 0.06 0 0.02 0.2" mass="{3 - 0.4 * i}"/>'
        for i, name in enumerate(NAMES[:number])
    )
    actuators = "".join(actuator.format(name=name) for name in NAMES[:number])
    pose = " ".join(["0.3", "0.5", "0.9", "-0.4", "0.8", "0.2"][:number])
    return f"""<mujoco model="arm"><compiler angle="radian"/><option timestep="0.0005" integrator="implicitfast"/>
    <worldbody>{floor}{bodies}<site name="tcp" pos="0.02 0.01 0.2"/>{"</body>" * number}</worldbody>
    <actuator>{actuators}</actuator><keyframe><key name="home" qpos="{pose}"/></keyframe>{end}</mujoco>"""


def control_of(actuator, control, **more):
    return make_control(arm(actuator, **more), "tcp", OPTIONS._replace(control=control))


def data_of(control):
    """C MuJoCo's data of the arm at rest, with activations as at the start."""
    data = mujoco.MjData(control.arm.model)
    data.qpos[:] = control.arm.qpos
    if control.arm.model.na:
        data.act[:] = control.start(jnp.asarray(control.arm.angles))
    return data


def command(control, action, data, target=None):
    target = None if target is None else jnp.asarray(target)
    ctrl, target = control.command(jnp.asarray(action, float), jnp.asarray(data.qpos), target)
    return np.asarray(ctrl, float), target if target is None else np.asarray(target, float)


def test_effective_inertia_is_what_a_torque_feels():
    """tau = I q'' in C MuJoCo, for a torque on one joint while the others are free."""
    spec = arm(MOTOR)
    for each in spec.joints:
        each.armature = 0.01
    read = read_arm(spec)
    inertia = controls.find_effective_inertia(read)
    read.model.opt.gravity[:] = 0
    for i in range(6):
        data = mujoco.MjData(read.model)
        data.qpos[:] = read.qpos
        data.qfrc_applied[i] = 1.0
        mujoco.mj_forward(read.model, data)
        assert inertia[i] == pytest.approx(1 / data.qacc[i], rel=1e-9)


def test_a_motor_becomes_a_velocity_servo_of_thirty_milliseconds():
    """q'(t) = v (1 - e^(-t / 0.03)), with gravity compensated."""
    control = control_of(MOTOR, "velocity", number=1)
    data = data_of(control)
    data.ctrl[:], _ = command(control, [0.5], data)
    speed = 0.5 * control.limits[0]
    for i in range(300):
        mujoco.mj_step(control.arm.model, data)
        expected = speed * (1 - np.exp(-(i + 1) * 0.0005 / controls.TIME_CONSTANT))
        assert data.qvel[0] == pytest.approx(expected, abs=0.01 * speed)


def test_a_motor_becomes_a_critically_damped_position_servo():
    """q(t) = q* (1 - (1 + w t) e^(-w t)) around the start, with w = 20 rad/s."""
    control = control_of(MOTOR, "position", number=1)
    data = data_of(control)
    start = data.qpos[0]
    data.ctrl[:], target = command(control, [0.1], data)
    assert target is None
    for i in range(1000):
        mujoco.mj_step(control.arm.model, data)
        t = (i + 1) * 0.0005 * controls.FREQUENCY
        assert data.qpos[0] - start == pytest.approx(0.02 * (1 - (1 + t) * np.exp(-t)), abs=0.02 * 0.02)


@pytest.mark.parametrize("control", ["velocity", "position"])
def test_servos_of_motors_keep_their_torque_limits(control):
    """From -120 to 80 N m: a control from -60 to 40 on a gear of 2."""
    changed = control_of(MOTOR, control)
    for each in changed.arm.joints:
        assert each.drive.torque == (-120, 80)
    assert read_arm(arm(MOTOR)).joints[0].drive.torque == (-120, 80)


@pytest.mark.parametrize("control", ["torque", "velocity", "position", "twist"])
def test_gravity_compensation_holds_motors_still(control):
    made = control_of(MOTOR, control)
    data = data_of(made)
    data.ctrl[:], _ = command(made, np.zeros(6), data)
    mujoco.mj_step(made.arm.model, data, 1000)
    np.testing.assert_allclose(data.qpos, made.arm.qpos, atol=1e-6)  # set-points are in single precision
    without = mujoco.MjData(read_arm(arm(MOTOR)).model)
    without.qpos[:] = made.arm.qpos
    mujoco.mj_step(read_arm(arm(MOTOR)).model, without, 1000)
    assert np.abs(without.qpos - made.arm.qpos).max() > 0.1


def test_torques_are_commanded_as_they_are():
    control = control_of(MOTOR, "torque")
    np.testing.assert_allclose(control.limits, 0.5 * 80)  # the smaller of both sides
    data, action = data_of(control), np.linspace(-1, 1, 6)
    data.ctrl[:], _ = command(control, action, data)
    mujoco.mj_forward(control.arm.model, data)
    np.testing.assert_allclose(data.qfrc_actuator, control.limits * action, rtol=1e-6)


@pytest.mark.parametrize("actuator", [MOTOR, SPEED, INTEGRAL])
def test_velocities_are_kept_by_every_kind_of_actuator(actuator):
    control = control_of(actuator, "velocity")
    control.arm.model.opt.gravity[:] = 0  # against which servos lag behind
    data, action = data_of(control), np.array([0.05, -0.02, 0.03, 0.05, -0.04, 0.02])
    data.ctrl[:], target = command(control, action, data)
    assert target is None
    mujoco.mj_step(control.arm.model, data, 2000)
    np.testing.assert_allclose(data.qvel, 2.0 * action, atol=0.005)


def test_integrals_begin_at_the_positions_of_the_joints():
    """So that servos pull nowhere."""
    data = data_of(control_of(INTEGRAL, "velocity"))
    mujoco.mj_forward(data.model, data)
    np.testing.assert_allclose(data.act, -data.qpos, rtol=1e-6)  # on a gear of -1
    np.testing.assert_allclose(data.qfrc_actuator, 0, atol=1e-3)


def test_velocities_move_the_set_points_of_position_servos():
    control = control_of(SERVO, "velocity")
    control.arm.model.opt.gravity[:] = 0
    data, action = data_of(control), np.array([0.05, -0.02, 0.03, 0.05, -0.04, 0.02])
    assert control.has_target
    target, passed = control.arm.angles, []
    for _ in range(50):
        before = target
        passed.append(data.qpos.copy())
        data.ctrl[:], target = command(control, action, data, target)
        np.testing.assert_allclose(target, before + 0.02 * 2.0 * action, atol=1e-6)
        np.testing.assert_allclose(data.ctrl, target, atol=1e-6)
        mujoco.mj_step(control.arm.model, data, 40)
    np.testing.assert_allclose((passed[-1] - passed[-11]) / 0.2, 2.0 * action, atol=0.003)


@settings(max_examples=30, deadline=None)
@given(arrays.arrays(float, (12, 6), elements=st.floats(-1, 1)), st.sampled_from(["velocity", "twist"]))
def test_set_points_stay_in_the_ranges_of_joints_and_controls(actions, how):
    """-2 to 2 rad of the joints, and -1 to 1.5 of the controls."""
    control = SERVOS[how]
    data, target = data_of(control), np.clip(control.arm.angles, -1, 1.5)
    data.qpos[:] = target
    for action in np.sign(actions):
        ctrl, target = command(control, action, data, target)
        assert (target >= -1 - 1e-6).all()
        assert (target <= 1.5 + 1e-6).all()
        np.testing.assert_allclose(ctrl, target, atol=1e-6)
        data.qpos[:] = target


SERVOS = {how: control_of(SERVO, how) for how in ("velocity", "twist")}


@pytest.mark.parametrize(("actuator", "low", "high"), [(SERVO, -1, 1.5), (MOTOR, -2, 2)])
def test_commanded_positions_are_steps_from_the_measured_ones_within_the_ranges(actuator, low, high):
    control = control_of(actuator, "position")
    drives = [each.drive for each in control.arm.joints]
    data = data_of(control)
    for angles in (np.zeros(6), np.full(6, high - 0.05), np.full(6, low + 0.05)):
        data.qpos[:] = angles
        for action in (np.ones(6), -np.ones(6), np.linspace(-1, 1, 6)):
            ctrl, _ = command(control, action, data)
            wanted = np.clip(angles + 0.2 * action, low, high)
            expected = [drive.control_of(angle) for drive, angle in zip(drives, wanted, strict=True)]
            np.testing.assert_allclose(ctrl, expected, rtol=1e-4, atol=1e-6)


def test_speeds_are_the_options_the_models_or_two():
    numeric = '<custom><numeric name="velocity_limit" data="1 2 3 4 5 6"/></custom>'
    assert control_of(MOTOR, "velocity").limits.tolist() == [2.0] * 6
    assert control_of(MOTOR, "velocity", end=numeric).limits.tolist() == [1, 2, 3, 4, 5, 6]
    made = make_control(arm(MOTOR, end=numeric), "", OPTIONS._replace(speed=0.5))
    assert made.limits.tolist() == [0.5] * 6
    with pytest.raises(OptionError, match="has the numbers 1 2; expected 6 above 0"):
        control_of(MOTOR, "velocity", end='<custom><numeric name="velocity_limit" data="1 2"/></custom>')


def test_other_actuators_keep_their_controls():
    end = '<actuator><motor joint="j0" gear="0.1" ctrlrange="2 6" name="more"/></actuator>'
    spec = arm(MOTOR, end=end)
    spec.keys[0].ctrl = [*np.zeros(6), 5.0]
    made = make_control(spec, "tcp", OPTIONS)
    ctrl, _ = command(made, np.zeros(6), data_of(made))
    assert ctrl.tolist() == [0.0] * 6 + [5.0]


# --- twists -----------------------------------------------------------------------------------------------------------

VECTORS = st.floats(-3, 3)


@settings(max_examples=50, deadline=None)
@given(arrays.arrays(float, (6, 7), elements=VECTORS), arrays.arrays(float, 6, elements=VECTORS))
def test_damped_least_squares_are_the_least_squares_with_damping(jacobian, twist):
    """argmin |J q' - V|^2 + lambda^2 |q'|^2 by NumPy, and |q'| <= |V| / (2 lambda)."""
    with jax.enable_x64(True):
        found = np.asarray(damped_least_squares(jnp.asarray(jacobian), jnp.asarray(twist)))
    stacked = np.vstack([jacobian, DAMPING * np.eye(7)])
    expected = np.linalg.lstsq(stacked, np.concatenate([twist, np.zeros(7)]), rcond=None)[0]
    np.testing.assert_allclose(found, expected, atol=1e-8 * (1 + np.abs(expected).max()))
    assert np.linalg.norm(found) <= np.linalg.norm(twist) / (2 * DAMPING) + 1e-9


def test_the_bound_of_damped_least_squares_is_reached():
    """Where the singular value is lambda."""
    found = damped_least_squares(jnp.full((1, 1), DAMPING), jnp.ones(1))
    assert float(found[0]) == pytest.approx(1 / (2 * DAMPING))


LIMITS = arrays.arrays(float, 4, elements=st.floats(0.1, 3))


@settings(max_examples=100, deadline=None)
@given(
    arrays.arrays(float, 4, elements=st.floats(-9, 9)),
    arrays.arrays(float, 4, elements=st.floats(-2.5, 2.5)),
    LIMITS,
)
def test_limited_velocities(velocity, qpos, limit):
    low, high, dt = np.full(4, -2.0), np.array([2.0, 2.0, 2.0, np.inf]), 0.1
    found = np.asarray(limit_velocities(jnp.asarray(velocity), jnp.asarray(qpos), low, high, limit, dt), float)
    assert (np.abs(found) <= limit * (1 + 1e-5)).all()
    after = qpos + dt * found
    is_inside = (low <= qpos) & (qpos <= high)
    assert (after[is_inside] >= low[is_inside] - 1e-5).all()
    assert (after[is_inside] <= high[is_inside] + 1e-5).all()
    assert (found[qpos < low] >= 0).all()  # only back
    assert (found[qpos > high] <= 0).all()
    slowed = velocity * min(1.0, float(np.min(limit / np.maximum(np.abs(velocity), 1e-12))))
    is_free = (qpos + dt * slowed >= low) & (qpos + dt * slowed <= high)
    np.testing.assert_allclose(found[is_free], slowed[is_free], rtol=1e-5, atol=1e-5)  # in the same direction


@settings(max_examples=25, deadline=None)
@given(arrays.arrays(float, 6, elements=st.floats(-1, 1)))
def test_a_twist_moves_the_site_by_it(action):
    """Finite differences of C MuJoCo's site: (I - lambda^2 (J J^T + lambda^2 I)^-1) V, near V where J is large."""
    control, dt = TWISTER, 1e-6
    model, data = control.arm.model, data_of(control)
    assume(np.abs(action).max() > 0.01)
    velocity, _ = command(control, 0.1 * action, data)
    twist = 0.1 * action * control.limits
    mujoco.mj_forward(model, data)
    position, rotation = data.site("tcp").xpos.copy(), data.site("tcp").xmat.reshape(3, 3).copy()
    linear, angular = np.zeros((3, 6)), np.zeros((3, 6))
    mujoco.mj_jacSite(model, data, linear, angular, model.site("tcp").id)
    jacobian = np.vstack([linear, angular])
    data.qpos[:] += dt * velocity
    mujoco.mj_forward(model, data)
    turn = (data.site("tcp").xmat.reshape(3, 3) - rotation) @ rotation.T / dt
    moved = np.array([*((data.site("tcp").xpos - position) / dt), turn[2, 1], turn[0, 2], turn[1, 0]])
    damped = DAMPING**2 * np.linalg.inv(jacobian @ jacobian.T + DAMPING**2 * np.eye(6))
    np.testing.assert_allclose(moved, twist - damped @ twist, atol=1e-4)
    smallest = np.linalg.svd(jacobian)[1][-1]
    share = DAMPING**2 / (smallest**2 + DAMPING**2)
    assert share < 0.3
    assert np.linalg.norm(moved - twist) <= share * np.linalg.norm(twist) + 1e-4


TWISTER = control_of(SPEED, "twist")

# --- goals ------------------------------------------------------------------------------------------------------------

WALL = '<body name="wall" pos="-0.25 0 0.8"><geom type="box" size="0.05 0.6 0.5"/></body>'


def test_goals_are_where_nothing_penetrates_and_above_the_ground():
    read = read_arm(arm(MOTOR, floor=WALL))
    poses = draw_poses(read)
    low, high = find_goal_ranges(read)
    np.testing.assert_allclose((low, high), [[-1.4] * 6, [1.4] * 6])  # 70 % of -2 to 2
    assert (poses >= low).all()
    assert (poses <= high).all()
    data = mujoco.MjData(read.model)
    for pose in poses[:300]:
        data.qpos[:] = pose
        mujoco.mj_forward(read.model, data)
        assert not (data.contact.dist < 0).any()
        assert data.site("tcp").xpos[2] > 0
    draws = np.random.default_rng(1).uniform(low, high, (300, 6))
    free = []
    for pose in draws:
        data.qpos[:] = pose
        mujoco.mj_forward(read.model, data)
        free.append(not (data.contact.dist < 0).any())
    assert 0.2 < np.mean(free) < 0.9  # so that there was something to avoid
    assert measure_free_share(read) == pytest.approx(np.mean(free), abs=0.1)


def test_goals_of_joints_without_ranges_are_within_half_a_turn_of_the_rest():
    read = read_arm(arm(MOTOR, ranged=""))
    low, high = find_goal_ranges(read)
    np.testing.assert_allclose(low, read.angles - 0.7 * np.pi)
    np.testing.assert_allclose(high, read.angles + 0.7 * np.pi)


def test_an_arm_that_can_hardly_be_anywhere_is_refused():
    """Between walls that it touches nowhere at rest, straight up, and nearly everywhere else."""
    walls = "".join(
        f'<body name="wall{i}" pos="{x} {y} 1"><geom type="box" size="0.5 0.5 1"/></body>'
        for i, (x, y) in enumerate([(0.6, 0.6), (0.6, -0.6), (-0.6, 0.6), (-0.6, -0.6)])
    )
    spec = arm(MOTOR, floor=walls)
    spec.keys[0].qpos = np.zeros(6)
    with pytest.raises(OptionError, match=r"random poses of arm are free of collisions .*; give env.goal_box"):
        draw_poses(read_arm(spec))


# --- reading ----------------------------------------------------------------------------------------------------------


def test_parts_without_a_name_get_one_that_is_free(tmp_path):
    xml = arm_xml('<motor joint="{name}"/>').replace('name="link3"', "").replace('name="link5"', 'name="body4"')
    xml = xml.replace('<site name="tcp"', '<site name="site1"/><site')
    (tmp_path / "arm.xml").write_text(xml)
    spec = load_robot(str(tmp_path / "arm.xml"))
    assert [body.name for body in spec.bodies] == ["world", "link0", "link1", "link2", "body4_", "link4", "body4"]
    assert [actuator.name for actuator in spec.actuators] == [f"actuator{i}" for i in range(6)]
    assert [site.name for site in spec.sites] == ["site1", "site1_"]
    compile_model(spec)


def arm_with_camera():
    spec = arm(MOTOR)
    spec.body("link5").add_site(name="camera")
    return spec


def test_a_site_is_found_by_its_name_before_its_place():
    read = read_arm(arm_with_camera())
    assert read.site == "tcp"
    assert "site 'tcp' (env.site" in read.guesses[0]
    assert read_arm(arm_with_camera(), "camera").site == "camera"
    with pytest.raises(OptionError, match=r"unknown site or body 'camra': did you mean 'camera'\? \(env\.site\)"):
        read_arm(arm_with_camera(), "camra")


def test_a_body_may_be_the_end_effector():
    read = read_arm(arm(MOTOR), "link2")
    assert [each.name for each in read.joints] == ["j0", "j1", "j2"]
    data = mujoco.MjData(read.model)
    mujoco.mj_forward(read.model, data)
    np.testing.assert_array_equal(data.site(read.site).xpos, data.body("link2").xpos)


def test_without_a_keyframe_it_rests_in_the_middle_of_the_ranges():
    spec = arm(MOTOR, ranged='range="-1 2"')
    spec.delete(spec.keys[0])
    read = read_arm(spec)
    np.testing.assert_allclose(read.angles, 0.5)
    assert "middle of its joints' ranges" in read.guesses[0]


@pytest.fixture
def menagerie(monkeypatch, tmp_path):
    """A stand-in for the package `mujoco_menagerie`, which has one robot with two files; `failures` are raised."""
    package, failures = types.ModuleType("mujoco_menagerie"), []
    package.MenagerieError = type("MenagerieError", (Exception,), {})
    package.DownloadError = type("DownloadError", (package.MenagerieError,), {})
    for name, number in (("lab_arm", 6), ("lab_arm_short", 2)):
        (tmp_path / f"{name}.xml").write_text(arm_xml(MOTOR, number))

    class Robot:
        entry_names, default_model = ("lab_arm", "lab_arm_short"), "lab_arm"

        def xml(self, entry):
            for failure in failures:
                raise failure
            return tmp_path / f"{entry}.xml"

    package.names, package.get, package.failures = lambda: ["maker_lab_arm"], {"maker_lab_arm": Robot()}.get, failures
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", package)
    return package


def test_a_robot_of_menagerie_is_that_of_its_file(menagerie):
    assert len(load_robot("menagerie:maker_lab_arm").joints) == 6
    assert len(load_robot("menagerie:maker_lab_arm/lab_arm_short").joints) == 2


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("lab_arm", "unknown robot 'lab_arm': did you mean 'maker_lab_arm'?"),
        ("maker_lab_amr", "unknown robot 'maker_lab_amr': did you mean 'maker_lab_arm'?"),
        ("go1", "-m mujoco_menagerie names` lists them"),
        ("", "-m mujoco_menagerie names` lists them"),
        ("maker_lab_arm/lab_arm_long", "unknown entry 'lab_arm_long': did you mean 'lab_arm'?"),
    ],
)
def test_unknown_robots_of_menagerie(menagerie, name, line):
    with pytest.raises(OptionError) as caught:
        load_robot(f"menagerie:{name}")
    (problem,) = caught.value.problems
    assert problem.startswith(f"env.robot=menagerie:{name}: ")
    assert line in problem


@pytest.mark.parametrize("kind", ["DownloadError", "MenagerieError", "OSError"])
def test_without_a_network_one_line_says_so(menagerie, kind):
    menagerie.failures.append(getattr(menagerie, kind, OSError)("archive.tar.xz:\n no route"))
    with pytest.raises(OptionError) as caught:
        load_robot("menagerie:maker_lab_arm")
    line = "it cannot be downloaded (archive.tar.xz: no route); a file on the disk needs no network"
    assert caught.value.problems == [f"env.robot=menagerie:maker_lab_arm: {line}"]


def test_without_the_package_its_installation_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", None)
    with pytest.raises(OptionError, match=r"needs mujoco-menagerie: \S+ -m pip install mujoco-menagerie$"):
        load_robot("menagerie:maker_lab_arm")


# The joints, end effector and guesses of the arms as they are published.
FINGERED = "the end effector is the middle of its gripper"
READ = {
    "franka_emika_panda/panda.xml": ([f"joint{i}" for i in range(1, 8)], "end effector", [FINGERED]),
    "franka_emika_panda/panda_nohand.xml": ([f"joint{i}" for i in range(1, 8)], "attachment_site", []),
    "kinova_gen3_7dof/gen3_7dof.xml": (
        [f"joint_{i}" for i in range(1, 8)],
        "wrist_camera_optical_frame",
        ["the end effector is its site 'wrist_camera_optical_frame'", "it rests in the middle"],
    ),
    "kuka_iiwa_14/iiwa14.xml": ([f"joint{i}" for i in range(1, 8)], "attachment_site", []),
    "trossen_vx300s/vx300s.xml": (
        ["waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate"],
        "pinch",
        [],
    ),
    "trs_so_arm100/so_arm100.xml": (
        ["Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll"],
        "end effector",
        [FINGERED],
    ),
    "ufactory_xarm7/xarm7.xml": ([f"joint{i}" for i in range(1, 8)], "link_tcp", []),
    "ufactory_xarm7/xarm7_nohand.xml": ([f"joint{i}" for i in range(1, 8)], "attachment_site", []),
    "unitree_z1/z1.xml": (
        [f"joint{i}" for i in range(1, 7)],
        "end effector",
        ["the end effector is the centre of mass of body 'link06'"],
    ),
    "universal_robots_ur5e/ur5e.xml": (
        [
            *(f"{name}_joint" for name in ("shoulder_pan", "shoulder_lift", "elbow")),
            *(f"wrist_{i}_joint" for i in (1, 2, 3)),
        ],
        "attachment_site",
        [],
    ),
}


@pytest.mark.parametrize("name", READ)
def test_published_arms_are_read(name):
    model = published.load(name)
    joints, site, guesses = READ[name]
    read = read_arm(load_robot(str(published.FOLDER / name)))
    assert [joint.name for joint in read.joints] == joints
    assert read.site == site
    assert len(read.guesses) == len(guesses)
    assert all(found.startswith(guess) for found, guess in zip(read.guesses, guesses, strict=True))
    assert {joint.drive.kind for joint in read.joints} == {"position"}
    if model.nkey:
        np.testing.assert_array_equal(read.qpos, model.key_qpos[0])


@pytest.mark.parametrize(
    ("name", "error", "line"),
    [
        ("unitree_go1/go1.xml", NoArmError, "body 'trunk' moves freely, so the robot has no fixed base"),
        ("bitcraze_crazyflie_2/cf2.xml", NoArmError, "body 'cf2' moves freely, so the robot has no fixed base"),
        ("robotiq_2f85/2f85.xml", NoArmError, "no hinge or slide joint has an actuator of its own"),
        ("franka_emika_panda/hand.xml", NoArmError, "no hinge or slide joint has an actuator of its own"),
        (
            "aloha/aloha.xml",
            OptionError,
            "several arms of 6 joints, which end at left/gripper_link, right/gripper_link",
        ),
    ],
)
def test_published_robots_without_one_arm_say_so(name, error, line):
    published.load(name)
    with pytest.raises(error, match=line):
        read_arm(load_robot(str(published.FOLDER / name)))


def test_one_of_two_arms_is_chosen_by_its_site():
    published.load("aloha/aloha.xml")
    read = read_arm(load_robot(str(published.FOLDER / "aloha/aloha.xml")), "right/gripper")
    assert read.joints[0].name == "right/waist"
    assert len(read.joints) == 6
