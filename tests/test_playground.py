"""MuJoCo Playground's environments: the adapter, on a stand-in, and the real ones where they are installed."""

import importlib.util
import subprocess
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import envs
from envs.hints import pip_install
from envs.options import OptionError
from envs.playground_env import Playground
from jaxpg.evaluation import evaluate
from jaxpg.rollout import rollout
from jaxpg.vector_env import vectorize


@struct.dataclass
class State:
    """The fields of Playground's."""

    data: jax.Array
    obs: dict | jax.Array
    reward: jax.Array
    done: jax.Array
    metrics: dict
    info: dict


class Hopper:
    """Has Playground's ways: several observations, of which its step reads the last, keys and counters in the info."""

    action_size = 1

    def reset(self, rng):
        rng, key = jax.random.split(rng)
        position = jax.random.uniform(key)
        info = {"rng": rng, "steps": jnp.zeros((), jnp.int32)}
        return State(
            position, self.observe(position, 0.0), jnp.zeros(()), jnp.zeros(()), {"height": jnp.zeros(())}, info
        )

    def step(self, state, action):
        position = state.data + action[0]
        state.info["steps"] += 1
        obs = self.observe(position, state.obs["state"][0])
        metrics = {"height": position}
        return state.replace(data=position, obs=obs, reward=position, done=1.0 * (position > 2), metrics=metrics)

    def observe(self, position, before):
        return {"state": jnp.stack([position, before * jnp.ones(())]), "privileged_state": jnp.zeros(5)}


def hop(obs):
    return jnp.full((len(obs), 1), 0.25)


def hopping(obs, key):
    return hop(obs), hop(obs)


def test_the_entry_state_is_what_is_observed():
    env = Playground(Hopper())
    assert (env.observation_size, env.action_size) == (2, 1)
    state = env.reset(jax.random.key(0))
    after = env.step(state, jnp.array([0.5]))
    np.testing.assert_allclose(after.obs, [state.obs[0] + 0.5, state.obs[0]])


def test_no_keys_are_carried():
    """A checkpoint of numbers holds the whole state."""
    state = Playground(Hopper()).reset(jax.random.key(0))
    assert all(leaf.dtype in (np.float32, np.int32, np.uint32) for leaf in jax.tree.leaves(state))


def test_one_observation_is_left_as_it_is():
    class Plain(Hopper):
        def reset(self, rng):
            state = super().reset(rng)
            return state.replace(obs=state.obs["state"])

    assert Playground(Plain()).reset(jax.random.key(0)).obs.shape == (2,)


def test_rollouts_have_its_ends_and_the_time_limit_apart():
    """Starts below 0.25 reach the limit of seven steps before the height of 2, the others are done by then."""
    vector = vectorize(Playground(Hopper()), 8, 7)
    start = vector.reset(jax.random.key(0))
    _, steps = rollout(hopping, vector.step, start, jax.random.key(1), 7)
    early = np.asarray(start.obs[:, 0]) + 7 * 0.25 > 2
    assert 0 < early.sum() < 8
    np.testing.assert_array_equal(steps.terminated.sum(axis=0), early)
    np.testing.assert_array_equal(steps.truncated.sum(axis=0), ~early)


def test_evaluations_have_its_metrics():
    env = Playground(Hopper())
    episodes = evaluate(env, hop, jax.random.split(jax.random.key(0), 4), 3)
    starts = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 4)).obs[:, 0]
    np.testing.assert_allclose(episodes.metrics["height"], starts + 0.75, rtol=1e-6)
    np.testing.assert_allclose(episodes.episode_return, 3 * starts + 1.5, rtol=1e-6)


@pytest.fixture
def playground(monkeypatch):
    """A package of that name, with one environment; what loading it raises is what `broken` holds."""
    broken = []

    def load(name, config_overrides):
        assert config_overrides == {"impl": "jax"}
        if broken:
            raise broken[0]
        return Hopper()

    package = types.ModuleType("mujoco_playground")
    package.registry = types.SimpleNamespace(ALL_ENVS=("HopperHop", "CartpoleBalance"), load=load)
    package.__spec__ = importlib.util.spec_from_loader("mujoco_playground", None)
    monkeypatch.setitem(sys.modules, "mujoco_playground", package)
    return broken


def complaint(**options):
    with pytest.raises(OptionError) as error:
        envs.make("playground", **options)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_made_by_name(playground):
    assert isinstance(envs.make("playground", name="HopperHop").unwrapped, Hopper)


def test_unknown_names_are_answered_with_the_nearest(playground):
    assert complaint(name="HoperHop") == "unknown Playground environment 'HoperHop': did you mean 'HopperHop'?"


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (subprocess.CalledProcessError(128, ["git", "clone"]), "could not download"),
        (FileNotFoundError(2, "No such file or directory", "git"), "could not download"),
        (AttributeError("'MjSpec' object has no attribute 'find_body'"), "does not work with this release"),
    ],
)
def test_what_cannot_be_made_is_one_line(playground, error, words):
    playground.append(error)
    message = complaint(name="HopperHop")
    assert message.startswith("env.name=HopperHop: ")
    assert words in message


def test_a_missing_package_is_one_line(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert complaint() == f"env=playground needs MuJoCo Playground: {pip_install('playground')}"


def test_the_real_one_balances_for_a_moment():
    pytest.importorskip("mujoco_playground", reason="pip install playground")
    vector = vectorize(envs.make("playground"), 2, 3)

    @jax.jit
    def play(key, again):
        start = vector.reset(key)
        return start, rollout(hopping, vector.step, start, again, 4)[1]

    start, steps = play(jax.random.key(0), jax.random.key(1))
    assert start.obs.shape == (2, 5)
    assert len(np.unique(start.obs[:, 0])) == 2
    np.testing.assert_array_equal(steps.truncated[:, 0], [0, 0, 1, 0])
    assert not np.any(steps.terminated)
    assert np.all((steps.reward > 0.5) & (steps.reward <= 1))  # upright, in the middle


def test_robots_that_are_not_there_are_one_line():
    mjx_env = pytest.importorskip("mujoco_playground._src.mjx_env", reason="pip install playground")
    if mjx_env.MENAGERIE_PATH.exists():
        pytest.skip("MuJoCo Menagerie is there")
    assert "could not download" in complaint(name="Go1JoystickFlatTerrain")


@pytest.mark.study
def test_the_real_one_trains_and_is_evaluated(command, tmp_path):
    pytest.importorskip("mujoco_playground", reason="pip install playground")
    sizes = ("num_envs=8", "num_steps=4", "eval_episodes=2", "env.episode_length=8", "total_steps=64")
    run = tmp_path / "run"
    trained = command("train", "env=playground", "env.name=CartpoleBalance", *sizes, f"run_dir={run}", timeout=900)
    assert trained.returncode == 0, trained.stderr
    resumed = command("train", f"resume={run}", "total_steps=128", timeout=900)
    assert resumed.returncode == 0, resumed.stderr
    evaluated = command("evaluate", f"run={run}", "episodes=2", timeout=900)
    assert evaluated.returncode == 0, evaluated.stderr
    assert "reward/upright" in evaluated.stdout
