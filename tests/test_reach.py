"""Reaching with any arm: goals, errors, rewards, what an episode remembers, and the way through C MuJoCo."""

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
from envs.options import OptionError
from envs.reach import Errors, ReachConfig, draw_directions, find_turn, move_goal
from envs.robots import CONTROLS, load_robot
from envs.robots.arms import find_path, read_arm
from envs.robots.goals import draw_poses, find_goal_ranges

LINK = """<body pos="{at} 0 0"><joint name="{name}" axis="{axis}" range="-2.5 2.5" limited="true" damping="0.2"/>
  <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.5" contype="0" conaffinity="0"/>{rest}</body>"""
# Three links with motors, which rest half bent.
ARM = f"""<mujoco model="three"><compiler angle="radian"/><option timestep="0.005"/><worldbody><body pos="0 0 0.5">
  {
    LINK.format(
        at=0,
        name="turn",
        axis="0 0 1",
        rest=LINK.format(
            at=0.3,
            name="bend",
            axis="0 1 0",
            rest=LINK.format(at=0.3, name="twist", axis="1 0 0.5", rest='<site name="tip" pos="0.3 0 0"/>'),
        ),
    )
}</body></worldbody>
  <actuator><motor joint="turn" ctrlrange="-5 5"/><motor joint="bend" ctrlrange="-5 5"/>
  <motor joint="twist" ctrlrange="-2 2"/></actuator>
  <keyframe><key name="home" qpos="0.3 -0.4 0.5"/></keyframe></mujoco>"""
# Two hinges and a slide without a keyframe, with a motor, a servo and a velocity servo.
MIXED = """<mujoco model="mixed"><compiler angle="radian"/>
  <option timestep="0.005" integrator="implicitfast"/><worldbody>
  <body pos="0 0 0.5"><joint name="turn" axis="0 0 1" range="-2 2" limited="true" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.5" contype="0" conaffinity="0"/>
    <body pos="0.3 0 0"><joint name="bend" axis="0 0 1" range="-2 2" limited="true" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.3" contype="0" conaffinity="0"/>
      <body pos="0.3 0 0"><joint name="lift" type="slide" axis="0 0 1" range="-0.2 0.2" limited="true" damping="1"/>
        <geom type="sphere" size="0.03" mass="0.1" contype="0" conaffinity="0"/><site name="tip"/></body></body></body>
  </worldbody><actuator><motor joint="turn" ctrlrange="-5 5"/><position joint="bend" kp="40" kv="2"/>
  <velocity joint="lift" kv="50" ctrlrange="-0.3 0.3"/></actuator></mujoco>"""


BOX = (0.3, -0.2, 0.4, 0.5, 0.2, 0.6)


@functools.cache
def make(**options):
    return envs.make("reach", **{"robot": write(ARM), **options})


def test_error_is_from_mujocos_site_to_the_goal():
    """X_g - x(q), and R_g R(q)' by scipy, in 30 states."""
    env, data = make(goal="pose"), mujoco.MjData(make(goal="pose").model)
    find_errors = jit(env, "find_errors")
    for seed in range(30):
        state = start(env, seed).pipeline_state
        data.qpos[:] = np.asarray(state.qpos, float)
        mujoco.mj_kinematics(env.model, data)
        site, errors = data.site(env.arm.site), find_errors(state)
        np.testing.assert_allclose(errors.position, np.asarray(state.goals[0], float) - site.xpos, atol=2e-6)
        left = Rotation.from_matrix(np.asarray(state.rotations[0], float) @ site.xmat.reshape(3, 3).T)
        np.testing.assert_allclose(errors.angle, left.magnitude(), atol=2e-5)


@pytest.mark.parametrize("angle", [0.0, 1e-3, 0.7, 2.0, 3.1])
def test_turn_is_axis_and_angle(angle):
    axis = np.array([0.6, 0.0, -0.8])
    rotation = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    goal = Rotation.from_rotvec(angle * axis).as_matrix() @ rotation
    turn, cosine = find_turn(jnp.asarray(goal), jnp.asarray(rotation))
    np.testing.assert_allclose(turn, np.sin(angle) * axis, atol=1e-6)
    np.testing.assert_allclose(Errors(jnp.zeros(3), turn, cosine).angle, angle, atol=2e-6)


def test_directions_are_perpendicular_and_of_length_one():
    """E e' = I, and the mean of 4,000 first directions is 0 within 4 standard errors of 1 / sqrt(3 n)."""
    pairs = np.asarray(jax.vmap(draw_directions)(jax.random.split(jax.random.key(0), 4000)), float)
    np.testing.assert_allclose(pairs @ pairs.transpose(0, 2, 1), np.broadcast_to(np.eye(2), (4000, 2, 2)), atol=1e-5)
    assert np.abs(pairs[:, 0].mean(0)).max() < 4 / np.sqrt(3 * 4000)


@pytest.mark.parametrize("motion", ["line", "circle"])
def test_velocity_of_a_goal_is_the_derivative_of_its_position(motion):
    """By central differences over the time step, and |x_g'| <= motion_speed; a circle has it always."""
    config = ReachConfig(motion=motion, motion_speed=0.2, motion_size=0.05)
    state = start(make(motion=motion)).pipeline_state

    def at(steps):
        record = dataclasses.replace(state.record, steps=jnp.float32(steps))
        return [np.asarray(x, float) for x in move_goal(dataclasses.replace(state, record=record), config)]

    speeds = []
    for steps in (0, 3, 17, 40):
        numeric = (at(steps + 0.05)[0] - at(steps - 0.05)[0]) / (0.1 * config.dt)
        np.testing.assert_allclose(at(steps)[1], numeric, atol=2e-3)
        speeds.append(np.linalg.norm(at(steps)[1]))
    assert max(speeds) < 0.2 + 1e-6
    np.testing.assert_allclose(at(0)[0], 0, atol=1e-6)
    if motion == "circle":
        np.testing.assert_allclose(speeds, 0.2, rtol=1e-5)


OPTIONS = {"lambda_pos": 2.0, "lambda_angle": 0.3, "lambda_torque": 1e-4, "lambda_velocity": 0.01, "lambda_rate": 0.05}
OPTIONS |= {"lambda_limit": 0.5, "limit_margin": 3.0, "goal": "pose", "control": "torque"}


@pytest.mark.parametrize("reward", ["lesson", "precise"])
def test_reward_is_the_modules_equation(reward):
    """In float64, of the state before the step, after two steps; every term has a weight."""
    env = make(reward=reward, **OPTIONS)
    step = jit(env, "step")
    first, second = np.array([[0.5, -1, 0.2], [-0.5, 0.3, 2.0]], np.float32)
    state = step(start(env), first)
    before = state.pipeline_state
    errors, (low, high) = env.find_errors(before), env.arm.ranges
    d, theta, q = float(errors.distance), float(errors.angle), np.asarray(before.qpos, float)
    pull = lambda x: x + 0.1 * np.log(1 + x / 0.01)  # noqa: E731
    cost = 2 * d**2 + 0.3 * theta**2 if reward == "lesson" else 2 * (d**2 + pull(d)) + 0.3 * pull(theta)
    torque = env.control.limits * np.clip(second, -1, 1)
    near = np.maximum(0, np.maximum(low + 3 - q, q - high + 3))
    cost += 1e-4 * np.sum(torque**2) + 0.01 * np.sum(np.asarray(before.qvel, float) ** 2)
    cost += 0.05 * np.sum((np.clip(second, -1, 1) - first) ** 2) + 0.5 * np.sum(near**2)
    np.testing.assert_allclose(step(state, second).reward, -cost, rtol=2e-5)


def hold(env, state, steps):
    """The robot stays where it is, with the goal there."""
    step, metrics = jit(env, "step"), []
    for _ in range(steps):
        state = step(state, np.zeros(env.action_size, np.float32))
        metrics.append({name: float(value) for name, value in state.metrics.items()})
    return state, metrics


def put_goals(env, state, shifts):
    place = np.asarray(env.place(state.pipeline_state.qpos)[0])
    goals = jnp.asarray(place + np.asarray(shifts)[:, None] * np.array([0, 0, 1]), jnp.float32)
    return state.replace(pipeline_state=state.pipeline_state.replace(goals=goals))


def test_success_is_holding_the_goal():
    """0.2 s are ten steps of 20 ms: success from the tenth on, not in the ninth; never with a goal 6 cm away."""
    env = make()
    _, metrics = hold(env, put_goals(env, start(env), [0.04]), 12)
    assert [x["success"] for x in metrics] == [0.0] * 9 + [1.0] * 3
    assert metrics[-1]["held"] == pytest.approx(0.24)
    _, metrics = hold(env, put_goals(env, start(env), [0.06]), 12)
    assert {x["success"] for x in metrics} == {0.0}


def test_each_goal_has_its_part_of_the_episode():
    """Three goals of 20 steps: all within reach is success, the second too far away is not."""
    env = make(goals=3, episode_length=60)
    _, metrics = hold(env, put_goals(env, start(env), [0.01, 0.02, 0.03]), 60)
    assert metrics[-1]["success"] == 1
    assert metrics[-1]["reached"] == 3
    np.testing.assert_allclose(
        [metrics[i]["distance"] for i in (0, 18, 19, 38, 39, 59)], [0.01, 0.01, 0.02, 0.02, 0.03, 0.03], atol=1e-4
    )
    assert metrics[19]["held"] == pytest.approx(0.02), "what was held before counts for the goal before"
    _, metrics = hold(env, put_goals(env, start(env), [0.01, 0.2, 0.03]), 60)
    assert metrics[-1]["success"] == 0
    assert metrics[-1]["reached"] == 2


def test_jerk_and_violation():
    """Mean over steps and commands of (a - 2 a' + a'')^2 with 0 before the start; the largest excess of a joint."""
    env = make()
    actions = np.random.default_rng(0).uniform(-1, 1, (4, 3)).astype(np.float32)
    state = start(env)
    qpos = np.asarray(state.pipeline_state.qpos).copy()
    qpos[1] = env.arm.ranges[1][1] + 0.3
    state = state.replace(pipeline_state=state.pipeline_state.replace(qpos=jnp.asarray(qpos)))
    excess = []
    for action in actions:
        state = jit(env, "step")(state, action)
        excess.append(float(np.asarray(state.pipeline_state.qpos, float)[1] - env.arm.ranges[1][1]))
    padded = np.concatenate([np.zeros((2, 3)), actions.astype(float)])
    expected = np.mean((padded[2:] - 2 * padded[1:-1] + padded[:-2]) ** 2)
    assert float(state.metrics["jerk"]) == pytest.approx(expected, rel=1e-5)
    assert float(state.metrics["limit_violation"]) == pytest.approx(max(excess), abs=1e-5)
    assert max(excess) > 0.01


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize(
    "options", [{}, {"goal": "pose", "lambda_rate": 0.1}, {"motion": "circle", "goals": 2}], ids=str
)
def test_every_number_has_a_name(control, options):
    env = make(control=control, **options)
    names, commands, limits = env.interface
    assert len(names) == len(set(names)) == env.observation_size == start(env).obs.size
    assert len(commands) == len(limits) == env.action_size


def test_any_kind_of_joint_and_actuator():
    """Hinges and a slide with a motor, a servo and a velocity servo keep the commanded velocities within 3 %."""
    env = make(robot=write(MIXED), speed=0.2)
    assert env.interface.commands == ("turn velocity [rad/s]", "bend velocity [rad/s]", "lift velocity [m/s]")
    state, step, places = start(env), jit(env, "step"), []
    for _ in range(40):
        state = step(state, np.array([1.0, -1.0, 0.5], np.float32))
        places.append(np.asarray(state.pipeline_state.qpos))
    np.testing.assert_allclose((places[-1] - places[19]) / 20 / env.dt, [0.2, -0.2, 0.1], rtol=0.03)


@pytest.mark.parametrize("control", ["velocity", "torque", "twist"])
def test_c_mujoco_steps_the_same_episode(control):
    """Twenty steps under random actions, by the equations and by C MuJoCo: observations and rewards agree."""
    ours, theirs = make(control=control), make(control=control, physics="mujoco")
    states = [start(ours), start(theirs)]
    actions = np.random.default_rng(1).uniform(-1, 1, (20, ours.action_size)).astype(np.float32)
    for action in actions:
        states = [jit(env, "step")(state, action) for env, state in zip((ours, theirs), states, strict=True)]
    np.testing.assert_allclose(states[0].obs, states[1].obs, atol=3e-4)
    np.testing.assert_allclose(states[0].reward, states[1].reward, atol=1e-4)


def test_goals_are_where_poses_lead():
    """Every goal is within a centimetre of a place of the table's poses moved by the noise: the reachable set."""
    env = make()
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 200))
    goals = np.asarray(state.pipeline_state.goals[:, 0], float)
    poses = draw_poses(env.arm)
    places = np.asarray(jax.vmap(lambda q: env.place(q)[0])(jnp.asarray(poses, jnp.float32)), float)
    nearest = np.linalg.norm(goals[:, None] - places[None], axis=-1).min(1)
    assert nearest.max() < 0.2
    assert goals[:, 2].min() > 0, "above the ground"
    low, high = find_goal_ranges(env.arm)
    assert ((poses >= low) & (poses <= high)).all()


def test_goals_in_a_box():
    """Uniform: mean and variance of 4,000 goals within 5 standard errors; and no poses are drawn."""
    env = make(goal_box=BOX)
    goals = np.asarray(jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 4000)).pipeline_state.goals[:, 0], float)
    low, high = np.array([0.3, -0.2, 0.4]), np.array([0.5, 0.2, 0.6])
    unit = (goals - low) / (high - low)
    assert ((unit >= 0) & (unit <= 1)).all()
    np.testing.assert_allclose(unit.mean(0), 0.5, atol=5 * np.sqrt(1 / 12 / 4000))
    np.testing.assert_allclose(unit.var(0), 1 / 12, atol=5 * np.sqrt(1 / 180 / 4000))
    assert env.poses is None


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"goal_box": [0, 0, 0, 1, 1]}, "expected the lower and the upper corner"),
        ({"goal_box": [0, 0, 0, 1, -1, 1]}, "expected the lower and the upper corner"),
        ({"goal_box": [0, 0, 0, 1, 1, 1], "goal": "pose"}, "leave out goal_box or goal=pose"),
        ({"robot": "pandda"}, "panda"),
        ({"site": "tipp"}, "tip"),
    ],
    ids=str,
)
def test_mistakes_are_one_line(options, line):
    with pytest.raises(OptionError) as caught:
        envs.make("reach", **{"robot": write(ARM), **options})
    assert len(caught.value.problems) == 1
    assert line in caught.value.problems[0]


def test_arm_is_all_joints_that_carry_the_site():
    arm = read_arm(load_robot(write(ARM)))
    body = arm.model.site(arm.site).bodyid[0]
    assert [arm.model.joint(joint).name for joint in find_path(arm.model, body)] == [x.name for x in arm.joints]


@pytest.mark.parametrize("control", CONTROLS)
def test_textbook_controller_reaches(control):
    """Of 32 goals that the pose noise surrounds, most are held; with torques by inverse dynamics as well."""
    env = make(control=control)
    step = jax.jit(jax.vmap(lambda state: env.step(state, env.baseline(state))))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 32))
    for _ in range(150):
        state = step(state)
    assert np.mean(state.metrics["success"]) > 0.7, "a few goals lie behind a joint limit"
    assert np.median(state.metrics["distance"]) < 0.02
