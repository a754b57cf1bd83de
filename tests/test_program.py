"""From a configuration to an algorithm: what the options do."""

import dataclasses

import jax
import numpy as np
import pytest

from jaxpg.actor_critic import Reuse
from jaxpg.run.config import compose
from jaxpg.run.program import make_algorithm, make_env, make_reuse, plan
from jaxpg.training import train_scan

SIZES = ("env=quadratic", "network=linear", "num_envs=4", "num_steps=5", "total_steps=400", "env.episode_length=8")
SCHEDULED = ("network.sigma_is=scheduled", "network.sigma=0.8", "network.final_sigma=0.05")


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


def test_reuse_is_what_the_options_say():
    options = ("algo.epochs=3", "algo.minibatches=2", "algo.clip=null", "algo.max_kl=0.1", "algo.value_clip=0.5")
    assert make_reuse(compose(["algo=ppo", *options])) == Reuse(3, 2, None, 0.5, 0.1)
    assert make_reuse(compose(["algo=td"])) is None


@pytest.mark.parametrize("algo", ["td", "ppo"])
def test_training_episodes_are_cut_as_by_a_shorter_time_limit(algo):
    """To the bit the training with that limit, where evaluations keep the longer one; and not that without the cut."""

    def trained(limit, *options):
        config = compose([*SIZES[:-1], f"env.episode_length={limit}", f"algo={algo}", *options])
        return jax.jit(lambda key: train_scan(make_algorithm(config, make_env(config)), key, 4))(jax.random.key(0))

    (state, metrics), shorter = trained(8, "algo.episode_length=4"), trained(4)
    jax.tree.map(np.testing.assert_array_equal, (state, metrics), shorter)
    assert metrics["episodes"].sum() > 1.5 * trained(8)[1]["episodes"].sum()
