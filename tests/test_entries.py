"""One entry is enough for another algorithm or network: it trains, goes on, is evaluated and leaves for a robot."""

from dataclasses import dataclass

import optax
import pytest
from in_process import ended

from envs.options import option
from jaxpg import evaluate, export, train
from jaxpg.actor_critic import actor_critic
from jaxpg.config import command_options, schema
from jaxpg.config.entries import ALGORITHMS, NETWORKS, Entry
from jaxpg.config.schema import Common, Gaussian, number
from jaxpg.deploy import exporter
from jaxpg.distributions import GAUSSIAN, SQUASHED_GAUSSIAN
from jaxpg.methods import td
from jaxpg.networks import mlp_networks
from jaxpg.program import algorithms, networks
from jaxpg.program.compile import NAN_POLICIES
from jaxpg.program.networks import make_networks
from jaxpg.store.loggers import SERVICES
from jaxpg.vector_env import vectorize


@dataclass(frozen=True)
class Plain(Common):
    """Plain gradient steps."""

    step_size: float = number(0.01, "of the gradient", above=0)


def plain(config, env):
    batch = vectorize(env, config.run.num_envs, config.env.episode_length)
    method = td(config.algo.gamma, config.run.num_steps)
    return actor_critic(batch, make_networks(config, env), optax.sgd(config.algo.step_size), method)


@dataclass(frozen=True)
class Narrow(Gaussian):
    """A single hidden layer."""

    width: int = option(3, "hidden units", at_least=1)


def narrow(options, observation_size, action_size):
    distribution = SQUASHED_GAUSSIAN if options.squash else GAUSSIAN
    return mlp_networks(observation_size, action_size, [options.width], distribution=distribution)


SIZES = ("num_envs=4", "num_steps=5", "total_steps=40", "eval_episodes=2", "report=false", "cache=false")


@pytest.mark.parametrize("chosen", ["algo=plain", "network=narrow"])
def test_an_entry_is_all_that_a_new_one_needs(chosen, monkeypatch, tmp_path):
    monkeypatch.setitem(ALGORITHMS, "plain", Entry(Plain, plain))
    monkeypatch.setitem(NETWORKS, "narrow", Entry(Narrow, narrow))
    run = f"run={tmp_path / 'run'}"
    for main, *arguments in (
        (train.main, "env=quadratic", chosen, *SIZES, f"run_dir={tmp_path / 'run'}"),
        (train.main, f"resume={tmp_path / 'run'}", "total_steps=60"),
        (evaluate.main, run, "episodes=2", "cache=false"),
        (export.main, run),
    ):
        status, _, error = ended(main, arguments)
        assert (status, error) == (0, ""), arguments


def test_an_unknown_option_of_a_new_entry_is_named(monkeypatch):
    monkeypatch.setitem(NETWORKS, "narrow", Entry(Narrow, narrow))
    status, _, error = ended(train.main, ["env=quadratic", "network=narrow", "network.widht=2"])
    assert status == 2
    assert "did you mean 'network.width'?" in error


def test_names_of_options_are_those_of_the_functions():
    assert tuple(algorithms.ESTIMATORS) == schema.ESTIMATORS
    assert tuple(algorithms.BASELINES) == schema.BASELINES
    assert tuple(algorithms.RETURNS) == schema.RETURNS
    assert tuple(SERVICES) == schema.LOGGERS
    assert tuple(NAN_POLICIES) == schema.NAN_POLICIES
    assert tuple(networks.ACTIVATIONS) == schema.ACTIVATIONS
    assert schema.FEATURES == tuple(networks.FEATURES) == tuple(networks.NUM_FEATURES)
    assert tuple(networks.SIGMAS) == schema.SIGMAS
    assert tuple(exporter.FORMATS) == command_options.EXPORT_FORMATS
