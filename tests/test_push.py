"""Pushing with any arm: the added table, object and fist, frames, rewards, starts, and the way through C MuJoCo."""

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
from envs.physics import candidate_pairs
from envs.physics.dynamics.choice import choose_pairs
from envs.push import WAYS, find_longest_run
from envs.robots import load_robot, read_arm
from envs.robots.placing import put

LINK = """<body pos="{at} 0 0">
  <joint name="{name}" axis="0 0 1" range="-2.5 2.5" limited="true" damping="0.01" armature="0.1"/>
  <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.5"/>{rest}</body>"""
# Three links over the table, on a base that stands aside and is turned: with motors, or with servos and a lift.
ARM = """<mujoco model="planar"><compiler angle="radian"/><option timestep="0.005"/><worldbody>
  <geom name="ground" type="plane" size="1 1 1"/><body pos="0.1 -0.2 0.135" euler="0 0 2">{links}</body></worldbody>
  <actuator>{actuators}</actuator><keyframe><key name="home" qpos="{lift}0.9 -1.4 -0.8"/></keyframe></mujoco>"""
LINKS = '<site name="tip" pos="0.3 0 0"/>'
for at, name in ((0.3, "wrist"), (0.3, "elbow"), (0, "shoulder")):
    LINKS = LINK.format(at=at, name=name, rest=LINKS)
JOINTS = ("shoulder", "elbow", "wrist")
MOTORS = ARM.format(links=LINKS, lift="", actuators="".join(f'<motor joint="{x}" ctrlrange="-9 9"/>' for x in JOINTS))
LIFT = '<joint name="lift" type="slide" axis="0 0 1" range="-0.2 0.2" limited="true" damping="1"/>'
SERVOS = ARM.format(
    links=LINKS.replace('<joint name="shoulder"', f'{LIFT}<joint name="shoulder"'),
    lift="0 ",
    actuators="".join(f'<position joint="{x}" kp="80" kv="8"/>' for x in JOINTS)
    + '<position joint="lift" kp="4000" kv="400"/>',
)


@functools.cache
def make(**options):
    """Stepped by C MuJoCo, which needs no compiler, unless a test compares it with the equations."""
    return envs.make("push", **{"robot": write(MOTORS), "physics": "mujoco", **options})


def move(env, state, **fields):
    """The state with other fields, and what is computed from them."""
    motion = state.pipeline_state.replace(**fields)
    return state.replace(pipeline_state=motion)


def put_object(env, state, place, turn=0.0):
    """The object at a place in the robot's frame, turned about the vertical axis."""
    qpos = np.asarray(state.pipeline_state.qpos, float).copy()
    qpos[-7:-5] = env.frame.place_back(np.asarray(place, float))
    qpos[-4:] = Rotation.from_euler("z", turn).as_quat()[[3, 0, 1, 2]]
    return move(env, state, qpos=jnp.asarray(qpos, jnp.float32))


def look(env, state):
    """C MuJoCo's data in a state."""
    data = mujoco.MjData(env.model)
    data.qpos[:], data.qvel[:] = (np.asarray(getattr(state.pipeline_state, name), float) for name in ("qpos", "qvel"))
    mujoco.mj_forward(env.model, data)
    return data


def to_robot(data, vector, is_place=True):
    """In the frame whose origin is under the first joint, and whose x axis points to the tip at rest."""
    model, rest = data.model, mujoco.MjData(data.model)
    for name, angle in zip(JOINTS, (0.9, -1.4, -0.8), strict=True):
        rest.joint(name).qpos[:] = angle
    mujoco.mj_kinematics(model, rest)
    ahead = rest.site("tip").xpos - rest.body("body1").xpos
    turn = Rotation.from_euler("z", -np.arctan2(ahead[1], ahead[0]))
    return turn.apply(vector - (np.array([0.1, -0.2, 0]) if is_place else 0))[:2]


def test_observations_are_in_the_robots_frame():
    """Places of the fist, the object and the goal from C MuJoCo, turned by scipy, in 10 states."""
    env = make(object="box")
    names = env.interface.observations
    for seed in range(10):
        state = put_object(env, start(env, seed), [0.4, 0.1 * np.sin(seed)], 0.3 * seed)
        velocity = np.random.default_rng(seed).normal(size=9).astype(np.float32)
        state = move(env, state, qvel=jnp.asarray(velocity))
        data, motion = look(env, state), state.pipeline_state
        got = dict(zip(names, np.asarray(env.observe(motion, env.find_places(motion)), float), strict=True))
        fist, thing = (to_robot(data, data.geom(f"push {name}").xpos) for name in ("fist", "object"))
        error = np.asarray(motion.goal, float) - thing
        behind = thing - 0.075 * error / (np.linalg.norm(error) + 0.01)
        vectors = {"goal - object": error, "object - fist": thing - fist, "place behind - fist": behind - fist}
        expected = {"fist z [m]": data.geom("push fist").xpos[2], "turn' [rad/s]": velocity[-1]}
        axis = to_robot(data, data.geom("push object").xmat.reshape(3, 3)[:, 0], is_place=False)
        speed = to_robot(data, velocity[3:6].astype(float), is_place=False)
        expected |= {"cos(turn)": axis[0], "sin(turn)": axis[1]}
        for i, name in enumerate("xy"):
            expected |= {f"fist {name} [m]": fist[i], f"object {name} [m]": thing[i], f"object {name}' [m/s]": speed[i]}
            for what, vector in vectors.items():
                expected[f"{what} {name} [m]"] = vector[i]
                for centimetres in (5, 1):
                    scaled = vector[i] / (np.linalg.norm(vector) + centimetres / 100)
                    expected[f"{what} {name} / (distance + {centimetres} cm)"] = scaled
        expected |= {f"cos({name})": np.cos(data.joint(name).qpos[0]) for name in JOINTS}
        expected |= {f"{name}' [rad/s]": data.joint(name).qvel[0] for name in JOINTS}
        for name, value in expected.items():
            assert got[name] == pytest.approx(value, abs=2e-5), name


VARIANTS = [{"object": "box", "lambda_rate": 0.0}, {"robot": write(SERVOS)}, *({"control": x} for x in WAYS)]


@pytest.mark.parametrize("options", VARIANTS, ids=lambda options: " ".join(options) + str(options.get("control", "")))
def test_every_number_has_a_name(options):
    env = make(**options)
    names, commands, limits = env.interface
    assert len(names) == len(set(names)) == env.observation_size == start(env).obs.size
    assert len(commands) == len(limits) == env.action_size


def test_reward_is_the_modules_equation():
    """In float64, of the state before the step, after two steps; every term has a weight."""
    weights = {"lambda_pos": 2.0, "lambda_fist": 0.7, "lambda_height": 3.0, "lambda_torque": 1e-3}
    env = make(**weights, lambda_velocity=0.01, lambda_rate=0.05, lambda_limit=0.5, limit_margin=3.0)
    first, second = np.array([[0.5, -1], [-0.5, 2.0]], np.float32)
    state = jit(env, "step")(start(env), first)
    data, motion = look(env, state), state.pipeline_state
    fist, thing = (to_robot(data, data.geom(f"push {name}").xpos) for name in ("fist", "object"))
    error = np.asarray(motion.goal, float) - thing
    d = np.linalg.norm(error)
    behind = thing - 0.075 * error / (d + 0.01)
    cost = 2 * (d**2 + d + 0.1 * np.log(1 + d / 0.01)) + 0.7 * np.linalg.norm(behind - fist) * d / (d + 0.05)
    cost += 3.0 * abs(data.geom("push fist").xpos[2] - 0.035)
    ctrl, _ = env.command(jnp.array([-0.5, 1]), motion.qpos[:3], None)
    torque = np.asarray(env.physics_step(*(getattr(motion, name) for name in env.fields), ctrl)[-1], float)[:3]
    q, velocity = np.asarray(motion.qpos, float)[:3], np.asarray(motion.qvel, float)[:3]
    near = np.maximum(0, np.maximum(-2.5 + 3 - q, q - 2.5 + 3))
    cost += 1e-3 * np.sum(torque**2) + 0.01 * np.sum(velocity**2) + 0.5 * np.sum(near**2)
    cost += 0.05 * np.sum((np.array([-0.5, 1]) - first) ** 2)
    assert np.sum(torque**2) > 0.1
    assert jit(env, "step")(state, second).reward == pytest.approx(-cost, rel=2e-5)


def test_all_contacts_are_those_of_object_table_and_fist_and_equations():
    """The robot's links, its own ground and the rod touch nothing; no pair is left to be watched."""
    for options in ({"robot": write(SERVOS)}, {"robot": write(SERVOS), "object": "box"}):
        model = make(**options).model
        pairs = candidate_pairs(model)
        names = {frozenset((model.geom(pair.geom1).name, model.geom(pair.geom2).name)) for pair in pairs}
        parts = frozenset(f"push {name}" for name in ("table", "fist", "object"))
        assert names == {parts - {part} for part in parts}
        chosen, watched = choose_pairs(model, pairs)
        assert len(chosen) == 3
        assert not watched


@pytest.mark.parametrize("kind", ["puck", "box"])
def test_object_rests_on_the_table(kind):
    """For a second it stays where it is, within 0.1 mm, at half its height within 0.5 mm."""
    env = make(object=kind)
    state = start(env, 3)
    before = np.asarray(state.pipeline_state.qpos, float)[-7:]
    for _ in range(50):
        state = jit(env, "step")(state, np.zeros(2, np.float32))
    after = np.asarray(state.pipeline_state.qpos, float)[-7:]
    np.testing.assert_allclose(after[:2], before[:2], atol=1e-4)
    assert after[2] == pytest.approx(0.03, abs=5e-4)


@pytest.mark.parametrize("friction", [0.3, 0.6])
def test_object_slides_as_coulomb_says(friction):
    """Pushed off at 0.5 m/s it stops after v^2 / (2 mu g), within a tenth, whatever its mass."""
    env = make(object_friction=friction, object_mass=0.8)
    state = put_object(env, start(env), [5.0, 0.0])
    state = move(env, state, qvel=state.pipeline_state.qvel.at[3].set(0.5))
    first = np.asarray(state.pipeline_state.qpos[-7:], float)
    for _ in range(30):
        state = jit(env, "step")(state, np.zeros(2, np.float32))
    way = np.asarray(state.pipeline_state.qpos[-7:], float) - first
    assert way[0] == pytest.approx(0.25 / (2 * friction * 9.81), rel=0.1)
    assert abs(way[1]) < 1e-3


def rest_in_the_middle(env, state):
    """The robot in the middle of its area."""
    middle = jnp.asarray(env.middle, jnp.float32)
    qpos = state.pipeline_state.qpos.at[: len(middle)].set(middle)
    return move(env, state, qpos=qpos, **({"target": middle} if env.control.has_target else {}))


def test_command_is_the_modules_equation():
    """Joint velocities g + J' (J J' + lambda^2 I)^-1 (V - J g) in float64, with C MuJoCo's Jacobian."""
    env = make()
    state = start(env, 5)
    data, (axes, jacobian) = look(env, state), (np.asarray(env.frame.axes), np.zeros((3, 9)))
    mujoco.mj_jacSite(env.model, data, jacobian, None, env.model.site("push fist").id)
    jacobian = jacobian[:, :3]
    action = np.array([0.3, -0.2])
    wanted = np.append(0.4 * (axes.T @ action), 5.0 * (0.035 - data.site("push fist").xpos[2]))
    posture = env.middle - data.qpos[:3]
    inverse = np.linalg.inv(jacobian @ jacobian.T + 0.02**2 * np.eye(3))
    expected = posture + jacobian.T @ inverse @ (wanted - jacobian @ posture)
    assert np.abs(expected).max() < 2, "within the largest speeds"
    ctrl, _ = env.command(jnp.asarray(action, jnp.float32), state.pipeline_state.qpos[:3], None)
    gain = env.model.actuator_gainprm[:, 0]  # a servo's control also makes up for the joint's damping
    np.testing.assert_allclose(ctrl, expected * (1 + 0.01 / gain), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("robot", "error"), [(MOTORS, 0.05), (SERVOS, 0.15)], ids=["motors", "soft servos"])
def test_fist_moves_as_commanded(robot, error):
    """Away from the object its velocity is about speed * a, in the robot's frame, and its height 3.5 cm."""
    env = make(robot=write(robot), speed=0.2)
    state = put_object(env, start(env), [5.0, 0.0])
    state = rest_in_the_middle(env, state)
    places = []
    for _ in range(40):
        state = jit(env, "step")(state, np.array([0.5, -1.0], np.float32))
        data = look(env, state)
        places.append(to_robot(data, data.geom("push fist").xpos))
        assert data.geom("push fist").xpos[2] == pytest.approx(0.035, abs=3e-3)
    np.testing.assert_allclose((places[-1] - places[9]) / 30 / env.dt, [0.1, -0.2], rtol=error)


def put_ahead(env):
    """The robot in the middle, and an object a centimetre ahead of its fist, a little to the left."""
    state = rest_in_the_middle(env, start(env))
    fist = np.asarray(env.find_places(state.pipeline_state).fist, float)
    return put_object(env, state, fist + np.array([0.085, 0.01]), 0.2)


def differ(one, other):
    """The largest differences of two states: positions, velocities, rewards."""
    motions = one.pipeline_state, other.pipeline_state
    pairs = [[getattr(motion, name) for motion in motions] for name in ("qpos", "qvel")]
    return [float(np.abs(np.asarray(x) - np.asarray(y)).max()) for x, y in (*pairs, (one.reward, other.reward))]


@pytest.mark.parametrize("kind", ["puck", "box"])
def test_push_is_c_mujocos(kind):
    """For 20 steps the fist pushes the object; each step by the equations is C MuJoCo's, and a box's way as well.

    Not the first of a puck's: where it touches the table while it stands upright depends on rounding.
    """
    ours, theirs = make(object=kind, physics="scalar"), make(object=kind)
    state = other = first = put_ahead(ours)
    action, worst = np.array([1.0, 0.2], np.float32), np.zeros(3)
    for i in range(20):
        expected, other = (jit(theirs, "step")(each, action) for each in (state, other))
        state = jit(ours, "step")(state, action)
        worst = np.maximum(worst, differ(state, expected)) if i else worst
    assert (worst < [1e-5, 2e-3, 1e-4]).all()
    if kind == "box":
        assert (np.array(differ(state, other)) < [1e-4, 2e-3, 1e-4]).all()
    way = ours.find_places(state.pipeline_state).object - ours.find_places(first.pipeline_state).object
    assert float(way[0]) > 0.05, "the object has been pushed"


def test_starts_and_goals():
    """Of 500: ways of 5 to 25 cm in the area, uniform in length; the fist at its height, clear of the object."""
    env = make()
    motion = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 500)).pipeline_state
    places = jax.vmap(env.find_places)(motion)
    ways, middle = np.linalg.norm(np.asarray(places.error, float), axis=1), [env.area.middle, 0]
    assert ways.min() > 0.05 - 1e-6
    assert ways.max() < 0.25 + 1e-6
    assert ways.mean() == pytest.approx(0.15, abs=4 * 0.2 / np.sqrt(12 * 500))
    for place in (np.asarray(places.object), np.asarray(motion.goal)):
        assert np.linalg.norm(place - middle, axis=1).max() < env.area.radius + 1e-6
    np.testing.assert_allclose(places.height, 0.035, atol=5e-3)
    away = np.linalg.norm(np.asarray(places.fist - places.object), axis=1)
    assert away.min() > 0.05 + 0.025
    np.testing.assert_allclose(motion.qpos[:, -5], 0.03, atol=2e-4)


def test_success_is_holding_the_goal():
    """0.2 s are ten steps of 20 ms: success from the tenth on, not in the ninth; never with a goal 6 cm away."""
    env = make()
    for way, expected in ((0.04, [0.0] * 9 + [1.0] * 3), (0.06, [0.0] * 12)):
        state = start(env)
        goal = env.find_places(state.pipeline_state).object + jnp.array([way, 0])
        state, success = move(env, state, goal=goal), []
        for _ in range(12):
            state = jit(env, "step")(state, np.zeros(2, np.float32))
            success.append(float(state.metrics["success"]))
        assert success == expected
        assert float(state.metrics["distance"]) == pytest.approx(way, abs=1e-3)


def test_put_is_inverse_kinematics():
    """The Panda's flange is at the place within a millimetre, about as it was turned; joints keep to their ranges."""
    arm = read_arm(load_robot("panda"))
    data, rest = mujoco.MjData(arm.model), mujoco.MjData(arm.model)
    rest.qpos[:] = arm.qpos
    mujoco.mj_kinematics(arm.model, rest)
    for place in ([0.5, 0.0, 0.3], [0.4, 0.3, 0.2], [0.6, -0.1, 0.15]):
        found = put(arm, np.array(place), arm.angles)
        data.qpos[:] = found.angles
        mujoco.mj_kinematics(arm.model, data)
        np.testing.assert_allclose(data.site(arm.site).xpos, place, atol=1e-3)
        np.testing.assert_allclose(data.site(arm.site).xpos, found.position, atol=1e-12)
        left = Rotation.from_matrix(rest.site(arm.site).xmat.reshape(3, 3).T @ data.site(arm.site).xmat.reshape(3, 3))
        assert left.magnitude() < 0.15
        assert ((found.angles >= arm.ranges[0]) & (found.angles <= arm.ranges[1])).all()
    beyond = put(arm, np.array([2.0, 0, 0.3]), arm.angles)
    assert np.linalg.norm(beyond.position - [2.0, 0, 0.3]) > 0.5


@pytest.mark.parametrize(
    ("values", "run"), [([], (0, 0)), ([0, 1, 1, 0, 1], (1, 3)), ([1, 0, 1, 1, 1], (2, 5)), ([0, 0], (0, 0))]
)
def test_longest_run(values, run):
    assert find_longest_run(values) == run


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"nearest": 0.3}, "env.nearest=0.3 must be below env.farthest=0.25"),
        ({"area": 0.5}, "too little for this task"),
        ({"fist_length": 0.3}, "planar reaches from 0.00 to 0.00 m in front of it"),
        ({"robot": "pandda"}, "panda"),
        ({"site": "tipp"}, "tip"),
        ({"object": "ball"}, "puck"),
    ],
    ids=str,
)
def test_mistakes_are_one_line(options, line):
    with pytest.raises(OptionError) as caught:
        envs.make("push", **{"robot": write(MOTORS), **options})
    assert len(caught.value.problems) == 1
    assert line in caught.value.problems[0]
