"""The environments as Gymnasium's: what its own tools see, one by one and as a batch."""

import dataclasses
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from exploding import Blind, ExplodingConfig
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from probes import Counter

import envs
import jaxpg.gymnasium
from envs.options import OptionError, option
from jaxpg.gymnasium_env import Batch, Single, make

ROOT = Path(__file__).parent.parent
PENDULUM, ARM = "jaxpg/Pendulum-v0", "jaxpg/Arm-v0"


class Fragile(Counter):
    """Its third step leaves the range of numbers."""

    def step(self, state, action):
        after = super().step(state, action)
        return after.replace(obs=jnp.where(after.obs[1] == 3, jnp.inf, after.obs))


def in_a_fresh_process(code):
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_registering_loads_neither_jax_nor_the_physics():
    loaded = in_a_fresh_process("import sys, gymnasium, jaxpg.gymnasium; print(*sys.modules)")
    assert "gymnasium" in loaded
    assert not {"jax", "flax", "mujoco", "brax", "envs"} & set(loaded)


def test_a_name_alone_makes_an_environment():
    code = "import gymnasium; env = gymnasium.make('jaxpg.gymnasium:jaxpg/Pendulum-v0'); print(*env.reset(seed=0)[0])"
    assert len(in_a_fresh_process(code)) == 3


@pytest.mark.parametrize(("name", "env", "limit"), jaxpg.gymnasium.ENVIRONMENTS)
def test_time_limits_are_the_environments_own(name, env, limit):
    assert limit == envs.REGISTRY[env].config().episode_length == gymnasium.spec(name).max_episode_steps


@pytest.mark.parametrize("name", [PENDULUM, ARM])
def test_gymnasiums_checker_has_nothing_to_say(name):
    """But that it would rather have actions in [-1, 1], and that the arm's speeds have no bound."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        check_env(gymnasium.make(name).unwrapped)
    said = [str(warning.message) for warning in said]
    assert any("normalized" in line for line in said)
    rest = [line for line in said if "normalized" not in line and not (name == ARM and "infinity" in line)]
    assert rest == []


def test_the_pendulum_has_gymnasiums_spaces():
    ours, theirs = gymnasium.make(PENDULUM), gymnasium.make("Pendulum-v1")
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space


def test_the_pendulum_is_gymnasiums():
    """An episode under random torques, some beyond the limit; after each step both stand in the same state again."""
    ours, theirs = gymnasium.make(PENDULUM), gymnasium.make("Pendulum-v1")
    obs, _ = ours.reset(seed=1)
    theirs.reset(seed=1)
    random = np.random.default_rng(0)
    for t in range(200):
        theirs.unwrapped.state = np.array([np.arctan2(obs[1], obs[0]), obs[2]], float)
        torque = random.uniform(-3, 3, 1).astype(np.float32)
        (obs, reward, *ends, _), (true_obs, true_reward, *true_ends, _) = ours.step(torque), theirs.step(torque)
        np.testing.assert_allclose(obs, true_obs, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(reward, true_reward, rtol=1e-5, atol=1e-5)
        assert ends == true_ends == [False, t == 199]


@pytest.mark.parametrize("name", [PENDULUM, ARM])
def test_a_batch_plays_what_single_environments_play(name):
    """Over several episodes, which end at different times: starts, steps, ends, and what the metrics are said of."""
    batch = gymnasium.make_vec(name, num_envs=3, max_episode_steps=5)
    singles = gymnasium.make_vec(name, num_envs=3, max_episode_steps=5, vectorization_mode="sync")
    assert batch.metadata["autoreset_mode"] == singles.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    for space in ("single_observation_space", "single_action_space", "observation_space", "action_space"):
        assert getattr(batch, space) == getattr(singles, space)
    mask = np.array([False, True, False])
    random = np.random.default_rng(0)
    played = [[env.reset(seed=7)] for env in (batch, singles)]
    for t in range(16):
        actions = random.uniform(-2, 2, batch.action_space.shape).astype(np.float32)
        for env, results in zip((batch, singles), played, strict=True):
            results.append(env.step(actions))
            if t == 2:
                results.append(env.reset(options={"reset_mask": mask.copy()}))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), *played)
    ended = np.array([result[3] for result in played[0] if len(result) == 5])
    assert {tuple(column) for column in ended[:6].T} == {(0, 0, 0, 0, 1, 0), (0, 0, 0, 0, 0, 0)}
    assert (ended.sum(axis=0) == 2).all()


def test_a_seed_is_this_projects_key():
    env = gymnasium.make(PENDULUM)
    own = jax.jit(envs.make("pendulum").reset)
    for seed, same in ((3, 3), (2**32 - 1, 2**32 - 1), (2**32 + 5, 5)):
        np.testing.assert_array_equal(env.reset(seed=seed)[0], own(jax.random.key(same)).obs)


def test_episodes_after_a_seed_are_fresh_and_repeatable():
    env = gymnasium.make(PENDULUM)

    def starts(seed):
        return np.array([env.reset(seed=seed)[0], *(env.reset()[0] for _ in range(4))])

    first = starts(0)
    assert len(np.unique(first[:, 2])) == 5
    np.testing.assert_array_equal(first, starts(0))
    assert not np.isin(first[:, 2], starts(1)[:, 2]).any()


def test_without_a_seed_every_environment_begins_elsewhere():
    obs = [gymnasium.make_vec(PENDULUM, num_envs=3).reset()[0] for _ in range(2)]
    assert len(np.unique(np.concatenate(obs)[:, 2])) == 6


def test_keyword_arguments_are_the_environments_options():
    env, own = gymnasium.make(ARM, control="velocity", velocity_limit=3.0), envs.make("arm", control="velocity")
    assert env.action_space.high.tolist() == [3.0, 3.0]
    env.reset(seed=0)
    obs, reward, _, _, info = env.step(np.array([3.0, -1.5], np.float32))
    before = jax.jit(own.reset)(jax.random.key(0))
    after = jax.jit(own.step)(before, jnp.array([3.0 / 4.0, -1.5 / 4.0]))
    np.testing.assert_allclose(obs, after.obs, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(reward, after.reward, rtol=1e-5)
    assert info == {name: pytest.approx(float(value), rel=1e-5) for name, value in after.metrics.items()}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mas": 2.0}, "unknown option 'mas': did you mean 'mass'?"),
        ({"mass": -1.0}, "mass=-1.0: must be above 0"),
        ({"episode_length": 50}, "episode_length: Gymnasium calls the time limit max_episode_steps"),
    ],
)
@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_mistakes_in_the_options_are_named(make, options, message):
    with pytest.raises(OptionError) as error:
        make(PENDULUM, **options)
    assert str(error.value) == message


def test_a_render_mode_is_refused_with_a_type_error():
    with pytest.raises(TypeError, match="cannot render"):
        gymnasium.make(PENDULUM, render_mode="rgb_array")


def test_the_time_limit_is_gymnasiums():
    env = gymnasium.make(PENDULUM, max_episode_steps=3)
    env.reset(seed=0)
    assert [env.step(np.zeros(1, np.float32))[3] for _ in range(3)] == [False, False, True]
    endless = gymnasium.make_vec(PENDULUM, num_envs=1, max_episode_steps=-1)
    endless.reset(seed=0)
    assert not any(endless.step(np.zeros((1, 1)))[3].any() for _ in range(201))


def test_termination_comes_from_the_environment():
    single, batch = Single(Counter(life=2)), Batch(Counter(life=2), num_envs=2)
    single.reset(seed=0)
    batch.reset(seed=0)
    one, two = np.zeros(1, np.float32), np.zeros((2, 1), np.float32)
    assert [single.step(one)[2] for _ in range(2)] == [False, True]
    ends = np.array([batch.step(two)[2] for _ in range(6)])
    np.testing.assert_array_equal(ends, np.repeat([[0], [1], [0]] * 2, 2, axis=1))


def test_a_physics_that_diverges_ends_its_episode():
    single, batch = Single(Fragile()), Batch(Fragile(), num_envs=2)
    single.reset(seed=0)
    batch.reset(seed=0)
    batch.step(np.zeros((2, 1)))
    batch.reset(seed=5, options={"reset_mask": np.array([False, True])})  # a step behind the first
    for _ in range(2):
        before, *_ = single.step(np.zeros(1))
        _, reward, terminated, _, _ = batch.step(np.zeros((2, 1)))
    assert reward.tolist() == [0, 1]
    assert terminated.tolist() == [True, False]
    after, reward, terminated, _, _ = single.step(np.zeros(1))
    np.testing.assert_array_equal(after, before)
    assert (reward, terminated) == (0, True)


def test_a_physics_that_diverges_out_of_sight_ends_its_episode():
    """Only the angle tells, which grows tenfold with each step; what is seen and paid are its sine."""
    env = Single(Blind(ExplodingConfig(share=1.0)))
    env.reset(seed=0)
    ends = [env.step(np.zeros(1))[2] for _ in range(12)]
    assert ends.index(True) in (9, 10, 11)


def test_spaces_of_environments_that_do_not_say():
    assert Single(Counter()).action_space == gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    unlimited = Single(envs.make("quadratic"))
    assert unlimited.action_space == gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    unlimited.reset(seed=0)
    assert unlimited.step(np.array([5.0]))[0] == pytest.approx([0.5 + 0.1 * 5.0])


def test_observations_belong_to_the_caller():
    for env in (Single(Counter()), Batch(Counter(), num_envs=2)):
        first, _ = env.reset(seed=0)
        kept = first.copy()
        env.step(np.zeros(env.action_space.shape))[0][:] = -1
        np.testing.assert_array_equal(first, kept)


def test_misuse_is_named():
    batch = gymnasium.make_vec(PENDULUM, num_envs=2)
    with pytest.raises(gymnasium.error.ResetNeeded):
        batch.step(np.zeros((2, 1)))
    with pytest.raises(ValueError, match="expected 2 seeds, one for each environment, not 3"):
        batch.reset(seed=[1, 2, 3])
    batch.reset(seed=[1, None])
    with pytest.raises(ValueError, match="shape"):
        batch.step(np.zeros(2))


@dataclasses.dataclass(frozen=True)
class OddConfig(envs.REGISTRY["quadratic"].config):
    """Has a list, so that it is no key of a dictionary."""

    weights: list[float] = option([1.0], "of nothing")


def test_environments_of_equal_options_are_one_also_where_an_option_is_a_list(monkeypatch):
    monkeypatch.setitem(envs.REGISTRY, "odd", envs.Entry(OddConfig, envs.REGISTRY["quadratic"].build, {}))
    first, second, other = (make("odd", weights=weights).env for weights in ([1.0], [1.0], [2.0]))
    assert first is second
    assert first is not other
