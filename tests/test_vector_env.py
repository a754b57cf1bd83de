"""Time limit, resets and the true next observation."""

import jax
import jax.numpy as jnp
import numpy as np
from probes import Counter

from jaxpg.rollout import rollout
from jaxpg.vector_env import stagger, vectorize


def play(env, num_envs, episode_length, length, seed=0, staggered=False):
    """A rollout with the action 0, from fresh or staggered episodes."""
    vector = vectorize(env, num_envs, episode_length)
    state = vector.reset(jax.random.key(seed))
    if staggered:
        state = stagger(state, jax.random.key(seed + 1), episode_length)
    return rollout(
        lambda obs, key: (jnp.zeros((num_envs, 1)),) * 2, vector.step, state, jax.random.key(seed + 2), length
    )


def test_time_limit_truncates_and_does_not_terminate():
    _, steps = play(Counter(), num_envs=3, episode_length=5, length=12)
    ends = np.arange(1, 13) % 5 == 0
    np.testing.assert_array_equal(steps.truncated, np.repeat(ends[:, None], 3, axis=1))
    assert not steps.terminated.any()


def test_termination_on_the_last_step_is_no_truncation():
    _, steps = play(Counter(life=5), num_envs=2, episode_length=5, length=5)
    assert steps.terminated[4].all()
    assert not steps.truncated.any()


def test_next_observation_is_the_one_before_the_reset():
    _, steps = play(Counter(), num_envs=3, episode_length=5, length=12)
    np.testing.assert_array_equal(steps.next_obs[..., 0], steps.obs[..., 0])
    np.testing.assert_array_equal(steps.next_obs[..., 1], steps.obs[..., 1] + 1)


def test_observation_after_an_end_is_the_next_episodes_first():
    _, steps = play(Counter(), num_envs=3, episode_length=5, length=12)
    np.testing.assert_array_equal(steps.obs[5, :, 1], 0)
    np.testing.assert_array_equal(steps.obs[6, :, 1], 1)


def test_resets_are_fresh_draws():
    """Four episodes of each environment start in as many states (a replayed first state would give one)."""
    _, steps = play(Counter(), num_envs=3, episode_length=5, length=20)
    starts = np.asarray(steps.obs[::5, :, 0])
    assert len(np.unique(starts)) == starts.size


def test_only_ended_environments_are_reset():
    """Staggered episodes end at different steps; the others go on undisturbed."""
    _, steps = play(Counter(), num_envs=8, episode_length=5, length=20, staggered=True)
    done = np.asarray(steps.terminated + steps.truncated, bool)
    assert 0 < done[:5].sum(axis=1).max() < 8
    goes_on = ~done[:-1]
    np.testing.assert_array_equal(steps.obs[1:][goes_on], steps.next_obs[:-1][goes_on])
    np.testing.assert_array_equal(steps.obs[1:, :, 1][done[:-1]], 0)


def test_returns_are_reported_for_whole_episodes_only():
    _, steps = play(Counter(), num_envs=8, episode_length=5, length=20, staggered=True)
    done = np.asarray(steps.truncated, bool)
    first_end = np.argmax(done, axis=0)
    started_late = first_end < 4
    assert started_late.any()
    np.testing.assert_array_equal(steps.episode_end[first_end, np.arange(8)], ~started_late)
    np.testing.assert_array_equal(np.unique(steps.episode_return), [0, 5])
    np.testing.assert_array_equal(steps.episode_return > 0, steps.episode_end > 0)


def test_environments_draw_independently():
    """The starts of different environments are uncorrelated: |r| < 4 / sqrt(400) over 400 resets."""
    vector = vectorize(Counter(), 2, 5)
    starts = np.array([vector.reset(jax.random.key(seed)).obs[:, 0] for seed in range(400)])
    assert abs(np.corrcoef(starts.T)[0, 1]) < 4 / np.sqrt(400)
