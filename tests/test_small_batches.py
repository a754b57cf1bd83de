"""Batches that cannot teach are refused, and the smallest ones that can do teach."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.base import initial_state
from envs.options import OptionError, option
from jaxpg.config.conflicts import EPISODE_MEANS
from jaxpg.config.parsing import compose
from jaxpg.estimators import normalize_advantages
from jaxpg.program.algorithms import BASELINES, make_algorithm
from jaxpg.program.environment import make_env
from jaxpg.training import train_scan

BEST = 0.5


@dataclass(frozen=True)
class Options:
    episode_length: int = option(3, "steps", at_least=1)


class Target:
    """Reward -(action - 0.5)^2 and 10 for nothing; an episode ends with its first step."""

    observation_size = action_size = 1

    def __init__(self, config):
        self.config = config

    def reset(self, key):
        return initial_state(jnp.zeros(()), jnp.ones(1))

    def step(self, state, action):
        return state.replace(reward=10 - jnp.square(action[0] - BEST), done=jnp.ones(()))


@pytest.fixture
def target(monkeypatch):
    monkeypatch.setitem(envs.REGISTRY, "target", envs.Entry(Options, Target, {"td": {}}))
    return ("env=target", "network=linear", "num_envs=1")


REFUSED = {
    "td, one step": (["algo=td", "num_steps=1"], "num_envs=1 num_steps=1"),
    "ppo, one step": (["algo=ppo", "num_steps=1"], "num_envs=1 num_steps=1"),
    "reinforce, one step": (["algo=reinforce", "env.episode_length=1"], "num_envs=1 num_steps=1"),
    "whole returns of one episode": (["algo=reinforce", "algo.returns=whole"], "algo.returns=whole"),
    **{
        name: (["algo=reinforce", f"algo.baseline={name}", *rest], f"algo.baseline={name} needs other episodes")
        for name in ("mean", "time_mean", "optimal", "leave_one_out")
        for rest in ([], ["algo.normalize_advantages=false"])
    },
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_teach_is_refused(case, target):
    arguments, message = REFUSED[case]
    with pytest.raises(OptionError) as error:
        compose([*target, *arguments])
    assert len(error.value.problems) == 1
    assert message in error.value.problems[0]
    compose([*target[:-1], "num_envs=2", *arguments])


RAW = ["algo.normalize_advantages=false"]
LESSONS = {
    "td, one step": ["algo=td", "num_steps=1", *RAW],
    "td, two steps": ["algo=td", "num_steps=2"],
    "reinforce, episodes of one step": ["algo=reinforce", "algo.baseline=value"],
    "no baseline": ["algo=reinforce", "algo.baseline=none"],
    "whole returns": ["algo=reinforce", "algo.baseline=value", "algo.returns=whole", *RAW],
    "two episodes": ["algo=reinforce", "algo.baseline=time_mean", "num_envs=2"],
}


@pytest.mark.parametrize("case", LESSONS)
def test_what_can_teach_moves_the_policy(case, target):
    """No gradient is 0 in all of the updates: with a single episode of one step its advantage stays as it is."""
    given = dict(option.split("=") for option in (*target, *LESSONS[case]))
    config = compose([f"{name}={value}" for name, value in given.items()])
    algorithm = make_algorithm(config, make_env(config))
    train = jax.jit(lambda key: train_scan(algorithm, key, 20))
    _, metrics = train(jax.random.key(0))
    assert (np.abs(metrics["policy_loss"]) > 1e-4).mean() > 0.5


@pytest.mark.parametrize("weight", [np.eye(3, 2)[:1], np.array([[1.0, 0.0], [0.0, 0.0]])])
def test_a_single_advantage_stays_as_it_is(weight):
    advantage = np.full(weight.shape, 7.0)
    np.testing.assert_array_equal(normalize_advantages(advantage, weight), advantage)


@pytest.mark.parametrize("size", [2, 3, 1000])
@pytest.mark.parametrize("value", [1e-6, 0.1, -1e6])
def test_equal_advantages_become_nothing_and_no_noise(size, value):
    """What rounding leaves of them is not made as large as what a difference would be."""
    found = normalize_advantages(np.full(size, value, np.float32))
    assert np.abs(found).max() < 0.02


def test_baselines_that_need_others_are_all_known():
    assert {*EPISODE_MEANS, "none", "value"} == {*BASELINES}
