"""Driving to a pose: what is read from a robot, errors, rewards, falls, the textbook's controller, and C MuJoCo."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from robot_files import jit, start, write

import envs
from envs.drive import TEXTBOOK_RETURN, Errors, find_errors, find_square, find_way
from envs.options import OptionError
from envs.robots import load_robot, read_wheels
from envs.robots.wheels import find_twist, find_wheel_speeds, limit_speeds, steer_to_pose

WHEEL = """<body name="{name}" pos="0.05 {y} 0.02"><joint name="{name}" axis="0 {axis} 0" {more}/>
  <geom type="cylinder" size="0.05 0.002" zaxis="0 1 0" mass="0.2"/></body>"""
CASTER = """<body name="caster" pos="-0.15 0 0"><joint name="swivel" axis="0 0 1" damping="0.001"/>
  <geom type="sphere" size="0.02" pos="-0.02 0 -0.01" mass="0.05" condim="1"/></body>"""
RIGHT, LEFT = (WHEEL.format(name=name, y=y, axis=a, more="") for name, y, a in (("r", -0.12, 1), ("l", 0.12, -1)))
BASE = '<geom type="box" size="0.15 0.1 0.02" pos="-0.03 0 0.05" mass="2" contype="0" conaffinity="0"/>'
MOTORS = '<motor joint="r" gear="2" ctrlrange="-1 1"/><motor joint="l" gear="2" ctrlrange="-1 1"/>'


def describe(parts=RIGHT + LEFT + CASTER, free="<freejoint/>", actuators=MOTORS):
    """A robot with motors whose left wheel turns backwards, without a floor and a keyframe."""
    return f"""<mujoco model="cart"><compiler angle="radian"/><option timestep="0.005" integrator="implicitfast"/>
      <worldbody><body name="base" pos="1 2 0.5" euler="0 0 0.7">{free}{BASE}{parts}</body></worldbody>
      <actuator>{actuators}</actuator></mujoco>"""


@functools.cache
def make(**options):
    """By C MuJoCo, which needs no compiling, unless the options say otherwise."""
    return envs.make("drive", **{"physics": "mujoco", **options})


@functools.cache
def jit_batch(env, name):
    return jax.jit(jax.vmap(getattr(env, name)))


def put(state, **values):
    """The state with other values, from NumPy."""
    values = {name: jnp.asarray(value, jnp.float32) for name, value in values.items()}
    return state.replace(pipeline_state=state.pipeline_state.replace(**values))


def shake(env, seed):
    """A state in which everything moves and the robot leans; not one that the physics would reach."""
    random = np.random.default_rng(seed)
    model = env.model
    quaternion = random.normal(size=4) * [1, 0.2, 0.2, 1]
    qpos = np.concatenate([random.uniform(-1, 1, 3), quaternion / np.linalg.norm(quaternion)])
    qpos = np.append(qpos, random.uniform(-3, 3, model.nq - 7))
    goal = [*random.uniform(-1, 1, 2), random.uniform(-np.pi, np.pi)]
    qvel = random.uniform(-1, 1, model.nv)
    return put(start(env, seed), qpos=qpos, qvel=qvel, goal=goal, action=random.uniform(-1, 1, 2))


def wrap(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def measure(env, state, wheels=("left", "right")):
    """Place, heading, lean, velocity and turning by C MuJoCo's kinematics and Jacobians, in float64."""
    data = mujoco.MjData(env.model)
    data.qpos[:], data.qvel[:] = (np.asarray(x, float) for x in (state.qpos, state.qvel))
    mujoco.mj_forward(env.model, data)
    body = env.model.jnt_bodyid[0]
    axes = data.xmat[body].reshape(3, 3) @ env.robot.frame.T
    middle = np.mean([data.joint(name).xanchor for name in wheels], axis=0)
    jacobians = np.zeros((2, 3, env.model.nv))
    mujoco.mj_jac(env.model, data, *jacobians, middle, body)
    velocity, turning = (axes.T @ jacobian @ data.qvel for jacobian in jacobians)
    return middle[:2], np.arctan2(axes[1, 0], axes[0, 0]), axes[2], velocity, turning


# --- observations and rewards -----------------------------------------------------------------------------------------


def test_motion_is_mujocos():
    """Of the middle of the axle, in 20 states with a lean."""
    env = make()
    for seed in range(20):
        state = shake(env, seed).pipeline_state
        for ours, theirs in zip(jit(env, "find_motion")(state), measure(env, state), strict=True):
            np.testing.assert_allclose(ours, theirs, atol=3e-6)


def test_motion_of_a_robot_with_another_frame():
    """The axle 5 cm before the base's origin and 2 cm over it."""
    env = make(robot=write(describe()))
    for seed in range(10):
        state = shake(env, seed).pipeline_state
        for ours, theirs in zip(jit(env, "find_motion")(state), measure(env, state, ("l", "r")), strict=True):
            np.testing.assert_allclose(ours, theirs, atol=3e-6)


def test_observation_is_in_the_robots_frame():
    """Each number by its name, in float64."""
    env = make(lambda_rate=0.1)
    for seed in range(10):
        shaken = shake(env, seed)
        state = shaken.pipeline_state
        place, heading, lean, velocity, turning = measure(env, state)
        goal = np.asarray(state.goal, float)
        (x, y), angle = goal[:2] - place, wrap(goal[2] - heading)
        ahead, left = x * np.cos(heading) + y * np.sin(heading), y * np.cos(heading) - x * np.sin(heading)
        distance = np.hypot(x, y)
        expected = {"distance [m]": distance, "goal ahead [m]": ahead, "goal to the left [m]": left}
        for scale in (20, 5, 1):
            for way, value in (("ahead", ahead), ("to the left", left)):
                expected[f"goal {way} / (distance + {scale} cm)"] = value / (distance + scale / 100)
        expected |= {"cos(angle)": np.cos(angle), "sin(angle)": np.sin(angle)}
        expected |= {"forward speed [m/s]": velocity[0], "turn speed [rad/s]": turning[2]}
        for i, side in enumerate(("left", "right")):
            expected[f"{side} wheel's speed [rad/s]"] = state.qvel[6 + i]
        expected |= {"lean forwards": lean[0], "lean to the left": lean[1]}
        expected |= {"roll speed [rad/s]": turning[0], "pitch speed [rad/s]": turning[1]}
        for i, side in enumerate(("left", "right")):
            expected[f"last {side} wheel's command / limit"] = state.action[i]
        motion = env.find_motion(state)
        observed = env.observe(state, motion, find_errors(motion, state.goal))
        assert env.interface.observations == tuple(expected)
        np.testing.assert_allclose(observed, list(expected.values()), atol=1e-5)


@pytest.mark.parametrize("control", ["velocity", "torque"])
@pytest.mark.parametrize("options", [{}, {"lambda_rate": 0.1}, {"robot": "cart"}], ids=str)
def test_every_number_has_a_name(control, options):
    robot = {"robot": write(describe())} if "robot" in options else {}
    env = make(control=control, **{**options, **robot})
    names, commands, limits = env.interface
    assert len(names) == len(set(names)) == env.observation_size == start(env).obs.size
    assert len(commands) == len(limits) == env.action_size == 2


def way_left(x, y, angle, weight):
    """The way of the module in plain floats: both manners are tried."""
    distance, ways = np.hypot(x, y), []
    for turned in (0, np.pi):  # the robot's rear ahead, and its heading from the goal's, turned alike, is the same
        bearing = wrap(np.arctan2(y, x) - turned)
        ways.append(abs(bearing) + abs(wrap(angle - bearing)))
    far = distance**2 / (distance**2 + 0.02**2)
    return distance + weight * (far * min(ways) + (1 - far) * abs(angle))


def draw_errors(number, seed=0):
    random = np.random.default_rng(seed)
    return zip(random.uniform(-1, 1, (number, 2)), random.uniform(-np.pi, np.pi, number), strict=True)


def test_way_is_that_of_the_shorter_manner():
    """In 300 states; the same for the mirrored one and for the one that looks backwards."""
    way = jax.jit(lambda position, angle: find_way(Errors(position, angle), 0.3))
    for (x, y), angle in draw_errors(300):
        expected = way_left(x, y, angle, 0.3)
        for position, turned in (([x, y], angle), ([x, -y], -angle), ([-x, y], -angle), ([-x, -y], angle)):
            assert float(way(jnp.array(position), jnp.array(turned))) == pytest.approx(expected, abs=2e-5)


def moves(position, angle, small=1e-3):
    """Errors after the robot has rolled forwards or backwards, or turned left or right, by 1 mm or 0.01 rad."""
    for step in (small, -small):
        yield position - [step, 0], angle
        turn = 10 * step
        rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        yield rotation @ position, wrap(angle - turn)


def find_stuck(cost):
    """The share of 2,000 poses at least 4 cm or 0.1 rad off from which no small move lowers a cost."""
    stuck, poses = 0, [(p, a) for p, a in draw_errors(2000) if np.hypot(*p) > 0.04 or abs(a) > 0.1]
    near = [(0.1 * p, a * 0.3) for p, a in poses if np.hypot(*(0.1 * p)) > 0.04]
    beside = [(np.array([0.0, 0.1]), 0.0), (np.array([0.0, -0.3]), 0.0)]
    for position, angle in [*poses[:500], *near, *beside]:
        now = cost(*position, angle)
        stuck += all(cost(*p, a) > now - 1e-7 for p, a in moves(position, angle))
    return stuck


def test_way_leads_to_the_goal_from_everywhere():
    """No small move lowers the lesson's square beside the goal; the way is lowered everywhere but at the goal."""
    assert find_stuck(lambda x, y, angle: way_left(x, y, angle, 0.1)) == 0
    assert find_stuck(lambda x, y, angle: x**2 + y**2 + 0.1 * angle**2 * 0.04 / (x**2 + y**2 + 0.04)) > 0


WEIGHTS = {"lambda_pos": 2.0, "lambda_angle": 0.3, "lambda_torque": 0.1, "lambda_velocity": 0.01, "lambda_rate": 0.05}


@pytest.mark.parametrize("reward", ["lesson", "precise"])
def test_reward_is_the_modules_equation(reward):
    """In float64, of the state before the step, after two steps; every term has a weight."""
    env = make(reward=reward, control="torque", **WEIGHTS)
    first, second = np.array([[0.5, -1], [-0.5, 2.0]], np.float32)
    state = jit(env, "step")(start(env), first)
    before = state.pipeline_state
    place, heading, *_ = measure(env, before)
    goal = np.asarray(before.goal, float)
    x, y = goal[:2] - place
    turned = np.exp(-1j * heading) * (x + 1j * y)
    angle = wrap(goal[2] - heading)
    if reward == "lesson":
        cost = x**2 + y**2 + 0.3 * angle**2 * 0.04 / (x**2 + y**2 + 0.04)
        square = find_square(Errors(jnp.array([turned.real, turned.imag]), jnp.array(angle)), 0.3)
        assert float(square) == pytest.approx(cost, rel=1e-5)
    else:
        way = way_left(turned.real, turned.imag, angle, 0.3)
        cost = way + 0.1 * np.log(1 + way / 0.05)
    action = np.clip(second, -1, 1).astype(float)
    cost = 2 * cost + 0.1 * np.sum((0.15 * action) ** 2) + 0.05 * np.sum((action - first) ** 2)
    cost += 0.01 * np.sum(np.asarray(before.qvel, float)[6:8] ** 2)
    np.testing.assert_allclose(jit(env, "step")(state, second).reward, -cost, rtol=2e-5)


# --- episodes ---------------------------------------------------------------------------------------------------------


def stay(env, place, angle, steps):
    """Metrics of a robot that stays where it starts, with the goal so far away."""
    state = start(env)
    heading = float(env.find_motion(state.pipeline_state).heading)
    state, metrics = put(state, goal=[place, 0, heading + angle]), []
    for _ in range(steps):
        state = jit(env, "step")(state, np.zeros(2, np.float32))
        metrics.append({name: float(value) for name, value in state.metrics.items()})
    return metrics


def test_success_is_holding_the_pose():
    """0.2 s are four steps of 50 ms: success from the fourth on; never 6 cm or 0.12 rad away."""
    metrics = stay(make(), 0.04, 0.08, 6)
    assert [x["success"] for x in metrics] == [0, 0, 0, 1, 1, 1]
    assert metrics[-1]["held"] == pytest.approx(0.3)
    assert metrics[-1]["distance"] == pytest.approx(0.04, abs=1e-3)
    assert metrics[-1]["angle"] == pytest.approx(0.08, abs=1e-3)
    for place, angle in ((0.06, 0.0), (0.0, 0.12), (0.0, np.pi)):
        assert {x["success"] for x in stay(make(), place, angle, 6)} == {0.0}


def test_leaving_the_pose_ends_success():
    env = make()
    state = start(env)
    state = put(state, goal=[0, 0, float(env.find_motion(state.pipeline_state).heading)])
    successes = []
    for action in [0.0] * 5 + [1.0] * 15 + [-1.0] * 10:
        state = jit(env, "step")(state, np.full(2, action, np.float32))
        successes.append(float(state.metrics["success"]))
    assert successes[4] == 1
    assert successes[19] == 0
    assert float(state.metrics["held"]) < 1


@pytest.mark.parametrize(("lean", "done"), [(0.3, 0), (1.0, 1), (np.pi, 1)])
def test_a_fall_ends_the_episode_and_costs(lean, done):
    """A lean of more than 0.6 rad, also upside down."""
    env = make(lambda_fall=20.0)
    state = start(env)
    qpos = np.array(state.pipeline_state.qpos)
    qpos[2], qpos[3:7] = 0.5, [np.cos(lean / 2), 0, np.sin(lean / 2), 0]  # in the air, so that it keeps its lean
    state = put(state, qpos=qpos)
    after = jit(env, "step")(state, np.zeros(2, np.float32))
    motion = env.find_motion(state.pipeline_state)
    without = env._find_reward(state.pipeline_state, jnp.zeros(2), jnp.zeros(2))
    assert float(after.done) == done
    assert float(motion.lean[2]) == pytest.approx(np.cos(lean), abs=2e-3)  # at rest it leans by 0.001 rad
    assert float(after.reward) == pytest.approx(float(without) - 20 * done, abs=1e-4)


def test_starts_and_goals():
    """Starts over the origin with any heading; goals uniform over the ring's area with any heading, by 5 sigma."""
    env = make(goal_min=0.3, goal_max=0.6)
    states = jit_batch(env, "reset")(jax.random.split(jax.random.key(0), 4000)).pipeline_state
    motion = jax.vmap(env.find_motion)(states)
    np.testing.assert_allclose(motion.place, 0, atol=1e-6)
    np.testing.assert_allclose(motion.lean, np.broadcast_to([0, 0, 1], (4000, 3)), atol=1e-6)
    area = (np.sum(np.asarray(states.goal, float)[:, :2] ** 2, axis=1) - 0.09) / (0.36 - 0.09)
    assert 0 <= area.min() < area.max() <= 1 + 1e-6
    np.testing.assert_allclose(area.mean(), 0.5, atol=5 * np.sqrt(1 / 12 / 4000))
    for angles in (motion.heading, states.goal[:, 2]):
        assert abs(np.mean(np.exp(1j * np.asarray(angles)))) < 5 / np.sqrt(4000)


def test_c_mujoco_steps_the_same_episodes():
    """Twenty steps of 64 episodes under random actions, by the equations and by C MuJoCo.

    The robot tips, and a wheel that lands within float32's rounding of the floor may touch it one substep later. That
    changes an episode for good, so two may differ.
    """
    ours, theirs = make(physics="scalar"), make()
    states = [jit_batch(env, "reset")(jax.random.split(jax.random.key(0), 64)) for env in (ours, theirs)]
    for action in np.random.default_rng(1).uniform(-1, 1, (20, 64, 2)).astype(np.float32):
        states = [jit_batch(env, "step")(state, action) for env, state in zip((ours, theirs), states, strict=True)]
    ours, theirs = (np.column_stack([state.obs, state.reward]) for state in states)
    assert (np.abs(ours - theirs).max(axis=1) > 5e-4).sum() <= 2
    np.testing.assert_allclose(ours, theirs, atol=0.02)


# --- wheels and the textbook's controller -----------------------------------------------------------------------------


@pytest.mark.parametrize("robot", ["drive", "cart"])
@pytest.mark.parametrize("action", [(1, 1), (-0.6, -0.6), (-0.5, 0.5), (0.9, 0.4)])
def test_wheels_move_the_robot_as_their_kinematics_say(robot, action):
    """Within 3 %, after a second of velocity control, forwards along its x axis and to the left by the right wheel."""
    env = make(robot=write(describe()), speed=5.0) if robot == "cart" else make()
    state = start(env)
    for _ in range(20):
        state = jit(env, "step")(state, np.array(action, np.float32))
    motion = env.find_motion(state.pipeline_state)
    wheels = np.array(action) * env.interface.limits
    speed, turn = find_twist(jnp.asarray(wheels), env.robot.radius, env.robot.track)
    np.testing.assert_allclose(motion.velocity[0], speed, rtol=0.03, atol=3e-3)
    np.testing.assert_allclose(motion.turning[2], turn, rtol=0.03, atol=1e-2)
    np.testing.assert_allclose(env._find_wheel_speeds(state.pipeline_state), wheels, rtol=0.03)


def test_twist_and_wheel_speeds_are_inverse():
    wheels = jnp.array([1.5, -0.4])
    np.testing.assert_allclose(find_wheel_speeds(*find_twist(wheels, 0.04, 0.3), 0.04, 0.3), wheels, rtol=1e-5)
    limited = np.asarray(limit_speeds(jnp.array([8.0, -2.0]), jnp.array([4.0, 5.0])))
    np.testing.assert_allclose(limited, [4, -1])
    np.testing.assert_allclose(limit_speeds(wheels, jnp.array([4.0, 5.0])), wheels)


def test_what_is_read_from_a_robot():
    """Left and right by place, not by order; a wheel that turns backwards; radius, track, place at rest, a floor."""
    robot = read_wheels(load_robot(write(describe())))
    assert [wheel.name for wheel in robot.wheels] == ["l", "r"]
    assert [wheel.sign for wheel in robot.wheels] == [-1, 1]
    assert robot.track == pytest.approx(0.24)
    assert robot.radius == 0.05
    assert [robot.model.joint(i).name for i in robot.others] == ["swivel"]
    np.testing.assert_allclose(robot.axle, [0.05, 0, 0.02], atol=1e-6)
    np.testing.assert_allclose(robot.frame, np.eye(3), atol=5e-3)  # it leans by as much on its soft contacts
    np.testing.assert_allclose(robot.qpos[:2], [-0.05, 0], atol=1e-4)
    assert robot.qpos[2] == pytest.approx(0.03, abs=1e-3)
    assert robot.guesses == ("it gets a floor, as it has none",)
    shipped = read_wheels(load_robot("drive", ("drive",)))
    assert (shipped.radius, round(shipped.track, 9), shipped.guesses) == (0.033, 0.16, ())


def test_servos_become_motors_with_their_torque_limits():
    """And motors remain: the joints get the torques that the actions command."""
    for robot, limit in (("drive", 0.1 * 1.5), (write(describe()), 0.1 * 2.0)):
        env = make(robot=robot, control="torque")
        np.testing.assert_allclose(env.interface.limits, limit)
        ctrl = env.control.command(jnp.array([0.5, -1.0]))
        data = mujoco.MjData(env.model)
        data.ctrl[:] = ctrl
        mujoco.mj_forward(env.model, data)
        torques = [wheel.sign * data.qfrc_actuator[wheel.dof] for wheel in env.robot.wheels]
        np.testing.assert_allclose(torques, [0.5 * limit, -limit], rtol=1e-5)


@pytest.mark.parametrize(
    ("error", "angle"), [((0.5, 0.2), 1.0), ((0.3, -0.4), -3.0), ((-0.5, 0.2), 1.0), ((-0.1, -0.4), 2.5)], ids=str
)
def test_textbook_law(error, angle):
    """v = 3 rho, w = 8 alpha - 1.5 beta in floats; from behind, the same for the robot's rear, and v backwards."""
    side = 1 if error[0] > 0 else -1
    alpha = np.arctan2(side * error[1], side * error[0])
    speed, turn = steer_to_pose(jnp.array(error), jnp.array(angle))
    assert float(speed) == pytest.approx(3 * side * np.hypot(*error), rel=1e-5)
    assert float(turn) == pytest.approx(8 * alpha - 1.5 * wrap(angle - alpha), rel=1e-5)


def test_textbook_law_turns_where_a_bearing_means_nothing():
    assert [float(x) for x in steer_to_pose(jnp.array([0.0, 0.009]), jnp.array(0.25))] == [0, 2]
    assert [float(x) for x in steer_to_pose(jnp.zeros(2), jnp.array(0.0))] == [0, 0]


def test_textbook_controller_parks():
    """All of 64 episodes, and with the return that reports name, within 4 standard errors."""
    env = make(physics="scalar")
    state = jit_batch(env, "reset")(jax.random.split(jax.random.key(0), 64))
    rewards = []
    for _ in range(env.config.episode_length):
        state = jit_batch(env, "step")(state, jit_batch(env, "baseline")(state))
        rewards.append(np.asarray(state.reward))
    returns = np.sum(rewards, axis=0)
    assert np.asarray(state.metrics["success"]).min() == 1
    assert abs(returns.mean() - TEXTBOOK_RETURN) < 4 * returns.std() / np.sqrt(64)
    assert env.references == {"textbook controller": TEXTBOOK_RETURN}
    assert make(physics="scalar", goal_max=2.0).references == {}


@pytest.mark.parametrize("options", [{"control": "torque"}, {"robot": "cart"}, {"robot": "cart", "control": "torque"}])
def test_textbook_controller_parks_other_robots(options):
    """Wheel torques, motors, another frame: 31 of 32 episodes by C MuJoCo."""
    env = make(**options | ({"robot": write(describe())} if "robot" in options else {}))
    state = jit_batch(env, "reset")(jax.random.split(jax.random.key(0), 32))
    for _ in range(env.config.episode_length):
        state = jit_batch(env, "step")(state, jit_batch(env, "baseline")(state))
    assert np.asarray(state.metrics["success"]).mean() > 0.96


# --- mistakes ---------------------------------------------------------------------------------------------------------

LIMITED = WHEEL.format(name="r", y=-0.12, axis=1, more='range="-1 1"')
SKEW = WHEEL.format(name="r", y=-0.12, axis="1 1", more="").replace('axis="0 1 1 0"', 'axis="1 1 0"')
FIXED = LEFT.replace("<geom", '<geom contype="0" conaffinity="0"')
UNLIMITED = '<velocity joint="r" kv="1"/><velocity joint="l" kv="1"/>'
POSITIONS = '<position joint="r" kp="1"/><position joint="l" kp="1"/>'


@pytest.mark.parametrize(
    ("robot", "options", "line"),
    [
        (None, {"goal_min": 2.0}, "expected less than env.goal_max=1"),
        (None, {"robot": "drvie"}, "did you mean 'drive'"),
        (None, {"robot": "panda"}, "known are drive"),
        ({"parts": RIGHT + CASTER, "actuators": '<motor joint="r" ctrlrange="-1 1"/>'}, {}, "found r"),
        ({"parts": LIMITED + LEFT + CASTER}, {}, "found l"),
        ({"actuators": POSITIONS}, {}, "found none"),
        ({"actuators": ""}, {}, "found none"),
        ({"free": ""}, {}, "<freejoint/>"),
        ({"parts": SKEW + LEFT + CASTER}, {}, "'r' and 'l' do not turn about one horizontal axle"),
        ({"parts": RIGHT + FIXED + CASTER}, {}, "wheel 'l' has no geom that collides with the floor"),
        ({"parts": RIGHT + LEFT}, {}, "does not stand still"),
        ({"actuators": UNLIMITED}, {"control": "torque"}, "is not limited on both sides"),
    ],
    ids=str,
)
def test_mistakes_are_one_line(robot, options, line):
    source = {} if robot is None else {"robot": write(describe(**robot))}
    with pytest.raises(OptionError) as caught:
        envs.make("drive", **{**source, **options})
    assert len(caught.value.problems) == 1
    assert line in caught.value.problems[0]
    assert "\n" not in caught.value.problems[0]
