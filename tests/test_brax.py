"""brax's wrappers around this project's environments, and brax's environments here."""

import jax
import jax.numpy as jnp
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


def test_the_swimmer_is_refused_for_as_long_as_it_does_not_run():
    with pytest.raises(OptionError, match=r"^env.name=swimmer: brax's does not run with jax 0.10 or newer$"):
        envs.make("brax", name="swimmer")
    from brax.envs import get_environment

    env = get_environment("swimmer", backend="generalized")
    with pytest.raises(TypeError, match="a_min"):
        jax.eval_shape(env.step, jax.eval_shape(env.reset, jax.random.key(0)), jnp.zeros(2))
