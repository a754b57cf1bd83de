"""The pendulum is Gymnasium's Pendulum-v1."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.pendulum import PendulumState, observe, reward
from jaxpg.vector_env import vectorize


@pytest.fixture(scope="module")
def env():
    return envs.make("pendulum")


def step(env, theta, theta_dot, action):
    """One step from given states, all `[N]`."""
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), len(theta)))
    pipeline_state = PendulumState(
        jnp.asarray(theta, jnp.float32)[:, None], jnp.asarray(theta_dot, jnp.float32)[:, None]
    )
    state = state.replace(pipeline_state=pipeline_state)
    return jax.jit(jax.vmap(env.step))(state, jnp.asarray(action, jnp.float32)[:, None])


def test_what_is_best_is_known_of_gymnasiums_pendulum_alone(env):
    assert env.references == envs.make("pendulum", physics="mujoco").references == {"best possible": -137.4}
    assert envs.make("pendulum", physics="mujoco", mass=2.0).references == {}


def test_steps_are_gymnasiums(env):
    """10,000 random states and actions, also beyond the torque limit and near the speed limit: to 1e-5."""
    random = np.random.default_rng(0)
    theta, theta_dot, action = (random.uniform(-x, x, 10_000).astype(np.float32) for x in (np.pi, 8.0, 1.5))
    ours = jax.device_get(step(env, theta, theta_dot, action))
    theirs = gymnasium.make("Pendulum-v1").unwrapped
    results = []
    for i in range(len(theta)):
        theirs.state = np.array([theta[i], theta_dot[i]], float)
        results.append(theirs.step(np.array([2.0 * action[i]]))[:3])
    for mine, true in zip((ours.obs, ours.reward, ours.done), zip(*results, strict=True), strict=True):
        np.testing.assert_allclose(mine, np.array(true), rtol=1e-5, atol=1e-5)


def test_episodes_are_gymnasiums():
    """A whole episode in float64 from Gymnasium's start under the same torques: the same rewards and time limit."""
    theirs = gymnasium.make("Pendulum-v1")
    theirs.reset(seed=0)
    start = theirs.unwrapped.state
    with jax.enable_x64(True):
        vector = vectorize(envs.make("pendulum"), 1, envs.REGISTRY["pendulum"].config().episode_length)
        state = vector.reset(jax.random.key(0))
        state = state._replace(
            env=state.env.replace(pipeline_state=PendulumState(*(jnp.full((1, 1), x) for x in start)))
        )
        ours_step = jax.jit(vector.step)
        for t in range(200):
            action = np.sin(0.1 * t)
            # Gymnasium rounds the observation, and nothing else, to float32.
            obs, reward, _, truncated, _ = theirs.step(np.array([2.0 * action]))
            state, outcome = ours_step(state, jnp.full((1, 1), action), jax.random.key(t))
            assert bool(outcome.truncated[0]) == truncated == (t == 199)
            np.testing.assert_allclose(outcome.reward[0], reward, atol=1e-9)
            np.testing.assert_allclose(outcome.next_obs[0], obs, atol=1e-6)


def test_reset_distribution(env):
    """theta ~ U(-pi, pi) and theta' ~ U(-1, 1): mean and variance within 4 standard errors of 20,000 draws."""
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(3), 20_000)).pipeline_state
    for values, limit in ((state.qpos, np.pi), (state.qvel, 1.0)):
        values = np.asarray(values, float)
        assert np.abs(values).max() <= limit
        assert abs(values.mean()) < 4 * limit / np.sqrt(3 * 20_000)
        assert abs((values**2).mean() - limit**2 / 3) < 4 * limit**2 * np.sqrt(4 / 45 / 20_000)


@pytest.mark.parametrize(
    ("option", "value"),
    [("mass", 2.5), ("length", 0.6), ("gravity", 3.7), ("torque_limit", 5.0), ("dt", 0.02), ("speed_limit", 3.0)],
)
def test_options_stay_consistent_with_the_model(option, value):
    """theta'' = 3 g / (2 l) sin(theta) + 3 / (m l^2) tau, with the option in the equation and in the MJCF alike."""
    constants = {"mass": 1.0, "length": 1.0, "gravity": 10.0, "torque_limit": 2.0, "dt": 0.05, "speed_limit": 8.0}
    constants[option] = value
    m, length, g, limit, dt, speed = constants.values()
    random = np.random.default_rng(1)
    theta, theta_dot, action = (random.uniform(-x, x, 50) for x in (np.pi, 2.0, 1.0))
    after = step(envs.make("pendulum", **{option: value}), theta, theta_dot, action).pipeline_state
    acceleration = 3 * g / (2 * length) * np.sin(theta) + 3 / (m * length**2) * limit * action
    expected_speed = np.clip(theta_dot + dt * acceleration, -speed, speed)
    np.testing.assert_allclose(after.qvel[:, 0], expected_speed, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(after.qpos[:, 0], theta + dt * expected_speed, rtol=1e-5, atol=1e-5)


def test_reward_is_best_upright_and_at_rest():
    assert float(reward(0.0, 0.0, 0.0)) == 0.0
    assert float(reward(2 * jnp.pi, 0.0, 0.0)) == pytest.approx(0.0, abs=1e-10)
    assert float(reward(jnp.pi, 0.0, 0.0)) == pytest.approx(-(np.pi**2), rel=1e-5)


def test_observation_is_angle_on_the_circle_and_speed():
    np.testing.assert_allclose(
        observe(jnp.float32(0.5), jnp.float32(-2.0)), [np.cos(0.5), np.sin(0.5), -2.0], rtol=1e-6
    )
