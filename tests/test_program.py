"""From a configuration to an algorithm: what the options do."""

import dataclasses

import jax
import numpy as np
import pytest

import envs
from jaxpg.config.configuration import flatten
from jaxpg.config.parsing import compose
from jaxpg.program import algorithms
from jaxpg.program.algorithms import make_algorithm
from jaxpg.program.compile import compile_program
from jaxpg.program.environment import make_env
from jaxpg.program.schedule import plan
from jaxpg.program.state import get_policy
from jaxpg.training import train_scan

SIZES = ("env=quadratic", "network=linear", "num_envs=4", "num_steps=5", "total_steps=400", "env.episode_length=8")
SCHEDULED = ("network.sigma_is=scheduled", "network.sigma=0.8", "network.final_sigma=0.05")


@pytest.mark.parametrize("name", envs.REGISTRY)
def test_the_algorithm_is_the_first_that_the_environment_has_tuned(name):
    """With its values; those of an algorithm that was chosen are that one's."""
    tuned = envs.find(name).training
    assert compose([f"env={name}"]) == compose([f"env={name}", f"algo={next(iter(tuned))}"])
    for algo, values in tuned.items():
        found = flatten(compose([f"env={name}", f"algo={algo}"]))
        assert found.items() >= {option: value for option, value in values.items() if option != "network"}.items()


def test_features_tuned_for_one_network_say_nothing_of_another():
    """Those of a linear network would be thousands of inputs of an MLP; the policy's options are any network's."""
    tuned = envs.find("quadratic").training["td"]
    linear, mlp = (compose(["env=quadratic", f"network={name}"]).network for name in ("linear", "mlp"))
    assert (linear.features, mlp.features) == (tuned["network.features"], "identity")
    assert mlp.squash == linear.squash == tuned["network.squash"]
    assert compose(["env=pendulum", "network=linear"]).network.features == "identity"
    assert compose(["env=pendulum"]).network.features == "polynomial"


def test_tuned_shards_and_minibatches_divide_the_environments_asked_for():
    """Where nobody has asked for them; those that were are refused if they do not (tests/test_bad_input.py)."""
    tuned = envs.find("pendulum").training["ppo"]
    shards, minibatches = tuned["algo.num_shards"], tuned["algo.minibatches"]
    assert (shards, minibatches) == (2, 8)

    def found(*arguments):
        algo = compose(arguments).algo
        return algo.num_shards, algo.minibatches

    assert found() == (2, 8)
    assert [found(f"num_envs={n}") for n in (1, 2, 12, 64)] == [(1, 1), (2, 1), (2, 6), (2, 8)]
    assert found("num_envs=8", "algo.minibatches=8") == (1, 8)
    assert found("num_envs=8", "algo.minibatches=4") == (2, 4)
    assert found("algo.num_shards=128") == (128, 4)
    assert found("num_envs=8", "algo.num_shards=4") == (4, 2)


@pytest.mark.parametrize("algo", [("algo=td",), ("algo=ppo", "algo.epochs=3", "algo.minibatches=2")])
def test_sigma_follows_its_schedule(algo):
    """From the first value to the last by equal factors, whatever the gradients say; once in the whole run."""
    config = compose([*SIZES, *SCHEDULED, *algo])
    updates = plan(config).num_updates
    state, metrics = jax.jit(lambda key: train_scan(make_algorithm(config, make_env(config)), key, updates))(
        jax.random.key(0)
    )
    np.testing.assert_allclose(np.exp(state.params["actor"]["params"]["log_std"]), 0.05, rtol=1e-4)
    if algo[0] == "algo=td":  # of several gradient steps the metric is the mean
        np.testing.assert_allclose(metrics["sigma"], 0.8 * (0.05 / 0.8) ** (np.arange(updates) / updates), rtol=1e-4)


@pytest.mark.optimized
def test_other_parameters_learn_as_ever_while_sigma_is_scheduled():
    """The first step: that of a learned sigma, but for sigma."""
    steps = []
    for sigma in SCHEDULED[:1], ("network.sigma_is=learned",):
        config = compose([*SIZES, *SCHEDULED[1:], *sigma])
        # Gradients are not shortened: sigma's would be part of the length.
        config = dataclasses.replace(config, algo=dataclasses.replace(config.algo, max_gradient_norm=1e9))
        algorithm = make_algorithm(config, make_env(config))
        steps.append(jax.jit(lambda key, a=algorithm: train_scan(a, key, 1))(jax.random.key(0))[0].params)
    (of_schedule, mean), (of_gradient, same_mean) = (
        (params["actor"]["params"].pop("log_std"), params) for params in steps
    )
    jax.tree.map(np.testing.assert_array_equal, mean, same_mean)
    assert abs(of_schedule - of_gradient).max() > 1e-3


def test_ppo_is_made_of_its_options(monkeypatch):
    given = []
    monkeypatch.setattr(algorithms, "ppo", lambda *arguments, **options: given.append(options))
    options = ("algo.epochs=3", "algo.minibatches=2", "algo.clip=null", "algo.max_kl=0.1", "algo.value_clip=0.5")
    config = compose(["algo=ppo", "algo.num_shards=1", *options])
    make_algorithm(config, make_env(config))
    expected = {"epochs": 3, "minibatches": 2, "clip": None, "max_kl": 0.1, "value_clip": 0.5}
    assert expected.items() <= given[0].items()


def trained(*options, chunks=2):
    """The state after some chunks, its evaluation, and the metrics."""
    config = compose([*SIZES, "log_interval=40", "eval_episodes=4", *options])
    program = compile_program(config, make_env(config), chunk=2)
    train = program.init().train
    for _ in range(chunks):
        train, metrics = program.advance(train)
    assert jax.tree.map(np.shape, train) == jax.tree.map(np.shape, program.state_shape.train)
    return train, metrics, program.evaluate(get_policy(train))


def test_agents_side_by_side_are_the_agents_alone():
    """To the bit, parameters, metrics and evaluations: they are computed by the same program."""
    together = trained("seed=3", "num_seeds=3")
    for i in range(3):
        alone = trained(f"seed={3 + i}")
        jax.tree.map(lambda a, b, i=i: np.testing.assert_array_equal(a[i : i + 1], b), together, alone)
    assert len(np.unique(together[2].episode_return.sum(axis=1))) == 3


def test_agents_in_one_program_are_the_agents_alone():
    """To rounding, two in each of two programs."""
    with jax.debug_key_reuse(False):  # see test_vmapped_seeds_are_single_seeds
        together = trained("num_seeds=4", "vmap_seeds=2")
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), together, trained("num_seeds=4"))


SWEEP = ("sweep.algo.gamma=[0.9,0.99]", "sweep.network.sigma=[0.3,0.6]")


def test_agents_of_a_sweep_are_the_agents_of_their_settings():
    """To the bit those of a sweep of that setting alone; to rounding those with the values as constants."""
    together = trained("seed=3", "num_seeds=2", *SWEEP)
    for i, gamma, sigma, seed in ((2, 0.9, 0.6, 3), (7, 0.99, 0.6, 4)):
        agent = jax.tree.map(lambda x, i=i: x[i : i + 1], together)
        swept = trained(f"seed={seed}", f"sweep.algo.gamma=[{gamma}]", f"sweep.network.sigma=[{sigma}]")
        jax.tree.map(np.testing.assert_array_equal, agent, swept)
        alone = trained(f"seed={seed}", f"algo.gamma={gamma}", f"network.sigma={sigma}")
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), agent, alone)
    assert len(np.unique(together[2].episode_return.sum(axis=1))) == 8


def test_settings_in_one_program_are_the_settings_alone():
    """To rounding."""
    with jax.debug_key_reuse(False):  # see test_vmapped_seeds_are_single_seeds
        together = trained("vmap_seeds=4", *SWEEP)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), together, trained(*SWEEP))


@pytest.mark.parametrize("algo", ["td", pytest.param("ppo", marks=pytest.mark.study)])
def test_training_episodes_are_cut_as_by_a_shorter_time_limit(algo):
    """To the bit the training with that limit, where evaluations keep the longer one; and not that without the cut."""

    def trained(limit, *options):
        config = compose([*SIZES[:-1], f"env.episode_length={limit}", f"algo={algo}", *options])
        return jax.jit(lambda key: train_scan(make_algorithm(config, make_env(config)), key, 4))(jax.random.key(0))

    (state, metrics), shorter = trained(8, "algo.episode_length=4"), trained(4)
    jax.tree.map(np.testing.assert_array_equal, (state, metrics), shorter)
    assert metrics["episodes"].sum() > 1.5 * trained(8)[1]["episodes"].sum()
