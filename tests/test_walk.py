"""Walking: what is read of a legged robot, body-frame quantities, rewards, falls, commands, and C MuJoCo's motion."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from robot_files import jit, start, write
from scipy.spatial.transform import Rotation

import envs
from envs.base import ASSETS
from envs.options import OptionError
from envs.physics import candidate_pairs, compile_model, load_spec
from envs.robots.legs import LegOptions, read_legs
from envs.robots.quaternions import find_down, rotate_back, turn_about_z
from envs.robots.sources import load_robot

LEG = """<body name="{name}" pos="{x} {y} 0"><joint name="{name}" axis="0 1 0" range="-1 1" armature="0.01"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.015" mass="0.2"/>
  <geom name="{name}_foot" type="sphere" pos="0 0 -0.2" size="0.03" mass="0.05"/></body>"""
LEGS = "".join(LEG.format(name=name, x=x, y=y) for name, x, y in
               [("fr", 0.2, -0.1), ("fl", 0.2, 0.1), ("rr", -0.2, -0.1), ("rl", -0.2, 0.1)])  # fmt: skip
SERVO = """<position name="{name}" joint="{name}" kp="{kp}" kv="1" forcerange="-20 20"/>"""
MOTOR = """<motor name="{name}" joint="{name}" gear="2" ctrlrange="-8 8"/>"""
# A box on four legs with a joint each, whose floor is at 0; in the keyframe the legs hang straight down.
ROBOT = """<mujoco model="table"><compiler angle="radian" autolimits="true"/>
  <option timestep="0.005" integrator="implicitfast"/><worldbody>{floor}<body name="box" pos="0 0 0.23"><freejoint/>
    <geom name="box" type="box" size="0.25 0.12 0.05" mass="3"/>{legs}</body></worldbody>
  <actuator>{actuators}</actuator>{keys}</mujoco>"""
FLOOR = """<geom name="floor" type="plane" size="0 0 1" condim="3"/>"""
KEYS = """<keyframe><key name="home" qpos="0 0 0.23 1 0 0 0 0.1 0.1 -0.1 -0.1" ctrl="0.1 0.1 -0.1 -0.1"/></keyframe>"""
NAMES = ("fr", "fl", "rr", "rl")


def describe_robot(floor=FLOOR, actuator=SERVO, keys=KEYS, legs=LEGS, kp=40):
    actuators = "".join(actuator.format(name=name, kp=kp) for name in NAMES)
    return ROBOT.format(floor=floor, legs=legs, actuators=actuators, keys=keys)


def make(robot=describe_robot(), **options):
    return _make(robot, tuple((name, tuple(x) if isinstance(x, list) else x) for name, x in sorted(options.items())))


@functools.cache
def _make(robot, pairs):
    options = {name: list(x) if isinstance(x, tuple) else x for name, x in pairs}
    return envs.make("walk", **{"robot": write(robot), "physics": "mujoco", **options})


def put(state, **fields):
    """The state with some of its motion changed."""
    arrays = {name: jnp.asarray(value, jnp.float32) for name, value in fields.items()}
    return state.replace(pipeline_state=state.pipeline_state.replace(**arrays))


def draw_state(env, seed):
    """A state in which the robot is anywhere, turned anyhow and moves somehow."""
    random = np.random.default_rng(seed)
    turn = random.normal(size=4)
    qpos = np.concatenate([random.normal(size=3), turn / np.linalg.norm(turn), random.uniform(-1, 1, 4)])
    return put(start(env, seed), qpos=qpos, qvel=random.normal(size=10))


def as_rotation(quaternion):
    w, x, y, z = np.asarray(quaternion, float)
    return Rotation.from_quat([x, y, z, w])


# --- quantities of the base -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_quaternions_are_rotations(seed):
    """R^T v, R^T (0, 0, -1) and a turn about the world's z axis, by scipy in float64."""
    random = np.random.default_rng(seed)
    quaternion, vector, angle = random.normal(size=4), random.normal(size=3), random.uniform(-3, 3)
    quaternion /= np.linalg.norm(quaternion)
    rotation = as_rotation(quaternion)
    back, down = rotate_back(jnp.asarray(quaternion), jnp.asarray(vector)), find_down(jnp.asarray(quaternion))
    np.testing.assert_allclose(back, rotation.inv().apply(vector), atol=2e-6)
    np.testing.assert_allclose(down, rotation.inv().apply([0, 0, -1]), atol=1e-6)
    turned = as_rotation(turn_about_z(jnp.asarray(angle), jnp.asarray(quaternion)))
    expected = Rotation.from_rotvec([0, 0, angle]) * rotation
    np.testing.assert_allclose(turned.as_matrix(), expected.as_matrix(), atol=2e-6)


@pytest.mark.parametrize("seed", range(5))
def test_motion_of_the_base_is_mujocos(seed):
    """mj_objectVelocity in the frame of the body is (angular velocity, velocity of its origin)."""
    env = make()
    state = draw_state(env, seed).pipeline_state
    data = mujoco.MjData(env.model)
    data.qpos[:], data.qvel[:] = state.qpos, state.qvel
    mujoco.mj_forward(env.model, data)
    body, velocity = env.model.body("box").id, np.zeros(6)
    mujoco.mj_objectVelocity(env.model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 1)
    motion = env.find_motion(state)
    np.testing.assert_allclose(np.concatenate([motion.turning, motion.velocity]), velocity, atol=3e-6)
    np.testing.assert_allclose(motion.down, data.xmat[body].reshape(3, 3).T @ [0, 0, -1], atol=1e-6)


def test_observations_are_what_their_names_say():
    env = make()
    state = draw_state(env, 3)
    after = jit(env, "step")(state, np.array([0.3, -2.0, 0.1, 0.5], np.float32))
    named = dict(zip(env.interface.observations, np.asarray(after.obs, float), strict=True))
    inner, motion = after.pipeline_state, env.find_motion(after.pipeline_state)
    for i, axis in enumerate("xyz"):
        assert named[f"velocity {axis} [m/s]"] == pytest.approx(float(motion.velocity[i]))
        assert named[f"angular velocity {axis} [rad/s]"] == pytest.approx(float(motion.turning[i]))
        assert named[f"direction of gravity {axis}"] == pytest.approx(float(motion.down[i]))
    for i, (name, stand, last) in enumerate(
        zip(NAMES, [0.1, 0.1, -0.1, -0.1], np.float32([0.3, -1, 0.1, 0.5]), strict=True)
    ):
        assert named[f"{name} - stand [rad]"] == pytest.approx(float(inner.qpos[7 + i]) - stand, abs=1e-6)
        assert named[f"{name}' [rad/s]"] == pytest.approx(float(inner.qvel[6 + i]))
        assert named[f"last set-point of {name} / limit"] == last
    command = [named[name] for name in list(named)[-3:]]
    np.testing.assert_array_equal(command, inner.commands[0])


def test_every_number_has_a_name():
    for options in ({}, {"observe_velocity": False, "commands": 3}):
        env = make(**options)
        names, commands, limits = env.interface
        assert len(names) == len(set(names)) == env.observation_size == start(env).obs.size
        assert len(commands) == len(limits) == env.action_size == 4
    assert not any(name.startswith("velocity") for name in names)


# --- rewards and metrics ----------------------------------------------------------------------------------------------

WEIGHTS = {"sigma": 0.3, "sigma_turn": 0.6, "lambda_turn": 0.4, "lambda_bounce": 0.7, "lambda_sway": 0.03}
WEIGHTS |= {"lambda_tilt": 1.1, "lambda_torque": 1e-3, "lambda_rate": 0.05, "lambda_pose": 0.2, "lambda_limit": 0.8}
WEIGHTS |= {"limit_margin": 1.2, "lambda_slip": 0.3, "clearance": 0.1, "lambda_air": 2.0, "air_time": 0.3}
WEIGHTS |= {"lambda_fall": 3.0}


def locate_feet(model, qpos):
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return np.array([data.geom(f"{name}_foot").xpos for name in NAMES])


@pytest.mark.parametrize("height", [0.3, 0.24, 0.22, 0.02])
def test_reward_is_the_modules_equation(height):
    """In float64, with a weight for every term: in the air, when two feet land, and in a fall."""
    env, actions = make(**WEIGHTS), np.array([[0.5, -1, 0.2, 0.4], [-0.5, 0.3, 2.0, 0.1]], np.float32)
    state = jit(env, "step")(start(env), actions[0])
    qpos = np.concatenate([[0, 0, height], np.asarray(state.pipeline_state.qpos[3:])])
    qpos[3:7] = Rotation.from_euler("yx", [0.15, 0.05]).as_quat()[[3, 0, 1, 2]]
    state = put(state, qpos=qpos, qvel=np.random.default_rng(0).normal(size=10) * 0.5 - np.eye(10)[2])
    feet = locate_feet(env.model, qpos)
    record = dataclasses.replace(state.pipeline_state.record, feet=jnp.asarray(feet, jnp.float32),
                                 air=jnp.array([0.1, 0.2, 0.25, 0.4]))  # fmt: skip
    state = state.replace(pipeline_state=state.pipeline_state.replace(record=record))
    after = jit(env, "step")(state, actions[1])
    expected = _find_reward(env, state.pipeline_state, after, actions, feet)
    np.testing.assert_allclose(after.reward, expected, rtol=2e-4, atol=2e-5)
    assert bool(after.done) == (height == 0.02)


def _find_reward(env, before, after, actions, feet):
    """The equation in the module's docstring, with scipy's rotations and C MuJoCo's torques of the last substep."""
    qpos, qvel = np.asarray(after.pipeline_state.qpos, float), np.asarray(after.pipeline_state.qvel, float)
    command, back = np.asarray(before.commands[0], float), as_rotation(qpos[3:7]).inv()
    v, w, g = back.apply(qvel[:3]), qvel[3:6], back.apply([0, 0, -1])
    data = mujoco.MjData(env.model)
    data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = before.qpos, before.qvel, before.qacc_warmstart
    clipped = np.clip(np.asarray(actions, float), -1, 1)
    data.ctrl[:] = np.array([0.1, 0.1, -0.1, -0.1]) + 0.5 * clipped[1]
    for _ in range(4):
        mujoco.mj_step(env.model, data)
    reward = np.exp(-np.sum((v - command)[:2] ** 2) / 0.3) + 0.4 * np.exp(-((w[2] - command[2]) ** 2) / 0.6)
    reward -= 0.7 * v[2] ** 2 + 0.03 * (w[0] ** 2 + w[1] ** 2) + 1.1 * np.sum((g - [0, 0, -1]) ** 2)
    reward -= 1e-3 * np.sum(data.qfrc_actuator**2) + 0.05 * np.sum((clipped[1] - clipped[0]) ** 2)
    q = qpos[7:]
    reward -= 0.2 * np.sum((q - [0.1, 0.1, -0.1, -0.1]) ** 2)
    reward -= 0.8 * np.sum(np.maximum(0, np.maximum(-1 + 1.2 - q, q - 1 + 1.2)) ** 2)
    now = locate_feet(env.model, qpos)
    speed, h = np.sum((now - feet)[:, :2] ** 2, 1) / 0.02**2, now[:, 2] - 0.03
    reward -= 0.3 * np.sum(speed * np.maximum(0, 1 - h / 0.1) ** 2)
    air = np.array([0.1, 0.2, 0.25, 0.4])
    reward -= 2 * np.sum(np.where(h < 0.005, (0.3 - air).clip(0), (air + 0.02 - 0.3).clip(0, 0.3)))
    return reward - 3 * bool(after.done)


def test_feet_of_the_robot_stand_on_the_ground_at_the_start():
    """The lowest foot touches, whatever the joints; and the base is turned anywhere, uniformly."""
    env = make()
    states = [start(env, seed).pipeline_state for seed in range(60)]
    for state in states:
        heights = locate_feet(env.model, np.asarray(state.qpos, float))[:, 2] - 0.03
        assert heights.min() == pytest.approx(0, abs=1e-6)
        assert np.abs(np.asarray(state.qpos[7:]) - [0.1, 0.1, -0.1, -0.1]).max() <= 0.1 + 1e-6
    turns = np.array([as_rotation(state.qpos[3:7]).as_euler("xyz") for state in states])
    np.testing.assert_allclose(turns[:, :2], 0, atol=1e-6)
    assert np.abs(np.exp(1j * turns[:, 2]).mean()) < 4 / np.sqrt(60)


@pytest.mark.parametrize(("tilt", "height", "fallen"), [(0.0, 0.23, 0), (0.6, 0.3, 0), (0.8, 0.3, 1), (0.0, 0.12, 1)])
def test_a_fall_is_low_or_tilted(tilt, height, fallen):
    """0.7 rad, whatever the heading and the axis; 0.6 times the height of 0.23 m at which the robot stands."""
    env = make()
    for heading, axis in [(0.0, 0.0), (1.0, 2.0), (-2.0, -1.0)]:
        rotation = Rotation.from_euler("z", heading) * Rotation.from_rotvec(tilt * np.array([np.cos(axis), np.sin(axis), 0]))  # fmt: skip # noqa: E501
        qpos = np.concatenate([[0, 0, height], rotation.as_quat()[[3, 0, 1, 2]], np.zeros(4)])
        assert bool(env.has_fallen(put(start(env), qpos=qpos).pipeline_state)) == fallen


def ride(env, command, speed, steps):
    """The robot slides with a velocity in its frame that is set before each step; returns metrics and velocities."""
    state, metrics, motions = start(env), [], []
    state = put(state, commands=np.tile(command, (env.config.commands, 1)))
    for number in range(steps):
        qpos = np.array(env.robot.qpos)
        qpos[2] += 1.0
        state = put(state, qpos=qpos, qvel=np.concatenate([speed(number), np.zeros(8)]))
        state = jit(env, "step")(state, np.zeros(4, np.float32))
        motions.append(np.asarray(env.find_motion(state.pipeline_state).velocity, float))
        metrics.append({name: float(value) for name, value in state.metrics.items()})
    return metrics, np.array(motions)


def test_errors_are_means_over_the_second_half_and_success_of_the_last_seconds():
    """150 steps of 20 ms: the error counts from the 76th step on, success is that of steps 51 to 150."""
    env = make(episode_length=150)
    metrics, motions = ride(env, [0.5, 0.1, 0.0], lambda number: [0.5 if number > 90 else 0.3, 0.1], 150)
    errors = np.linalg.norm(motions[:, :2] - [0.5, 0.1], axis=1)
    assert metrics[-1]["velocity_error"] == pytest.approx(errors[75:].mean(), rel=1e-4)
    assert metrics[74]["velocity_error"] == 0
    assert errors[50:].mean() < 0.15 < errors[75:90].mean()
    assert [x["success"] for x in metrics] == [0.0] * 149 + [1.0]
    metrics, motions = ride(env, [0.5, 0.1, 0.0], lambda number: [0.3, 0.1], 150)
    assert np.linalg.norm(motions[50:, :2] - [0.5, 0.1], axis=1).mean() > 0.15
    assert metrics[-1]["success"] == 0


def test_means_of_an_episode():
    """Torque, power, jerk and height, by C MuJoCo in float64."""
    env = make(episode_length=10)
    actions = np.random.default_rng(0).uniform(-1, 1, (10, 4)).astype(np.float32)
    state, torques, powers, heights = start(env), [], [], []
    data = mujoco.MjData(env.model)
    data.qpos[:] = state.pipeline_state.qpos
    for action in actions:
        state = jit(env, "step")(state, action)
        data.ctrl[:] = np.array([0.1, 0.1, -0.1, -0.1]) + 0.5 * action
        for _ in range(4):
            mujoco.mj_step(env.model, data)
        torques.append(np.abs(data.qfrc_actuator[6:]).mean())
        powers.append(np.abs(data.qfrc_actuator[6:] * data.qvel[6:]).sum())
        heights.append(data.qpos[2])
    padded = np.concatenate([np.zeros((2, 4)), actions.astype(float)])
    jerk = np.mean((padded[2:] - 2 * padded[1:-1] + padded[:-2]) ** 2)
    expected = {"torque": np.mean(torques), "power": np.mean(powers), "height": np.mean(heights[5:]), "jerk": jerk}
    for name, value in expected.items():
        assert float(state.metrics[name]) == pytest.approx(value, rel=1e-3), name


# --- commands ---------------------------------------------------------------------------------------------------------


def test_commands_are_uniform_or_to_stand():
    """A share of 0.25 stands; means and variances of 4,000 others, within 5 standard errors."""
    env = make(forward=[-0.2, 1.0], left=[0.0, 0.3], turn=[-1.5, 0.5], stand=0.25)
    draw = jax.jit(jax.vmap(lambda key: env.reset(key).pipeline_state.commands[0]))
    commands = np.asarray(draw(jax.random.split(jax.random.key(0), 4000)), float)
    stands = (commands == 0).all(1)
    assert stands.mean() == pytest.approx(0.25, abs=5 * np.sqrt(0.25 * 0.75 / 4000))
    low, high = np.array([-0.2, 0.0, -1.5]), np.array([1.0, 0.3, 0.5])
    unit = (commands[~stands] - low) / (high - low)
    assert ((unit >= 0) & (unit <= 1)).all()
    np.testing.assert_allclose(unit.mean(0), 0.5, atol=5 * np.sqrt(1 / 12 / len(unit)))
    np.testing.assert_allclose(unit.var(0), 1 / 12, atol=5 * np.sqrt(1 / 180 / len(unit)))


def test_each_command_has_its_part_of_the_episode():
    """Three commands in 30 steps: the policy sees the next one after ten, and the last one for ever."""
    env = make(commands=3, episode_length=30, lambda_fall=0.0)
    state = start(env)
    commands, seen = np.asarray(state.pipeline_state.commands), [np.asarray(state.obs[-3:])]
    for _ in range(35):
        state = jit(env, "step")(state, np.zeros(4, np.float32))
        seen.append(np.asarray(state.obs[-3:]))
    np.testing.assert_array_equal(seen, commands[np.minimum(np.arange(36) // 10, 2)])


# --- robots -----------------------------------------------------------------------------------------------------------


def test_c_mujoco_steps_the_same_episode():
    """Fifteen steps under small random actions, by the equations and by C MuJoCo.

    The feet begin 1 mm in the ground: where they only just touch, rounding decides whether there is a contact.
    """
    ours, theirs = make(physics="scalar", start_spread=0.0), make(start_spread=0.0)
    states = [start(ours), start(theirs)]
    states = [put(state, qpos=state.pipeline_state.qpos.at[2].add(-0.001)) for state in states]
    actions = np.random.default_rng(1).uniform(-0.1, 0.1, (15, 4)).astype(np.float32)
    for action in actions:
        states = [jit(env, "step")(state, action) for env, state in zip((ours, theirs), states, strict=True)]
        np.testing.assert_allclose(states[0].reward, states[1].reward, atol=1e-4)
    np.testing.assert_allclose(states[0].obs, states[1].obs, atol=2e-3)
    assert not states[0].done


def test_the_quadruped_is_read():
    robot = read_legs(load_robot("quadruped", ("quadruped",)))
    assert (robot.name, robot.base, robot.base_qpos, robot.base_dof) == ("quadruped", "trunk", 0, 0)
    assert [joint.name for joint in robot.joints] == [
        f"{leg}_{joint}" for leg in NAMES for joint in ("abduction", "hip", "knee")
    ]
    assert robot.feet == tuple(f"foot of {leg}_calf" for leg in NAMES)
    np.testing.assert_allclose(robot.foot_heights, 0.02, atol=1e-9)
    np.testing.assert_allclose(robot.height, 0.2848, atol=1e-4)
    np.testing.assert_allclose(robot.set_points, compile_model(load_spec(ASSETS / "quadruped.xml")).key_ctrl[0])


def test_only_feet_touch_the_ground_unless_all_shall():
    """The spheres at the ends of the legs; with contacts=all legs and box too."""
    for contacts, expected in [("feet", {f"{name}_foot" for name in NAMES}), ("all", None)]:
        robot = read_legs(load_robot(write(describe_robot())), LegOptions(contacts=contacts))
        model = robot.model
        colliding = {i for i in range(model.ngeom) if model.geom_contype[i] and model.geom_bodyid[i]}
        if expected is None:
            assert len(colliding) == 9
        else:
            assert {model.geom(i).name for i in colliding} == expected
            assert model.geom("floor").conaffinity == 1
            assert model.geom("floor").contype == 0


def test_a_floor_is_added_and_the_robot_put_on_it():
    """A keyframe 10 cm too high, without a floor: the lowest foot is on z = 0, and feet collide with it."""
    robot = read_legs(load_robot(write(describe_robot(floor="", keys=KEYS.replace("0.23", "0.33")))))
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.qpos
    mujoco.mj_forward(robot.model, data)
    lowest = min(data.geom(f"{name}_foot").xpos[2] for name in NAMES) - 0.03
    assert lowest == pytest.approx(0, abs=1e-9)
    assert robot.height == pytest.approx(0.03 + 0.2 * np.cos(0.1))
    pairs = {tuple(sorted(robot.model.geom(g).name for g in (x.geom1, x.geom2))) for x in candidate_pairs(robot.model)}
    assert pairs == {("", f"{name}_foot") for name in NAMES}


def test_motors_become_servos():
    """Of a torque of 16 N m: 16 N m/rad and 0.32 N m s/rad through a gear of 2, and no more torque than before."""
    for options, kp, kv in [(LegOptions(), 16, 0.32), (LegOptions(stiffness=30.0, damping=0.7), 30, 0.7)]:
        robot = read_legs(load_robot(write(describe_robot(actuator=MOTOR))), options)
        data = mujoco.MjData(robot.model)
        data.qpos[:], data.qvel[6:] = robot.qpos, [0.0, 0.0, 0.4, 0.4]
        data.ctrl[:] = robot.find_controls(jnp.asarray(robot.set_points + np.array([0.2, 5.0, 0.0, -0.1])))
        mujoco.mj_forward(robot.model, data)
        expected = [0.2 * kp, 16, -0.4 * kv, -0.1 * kp - 0.4 * kv]
        np.testing.assert_allclose(data.qfrc_actuator[6:], expected, rtol=1e-5)


def test_stiffness_of_servos_can_be_changed():
    """Of the servos with 40 N m/rad and 1 N m s/rad, which keep what is not given and their torque limits."""
    robot = read_legs(load_robot(write(describe_robot())), LegOptions(stiffness=25.0))
    for joint in robot.joints:
        assert joint.drive.bias[1:] == (-25, -1)
        assert joint.drive.torque == (-20, 20)


@pytest.mark.parametrize(
    ("robot", "options", "line"),
    [
        ({"keys": ""}, {}, "no keyframe in which the robot stands"),
        ({"keys": KEYS.replace("1 0 0 0", "0 1 0 0").replace("0.23", "0.05")}, {}, "lies on body 'box'"),
        ({"actuator": "<velocity joint='{name}' kv='1'/>"}, {}, "neither a motor nor a position servo"),
        ({"actuator": "<motor joint='{name}'/>"}, {}, "not limited on both sides"),
        (
            {"actuator": "", "keys": KEYS.partition(" ctrl")[0] + "/></keyframe>"},
            {},
            "no hinge or slide has an actuator",
        ),
        ({"legs": LEGS.replace("<geom ", "<geom contype='0' conaffinity='0' ")}, {}, "lies on body 'box'"),
        ({}, {"forward": [1.0, -1.0]}, "env.forward=[1.0, -1.0]: expected the lowest and the highest"),
        ({}, {"turn": [1.0]}, "env.turn=[1.0]: expected"),
        ({}, {"robot": "quadrupet"}, "did you mean 'quadruped'"),
        ({}, {"robot": str(ASSETS / "panda.xml")}, "no body moves freely"),
    ],
    ids=str,
)
def test_mistakes_are_one_line(robot, options, line):
    with pytest.raises(OptionError) as caught:
        envs.make("walk", **{"robot": write(describe_robot(**robot)), "physics": "mujoco", **options})
    assert len(caught.value.problems) == 1
    assert line in caught.value.problems[0]
    assert "\n" not in caught.value.problems[0]
