"""brax's wrappers around this project's environments, and brax's environments here."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs.options import OptionError
from jaxpg.rollout import rollout
from jaxpg.vector_env import vectorize

LENGTH = 4


def test_braxs_own_wrappers_step_the_environments():
    """Batch, time limit and automatic reset, as brax's trainers stack them: the steps are the environment's own.

    brax's keys are arrays of two numbers, and after a reset each environment begins where it began before.
    """
    envs.make("brax", name="fast")  # imports brax in silence
    from brax.envs.wrappers import training

    env = envs.make("arm")
    wrapped = training.wrap(env, episode_length=LENGTH)
    assert (wrapped.observation_size, wrapped.action_size, wrapped.backend) == (10, 2, "mjx")
    assert wrapped.unwrapped is env
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    actions = jax.random.uniform(jax.random.key(1), (LENGTH + 1, 3, 2), minval=-1)

    def play(step, state):
        return jax.lax.scan(lambda state, action: (step(state, action),) * 2, state, actions)[1]

    states = jax.jit(lambda keys: play(wrapped.step, wrapped.reset(keys)))(keys)
    own = jax.jit(lambda keys: play(jax.vmap(env.step), jax.vmap(env.reset)(keys)))(keys)
    np.testing.assert_allclose(states.reward[:LENGTH], own.reward[:LENGTH], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(states.obs[: LENGTH - 1], own.obs[: LENGTH - 1], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(states.obs[LENGTH - 1], jax.vmap(env.reset)(keys).obs, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(states.done[:, 0], [0, 0, 0, 1, 0])
    np.testing.assert_array_equal(states.info["truncation"], states.done)
    np.testing.assert_allclose(
        states.info["episode_metrics"]["distance"][LENGTH - 1], own.metrics["distance"][:LENGTH].sum(0), rtol=1e-5
    )


def test_a_brax_environment_steps_here():
    vector = vectorize(envs.make("brax", name="fast", backend="spring"), 2, LENGTH)
    start = vector.reset(jax.random.key(0))
    _, steps = rollout(lambda obs, key: (jnp.zeros((2, 1)),) * 2, vector.step, start, jax.random.key(1), 2 * LENGTH)
    np.testing.assert_array_equal(steps.truncated[:, 0], [0, 0, 0, 1] * 2)


def play(name, physics, num_steps=20):
    """Observations, rewards and ends after a reset and steps under random actions, and the last state of the links."""
    env = envs.make("brax", name=name, physics=physics)
    actions = jax.random.uniform(jax.random.key(1), (num_steps, env.action_size), minval=-1)
    state, step = jax.jit(env.reset)(jax.random.key(3)), jax.jit(env.step)
    seen = [(state.obs, state.reward, state.done)]
    for action in actions:
        state = step(state, action)
        seen.append((state.obs, state.reward, state.done))
    return seen, state.pipeline_state.x, state.pipeline_state.xd


def assert_close(a, b, atol):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=atol), a, b)


OTHERS = ("reacher", "inverted_double_pendulum", "halfcheetah", "hopper", "walker2d", "pusher", "ant")


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'")
@pytest.mark.parametrize(
    "name", ["inverted_pendulum", *(pytest.param(name, marks=pytest.mark.study) for name in OTHERS)]
)
def test_mujocos_environments_step_by_the_equations_as_by_c_mujoco(name):
    """Rounding grows where there are contacts."""
    with jax.enable_x64(True):
        assert_close(play(name, "scalar"), play(name, "mujoco"), 1e-7)


@pytest.mark.study
@pytest.mark.parametrize("name", ["reacher", "inverted_double_pendulum"])
def test_they_move_as_by_braxs_own_physics(name):
    """On the motion of these MJX and C MuJoCo agree; MJX's solver ends early in some of the others."""
    with jax.enable_x64(True):
        assert_close(play(name, "scalar"), play(name, "mjx"), 1e-12)


def test_poses_and_velocities_of_links_are_those_of_mujocos_bodies():
    envs.make("brax", name="fast")  # imports brax in silence
    from brax.envs import get_environment

    from envs.brax_physics import FIELDS, find_motion

    model = get_environment("ant", backend="mjx").sys.mj_model
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    data.qpos, data.qvel = random.normal(size=model.nq), random.normal(size=model.nv)
    mujoco.mj_forward(model, data)
    velocities = np.empty((model.nbody, 6))
    for body, velocity in enumerate(velocities):
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
    with jax.enable_x64(True):
        x, xd = find_motion(model, *(np.asarray(getattr(data, name)) for name in FIELDS))
    assert_close((x.pos, x.rot), (data.xpos[1:], data.xquat[1:]), 1e-15)
    assert_close((xd.ang, xd.vel), (velocities[1:, :3], velocities[1:, 3:]), 1e-12)


def test_changed_options_of_a_system_are_kept():
    """brax's ant steps without the implicit damping of MuJoCo's integrator."""
    envs.make("brax", name="fast")  # imports brax in silence
    from brax.envs import get_environment

    from envs.brax_physics import copy_model

    sys = get_environment("ant", backend="mjx").sys
    assert sys.mj_model.opt.disableflags == 0
    assert copy_model(sys).opt.disableflags == mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    assert copy_model(sys.tree_replace({"opt.timestep": 0.003})).opt.timestep == 0.003


def test_only_mujocos_physics_is_chosen():
    with pytest.raises(OptionError, match=r"^env.physics=mujoco needs env.backend=mjx; it is spring$"):
        envs.make("brax", name="reacher", backend="spring", physics="mujoco")


@pytest.mark.filterwarnings("ignore:JAXopt:DeprecationWarning")  # brax imports it
def test_the_swimmer_is_refused_for_as_long_as_it_does_not_run():
    with pytest.raises(OptionError, match=r"^env.name=swimmer: brax's does not run with jax 0.10 or newer$"):
        envs.make("brax", name="swimmer")
    from brax.envs import get_environment

    env = get_environment("swimmer", backend="generalized")
    with pytest.raises(TypeError, match="a_min"):
        jax.eval_shape(env.step, jax.eval_shape(env.reset, jax.random.key(0)), jnp.zeros(2))
