"""What is no measurement (NaN, infinite, absurdly large) gets the command 0 in every format, and so from JAX."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stored import a_policy

from jaxpg.config.schema import ACTIVATIONS, FEATURES
from jaxpg.deploy import c
from jaxpg.deploy.controller import make_command, make_controller
from jaxpg.deploy.exporter import FORMATS
from jaxpg.normalization import RunningStatistics

INVALID = (np.nan, np.inf, -np.inf, 1e30, -3e38)
ENVS = {"limits": "env=pendulum", "no limits": "env=quadratic"}


def configurations():
    """Every activation with every features; with each of them squash and limits in turn."""
    for number, (features, activation) in enumerate(itertools.product(FEATURES, ACTIVATIONS)):
        turn = sum(divmod(number, len(ACTIVATIONS)))
        yield features, activation, turn % 2 == 0, list(ENVS)[turn // 2 % 2]


CONFIGURATIONS = {f"{f}-{a}-{'tanh' if s else 'plain'}-{e}": (f, a, s, e) for f, a, s, e in configurations()}


def a_stored(features, activation, squash, limits):
    size = ("env.state_size=2",) if limits == "no limits" else ()
    network = ("network=mlp", "network.widths=[6,5]", f"network.activation={activation}")
    phi = (f"network.features={features}", "network.order=2", f"network.squash={str(squash).lower()}")
    return a_policy(ENVS[limits], "algo=td", *size, *network, *phi)


def invalid_rows(stored):
    """Training's mean with one number replaced, or all of them."""
    mean = np.asarray(stored.policy.normalizer.mean)
    rows = [np.where(np.arange(len(mean)) == i, bad, mean) for bad in INVALID for i in range(len(mean))]
    return np.array([*rows, *(np.full(len(mean), bad) for bad in INVALID)], np.float32)


def valid_rows(stored):
    """Near training's mean, and a hundred thousand deviations away from it in each direction."""
    normalizer = stored.policy.normalizer
    near = np.random.default_rng(0).normal(size=(20, len(normalizer.mean)))
    far = 1e5 * np.concatenate([np.eye(len(normalizer.mean)), -np.eye(len(normalizer.mean))])
    deviations = np.concatenate([near, far])
    return np.asarray(normalizer.mean + np.sqrt(normalizer.variance) * deviations, np.float32)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """`written(name) -> (stored, controller, {form: commands})`, JAX among the forms."""
    made = {}

    def make(name):
        if name not in made:
            stored, folder = a_stored(*CONFIGURATIONS[name]), tmp_path_factory.mktemp("written")
            control, command = make_controller(stored, {}), make_command(stored)
            forms = {"jax": jax.jit(command)}
            for form, way in FORMATS.items():
                way.write(control, folder, command)
                forms[form] = way.load(control, folder)
            made[name] = stored, control, forms
        return made[name]

    return make


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_the_command_is_zero_in_every_format(name, written):
    stored, control, forms = written(name)
    valid, invalid = valid_rows(stored), invalid_rows(stored)
    rows = np.concatenate([valid, invalid, valid])  # no row disturbs another
    for form, commands in forms.items():
        found = np.split(np.asarray(commands(rows)), [len(valid), len(valid) + len(invalid)])
        np.testing.assert_array_equal(found[1], np.zeros((len(invalid), control.action_size)), err_msg=form)
        np.testing.assert_array_equal(found[0], found[2], err_msg=form)
        assert np.isfinite(found[0]).all()
        assert (found[0] != 0).all()
        assert np.ptp(found[0]) > 1e-3


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_far_away_all_formats_agree(name, written):
    """To 1e-5 of the largest command; where there are limits it is theirs."""
    stored, _, forms = written(name)
    rows = valid_rows(stored)
    expected = np.asarray(forms["jax"](rows))
    for form, commands in forms.items():
        np.testing.assert_allclose(commands(rows), expected, rtol=0, atol=1e-5 * np.abs(expected).max(), err_msg=form)


FLAGGED = """
#include <stdio.h>
#include "pendulum.h"
int main(void) {
    float s[PENDULUM_OBSERVATIONS], command[PENDULUM_COMMANDS];
    for (;;) {
        for (int i = 0; i < PENDULUM_OBSERVATIONS; i++)
            if (scanf("%f", &s[i]) != 1) return 0;
        int valid = pendulum_command(s, command);
        printf("%d %.9g\\n", valid, (double)command[0]);
    }
}
"""
OPTIMIZATIONS = {"as usual": (), "fast": ("-O3", "-ffast-math"), "none": ("-O0",), "size": ("-Os", "-ffast-math")}


@pytest.mark.parametrize("flags", OPTIMIZATIONS)
@pytest.mark.parametrize("name", [name for name in CONFIGURATIONS if name.endswith("-limits")])
def test_c_says_so_with_any_flags(name, flags, tmp_path, monkeypatch):
    """-ffast-math lets a compiler take for granted that no number is NaN."""
    stored = a_stored(*CONFIGURATIONS[name])
    control = make_controller(stored, {})
    c.write(control, tmp_path)
    (tmp_path / "flagged.c").write_text(FLAGGED)
    monkeypatch.setattr(c, "FLAGS", (*c.FLAGS, *OPTIMIZATIONS[flags]))
    run = c.compile_example(control, tmp_path / "flagged.c")
    np.testing.assert_array_equal(run(invalid_rows(stored)), np.zeros((len(invalid_rows(stored)), 2)))
    found = run(valid_rows(stored))
    assert (found[:, 0] == 1).all()
    np.testing.assert_allclose(found[:, 1:], make_command(stored)(valid_rows(stored)), rtol=0, atol=2e-5)


def test_a_constant_of_training_must_be_a_number_too(tmp_path):
    """Where nothing varied the network does not see the observation; NaN is none all the same."""
    stored = a_policy("env=pendulum", "network.activation=relu", "network.widths=[6]")
    mean, variance = stored.policy.normalizer.mean, jnp.array([0.0, 1.0, 1.0])
    normalizer = RunningStatistics(jnp.array(100.0), mean, variance)
    stored = stored._replace(policy=stored.policy._replace(normalizer=normalizer))
    rows = np.tile(np.asarray(mean), (3, 1))
    rows[:, 0] = [mean[0], np.nan, np.inf]
    control, command = make_controller(stored, {}), make_command(stored)
    for form, way in FORMATS.items():
        way.write(control, tmp_path, command)
        for found in (way.load(control, tmp_path)(rows), command(rows)):
            assert found[0] != 0, form
            np.testing.assert_array_equal(found[1:], np.zeros((2, 1)), err_msg=form)


def test_an_action_that_is_not_finite_commands_zero(tmp_path):
    """Weights of 1e30 behind a valid observation: inf - inf."""
    stored = a_policy("env=pendulum", "network.widths=[4,4]", "network.activation=relu")
    enormous = jax.tree.map(lambda x: jnp.where(x < 0, -1e30, 1e30) if x.ndim > 1 else x, stored.policy.params["actor"])
    policy = stored.policy._replace(params={**stored.policy.params, "actor": enormous})
    stored = stored._replace(policy=policy)
    rows = valid_rows(stored)
    with jax.debug_nans(False):
        raw = stored.act(policy, rows)
    control, command = make_controller(stored, {}), make_command(stored)
    zero = np.isnan(np.asarray(raw))
    assert zero.any()
    for form, way in FORMATS.items():
        way.write(control, tmp_path, command)
        np.testing.assert_array_equal(way.load(control, tmp_path)(rows)[zero], 0, err_msg=form)
    np.testing.assert_array_equal(np.asarray(command(rows))[zero], 0)


# --- going on with learning -------------------------------------------------------------------------------------------

ONLINE = ("env=pendulum", "algo=online", "network=linear", "network.features=polynomial", "network.order=2")
STEPS = {  # what of a step is bad, and whether nothing is learned
    "observation": (slice(0, 1), np.nan, 0.0, True),
    "u": (slice(3, 4), np.inf, 0.0, True),
    "reward": (slice(4, 5), np.nan, 0.0, True),
    "next observation": (slice(5, 6), -np.inf, 0.0, True),
    "the last one of a task": (slice(5, 8), np.nan, 1.0, False),
}


@pytest.mark.parametrize("name", STEPS)
def test_nothing_is_learned_from_it(name, tmp_path):
    """The parameters stay as they were, and are learned again from the next step on."""
    place, bad, terminated, nothing = STEPS[name]
    control = make_controller(a_policy(*ONLINE, "algo.actor_lr=1e-3", "algo.critic_lr=1e-3"), {})
    c.write(control, tmp_path)
    steps = np.random.default_rng(0).normal(size=(5, 3 + 1 + 1 + 3 + 2))
    steps[:, -2:] = 0
    steps[2, place], steps[2, -2] = bad, terminated
    found = c.compile_example(control, tmp_path / "learn.c")(steps)
    assert np.isfinite(found).all()
    moved = np.abs(np.diff(found, axis=0)).max(axis=1)
    assert (moved[[0, 2, 3]] > 0).all()
    assert (moved[1] == 0) == nothing


SAMPLED = """
#include <stdio.h>
#include "pendulum.h"
int main(void) {
    pendulum_learner learner;
    float s[3], noise[1] = {1}, u[1], command[1] = {7};
    pendulum_begin(&learner);
    while (scanf("%f %f %f", &s[0], &s[1], &s[2]) == 3) {
        int valid = pendulum_sample(&learner, s, noise, u, command);
        printf("%d %.9g\\n", valid, (double)command[0]);
    }
    return 0;
}
"""


def test_a_sample_of_the_learner_is_zero_too(tmp_path):
    stored = a_policy(*ONLINE)
    control = make_controller(stored, {})
    c.write(control, tmp_path)
    (tmp_path / "sampled.c").write_text(SAMPLED)
    run = c.compile_example(control, tmp_path / "sampled.c")
    np.testing.assert_array_equal(run(invalid_rows(stored)), np.zeros((len(invalid_rows(stored)), 2)))
    assert (run(valid_rows(stored)[:20]) != 0).all()
