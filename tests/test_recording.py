"""Recorded episodes are those that an evaluation plays; what is drawn of them is where the robot is."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from stored import a_policy

from envs.pendulum import observe
from envs.reach import Reach, ReachConfig
from envs.scenes import find_scene
from jaxpg import normalization
from jaxpg.evaluation import evaluate
from jaxpg.program.algorithms import make_algorithm
from jaxpg.program.networks import make_networks
from jaxpg.program.state import make_initial_run
from jaxpg.watch import drawing
from jaxpg.watch.clips import make_clip
from jaxpg.watch.player import wrap_coordinates
from jaxpg.watch.recording import compute_value_map, make_look, record
from jaxpg.watch.untrained import make_untrained
from jaxpg.watch.view import find_view

STARTS = 5
PENDULUM = ("env=pendulum", "network.widths=[8]", "env.episode_length=40", "num_envs=2", "algo.num_shards=1")
ARM = (
    "env=arm",
    "network.widths=[8]",
    "env.episode_length=30",
    "num_envs=2",
    "algo.num_shards=1",
    "algo.minibatches=2",
)


def starts():
    return jax.random.split(jax.random.key(3), STARTS)


@pytest.fixture(scope="module")
def recorded():
    """`recorded(options) -> (stored, recording)`, each played once."""
    made = {}

    def make(options):
        if options not in made:
            stored = a_policy(*options)
            made[options] = stored, record(stored, [stored.policy], starts())[0]
        return made[options]

    return make


def largest_difference(a, b):
    return max(jax.tree.leaves(jax.tree.map(lambda x, y: float(np.abs(x - y).max()), a, b)))


@pytest.mark.parametrize("options", [PENDULUM, ARM], ids=["pendulum", "arm"])
def test_a_recording_is_what_an_evaluation_plays(options, recorded):
    stored, recording = recorded(options)
    length = stored.config.env.episode_length
    episodes = evaluate(stored.env, lambda obs: stored.act(stored.policy, obs), starts(), length)
    np.testing.assert_allclose(recording.episode_return, episodes.episode_return, rtol=1e-4)
    np.testing.assert_array_equal(recording.length, episodes.length)
    assert recording.look.qpos.shape[:2] == (length + 1, STARTS)
    assert recording.command.shape == (length, STARTS, stored.env.action_size)
    assert np.abs(recording.command).max() <= 2.0  # N m
    for name, values in episodes.metrics.items():
        np.testing.assert_allclose(recording.metrics[name][-1], values, rtol=1e-3, atol=1e-5)


def test_the_value_is_the_critics_in_units_of_the_reward(recorded):
    """That of the first observation; the critic learns from rewards times reward_scale."""
    stored, recording = recorded(PENDULUM)
    obs = normalization.normalize(stored.policy.normalizer, jax.vmap(stored.env.reset)(starts()).obs)
    value = make_networks(stored.config, stored.env).value(stored.policy.params["critic"], obs)
    np.testing.assert_allclose(recording.value[0] * stored.config.algo.reward_scale, value, rtol=1e-4, atol=1e-5)


def test_rewards_after_the_end_of_an_episode_do_not_count(recorded):
    stored, recording = recorded(PENDULUM)
    ended = recording._replace(length=np.array([1, 40, 7, 40, 40]))
    assert ended.episode_return[0] == pytest.approx(recording.reward[0, 0])
    assert ended.episode_return[2] == pytest.approx(recording.reward[:7, 2].sum(), rel=1e-5)
    short = make_clip(stored, ended, 2)
    assert len(short.look.qpos) == 8
    assert {len(values) for values in short.series.values()} == {7}


def test_a_clip_with_fewer_frames_is_every_so_many_steps_of_the_whole(recorded):
    stored, recording = recorded(ARM)
    whole, short = make_clip(stored, recording, 1), make_clip(stored, recording, 1, most=10)
    assert short.dt == pytest.approx(3 * whole.dt)
    np.testing.assert_array_equal(short.look.qpos, whole.look.qpos[::3])
    np.testing.assert_array_equal(short.series["reward"], whole.series["reward"][::3])
    assert short.episode_return == whole.episode_return
    np.testing.assert_allclose(short.so_far[1], whole.series["reward"][:3].sum(), rtol=1e-6)
    np.testing.assert_allclose(whole.so_far[-1], whole.episode_return, rtol=1e-6)
    ended = make_clip(stored, recording._replace(length=np.full(STARTS, 7)), 1, most=10)
    np.testing.assert_array_equal(ended.look.qpos, whole.look.qpos[[0, 3, 6, 7]])
    np.testing.assert_array_equal(ended.series["reward"], whole.series["reward"][[0, 3, 6]])
    assert ended.so_far[-1] == pytest.approx(ended.episode_return)
    assert list(short.series) == ["shoulder torque [N m]", "elbow torque [N m]", "reward", "value"]


def test_the_policy_before_training_is_the_one_that_training_begins_with():
    stored = a_policy(*PENDULUM)
    begun = jax.jit(lambda seed: make_initial_run(make_algorithm(stored.config, stored.env), seed).train)
    same, other = (begun(np.uint32(seed)) for seed in (stored.config.run.seed, stored.config.run.seed + 1))
    found = make_untrained(stored)
    assert found.update == 0
    assert largest_difference(found.policy.params, same.params) < 1e-6
    assert largest_difference(found.policy.params, other.params) > 0.01
    assert largest_difference(found.policy.normalizer, same.normalizer) == 0


def test_a_pose_to_reach_is_drawn_as_the_environment_measures_it():
    """The angle of R_g R^T from what is drawn, the goal's rotation and the site's, is the environment's error."""
    env = Reach(ReachConfig(goal="pose", physics="mujoco"))
    scene, look = find_scene(env), make_look(find_view(env))
    for seed in range(3):
        state = env.reset(jax.random.key(seed))
        seen, errors, data = look(state), env.find_errors(state.pipeline_state), mujoco.MjData(scene.model)
        data.qpos = seen.qpos
        mujoco.mj_kinematics(scene.model, data)
        left = seen.rotation @ data.site_xmat[scene.site].reshape(3, 3).T
        assert np.arccos((np.trace(left) - 1) / 2) == pytest.approx(float(errors.angle), abs=1e-3)
        distance = np.linalg.norm(seen.goal - data.site_xpos[scene.site])
        assert distance == pytest.approx(float(errors.distance), abs=1e-4)
    assert find_scene(Reach(ReachConfig(physics="mujoco"))).goal_rotation is None


# --- in the plane -----------------------------------------------------------------------------------------------------


def ends(picture, frames):
    """Of parts with two points each, `[F, P, 2, 2]`."""
    return drawing.outline_points(picture, frames).reshape(len(frames.place), -1, 2, 2)


def test_a_pendulum_is_drawn_as_its_angle_says():
    """From the pivot to the tip, which is at (-sin theta, cos theta) seen against +y: positive angles lean left."""
    view = find_scene(a_policy(*PENDULUM).env)
    picture, theta = drawing.make_picture(view.model), np.linspace(-7, 7, 50)
    rod = ends(picture, drawing.draw(picture, theta[:, None]))[:, 0]
    order = np.argsort(np.linalg.norm(rod, axis=-1), axis=1)
    pivot, tip = (np.take_along_axis(rod, order[:, i, None, None], axis=1)[:, 0] for i in (0, 1))
    np.testing.assert_allclose(pivot, 0, atol=1e-6)
    np.testing.assert_allclose(tip, np.stack([-np.sin(theta), np.cos(theta)], axis=1), atol=1e-6)
    assert [part.radius for part in picture.parts] == pytest.approx([0.05])
    assert [(motor.command, motor.sign) for motor in picture.motors] == [(0, 1)]


def test_an_arm_is_drawn_as_its_angles_say_and_its_goal_where_it_is():
    stored = a_policy(*ARM)
    view, upper, fore = find_scene(stored.env), *stored.env.lengths
    state = stored.env.reset(jax.random.key(5))
    qpos = np.array([[0.3, -1.2], [2.0, 0.5]])
    picture = drawing.make_picture(view.model)
    frames = drawing.draw(picture, qpos, np.array(view.goal(state))[None])
    shoulder, wrist = qpos[:, 0], qpos.sum(axis=1)
    elbow = upper * np.stack([np.cos(shoulder), np.sin(shoulder)], axis=1)
    hand = elbow + fore * np.stack([np.cos(wrist), np.sin(wrist)], axis=1)
    rods = np.sort(ends(picture, frames), axis=2)  # of either rod, in whichever order
    for rod, (a, b) in enumerate([(0 * elbow, elbow), (elbow, hand)]):
        np.testing.assert_allclose(rods[:, rod], np.sort(np.stack([a, b], axis=1), axis=1), atol=1e-6)
    np.testing.assert_allclose(frames.motors, np.stack([0 * elbow, elbow], axis=1), atol=1e-6)
    np.testing.assert_allclose(frames.goal, state.pipeline_state.goal, atol=1e-6)


def test_what_is_drawn_lies_in_its_rectangle():
    view = find_scene(a_policy(*ARM).env)
    picture = drawing.make_picture(view.model)
    frames = drawing.draw(picture, np.array([[0.0, 0.0], [np.pi / 2, 0.0]]), np.array([[-0.5, 0.2, 0.0]]))
    x_min, y_min, x_max, y_max = drawing.extent(picture, [frames], margin=0.0)
    # Stretched along x, then along y, with the radius of the rods; and the goal on the other side.
    np.testing.assert_allclose([x_min, y_min, x_max, y_max], [-0.5, -0.03, 1.025, 1.025], atol=1e-6)


def test_a_robot_that_travels_stays_in_the_picture():
    view = find_scene(a_policy(*ARM).env)
    picture = drawing.make_picture(view.model)
    still = drawing.outline_points(picture, drawing.draw(picture, np.zeros((10, 2))))
    travelling = still + np.linspace(0, 20, 10)[:, None, None] * np.array([1.0, 0.0])
    moved = travelling - drawing.find_center(travelling)[:, None]
    assert np.ptp(moved[..., 0]) == pytest.approx(np.ptp(still[..., 0]))
    assert not drawing.find_center(still).any()


# --- the phase plane --------------------------------------------------------------------------------------------------


def test_the_map_holds_the_value_of_each_state():
    stored = a_policy(*PENDULUM)
    (values,) = compute_value_map(stored, [stored.policy], columns=5, rows=3)
    assert values.shape == (3, 5)
    for row, speed in enumerate((-8.0, 0.0, 8.0)):
        for column, theta in enumerate(np.linspace(-np.pi, np.pi, 5)):
            expected = stored.value(stored.policy, observe(jnp.array(theta), jnp.array(speed)))
            assert values[row, column] == pytest.approx(float(expected), rel=1e-3, abs=1e-4)


def test_an_angle_is_within_its_turn():
    plane = a_policy(*PENDULUM).env.phase_plane
    angles = np.array([-np.pi, 3 * np.pi - 0.1, -7.0, 0.5])
    found = wrap_coordinates(plane, np.stack([angles, np.full(4, 9.0)], axis=1))
    assert (found[:, 0] >= -np.pi).all()
    assert (found[:, 0] < np.pi).all()
    np.testing.assert_allclose(np.exp(1j * found[:, 0]), np.exp(1j * angles), atol=1e-12)
    np.testing.assert_array_equal(found[:, 1], 9.0)
