"""The two-link arm: kinematics, goals, rewards, actuators."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs.arm import PULL, ArmConfig, ArmState, end_effector, goal_distance, observe, reward, sample_ring
from envs.options import OptionError

LENGTHS = (0.5, 0.5)


def state(qpos=(0.3, -0.8), qvel=(0.0, 0.0), goal=(0.4, 0.5)):
    return ArmState(*(jnp.array(x, jnp.float32) for x in (qpos, qvel, goal)))


@pytest.mark.parametrize("lengths", [(0.5, 0.5), (0.6, 0.35)])
def test_end_effector_is_mujocos_site(lengths):
    env = envs.make("arm", upper_length=lengths[0], fore_length=lengths[1], goal_min=0.3)
    data = mujoco.MjData(env.model)
    for qpos in np.random.default_rng(0).uniform(-np.pi, np.pi, (50, 2)):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(env.model, data)
        ours = end_effector(jnp.asarray(qpos, jnp.float32), env.lengths)
        np.testing.assert_allclose(ours, data.site("end_effector").xpos[:2], atol=1e-6)


def test_goals_are_uniform_over_the_ring():
    """P(radius <= r) = (r^2 - a^2) / (b^2 - a^2): Kolmogorov distance of 20,000 draws below its 0.1 % point."""
    inner, outer, n = 0.2, 0.95, 20_000
    goals = np.asarray(
        jax.vmap(lambda key: sample_ring(key, inner, outer))(jax.random.split(jax.random.key(0), n)), float
    )
    radius, angle = np.sort(np.linalg.norm(goals, axis=1)), np.sort(np.arctan2(goals[:, 1], goals[:, 0]))
    empirical = (np.arange(n) + 0.5) / n
    bound = 1.95 / np.sqrt(n)
    assert np.abs((radius**2 - inner**2) / (outer**2 - inner**2) - empirical).max() < bound
    assert np.abs((angle + np.pi) / (2 * np.pi) - empirical).max() < bound
    uniform_radius = (radius - inner) / (outer - inner)
    assert np.abs(uniform_radius - empirical).max() > bound, "a radius drawn uniformly would be noticed"


def test_lesson_reward():
    """r = -lambda_pos |x_ee - x_goal|^2 - lambda_torque |tau|^2, of the state before the step."""
    env = envs.make("arm", reward="lesson", lambda_pos=2.0, lambda_torque=0.01)
    before = jax.jit(env.reset)(jax.random.key(0))
    action = jnp.array([0.5, -1.0])
    error = np.asarray(end_effector(before.pipeline_state.qpos, LENGTHS) - before.pipeline_state.goal, float)
    expected = -2.0 * np.sum(error**2) - 0.01 * np.sum((2.0 * np.asarray(action, float)) ** 2)
    np.testing.assert_allclose(jax.jit(env.step)(before, action).reward, expected, rtol=1e-5)


def test_precise_reward_pulls_at_the_last_centimetre():
    """Its slope at d = 1 cm is at least PULL; the lesson's is 0.02 there."""
    slope = lambda config: -float(jax.grad(lambda d: reward(d, jnp.zeros(2), config))(0.01))  # noqa: E731
    assert slope(ArmConfig(reward="lesson")) == pytest.approx(0.02, rel=1e-4)
    assert slope(ArmConfig(reward="precise")) == pytest.approx(0.02 + PULL, rel=1e-4)


def test_distance_has_a_gradient_at_the_goal():
    at_goal = lambda qpos: goal_distance(ArmState(qpos, jnp.zeros(2), jnp.array([1.0, 0.0])), LENGTHS)  # noqa: E731
    assert np.isfinite(jax.grad(at_goal)(jnp.zeros(2))).all()
    assert float(at_goal(jnp.zeros(2))) == 0.0


def test_observation():
    seen = observe(state(), LENGTHS)
    ee = np.array([0.5 * np.cos(0.3) + 0.5 * np.cos(-0.5), 0.5 * np.sin(0.3) + 0.5 * np.sin(-0.5)])
    expected = [np.cos(0.3), np.cos(-0.8), np.sin(0.3), np.sin(-0.8), 0, 0, 0.4, 0.5, 0.4 - ee[0], 0.5 - ee[1]]
    np.testing.assert_allclose(seen, expected, atol=1e-6)


@pytest.mark.parametrize(("radius", "success"), [(0.05, 0.0), (0.2, 1.0)])
def test_success_is_being_within_the_radius_after_the_step(radius, success):
    env = envs.make("arm", success_radius=radius)
    ee = np.asarray(end_effector(jnp.array([0.3, -0.8]), LENGTHS))
    before = env.reset(jax.random.key(0)).replace(pipeline_state=state(goal=ee + np.array([0.1, 0.0])))
    after = jax.jit(env.step)(before, jnp.zeros(2))
    np.testing.assert_allclose(after.metrics["distance"], 0.1, atol=1e-6)
    assert float(after.metrics["success"]) == success


def test_velocity_actuators_are_held_to_the_torque_limit():
    """The torque in the reward is MuJoCo's own actuator force: gain (command - speed), clipped."""
    env = envs.make("arm", control="velocity", lambda_pos=0.0, lambda_torque=1.0)
    data = mujoco.MjData(env.model)
    step = jax.jit(env.step)
    for action, qvel in (((0.1, -0.2), (0.5, 0.1)), ((1.0, -1.0), (0.0, 0.0)), ((-1.0, 0.3), (-4.5, 3.0))):
        before = env.reset(jax.random.key(0)).replace(pipeline_state=state(qvel=qvel))
        data.qvel[:], data.ctrl[:] = qvel, 4.0 * np.array(action)
        mujoco.mj_forward(env.model, data)
        np.testing.assert_allclose(-step(before, jnp.array(action)).reward, np.sum(data.actuator_force**2), rtol=1e-5)
        assert np.abs(data.actuator_force).max() <= 2.0


def test_the_arm_can_be_held_against_gravity():
    """At rest and stretched, the torques that gravity asks for are within the limit."""
    env = envs.make("arm", gravity=True)
    data = mujoco.MjData(env.model)
    mujoco.mj_forward(env.model, data)
    assert np.abs(data.qfrc_bias).max() == pytest.approx(9.81 * (0.25 * 0.25 + 0.15 * 0.75), rel=1e-6)
    assert np.abs(data.qfrc_bias).max() < env.config.torque_limit


def test_goals_out_of_reach_are_refused():
    with pytest.raises(OptionError, match="reachable"):
        envs.make("arm", goal_max=1.2)


def test_time_step_is_ten_milliseconds():
    assert envs.make("arm").model.opt.timestep == pytest.approx(0.01)
    assert envs.make("arm").dt == pytest.approx(0.05)
