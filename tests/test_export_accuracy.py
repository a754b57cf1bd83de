"""Errors of an export are counted in units of the limit, against float64; what it is tried on is what it says."""

import itertools
import math
import re

import exploding  # noqa: F401, which registers environments
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stored import a_policy

from envs.base import Interface, initial_state
from jaxpg import export as command_line
from jaxpg import normalization
from jaxpg.config.schema import ACTIVATIONS, FEATURES
from jaxpg.deploy import c_learner, header, reference
from jaxpg.deploy.controller import collect_observations, make_controller, play_observations
from jaxpg.deploy.exporter import FORMATS, TOLERANCE, make_trial
from jaxpg.errors import UserError
from jaxpg.normalization import RunningStatistics

# --- the reference: by loops over single numbers ----------------------------------------------------------------------


def looped_features(name, z, order):
    n = len(z)
    if name == "identity":
        return list(z)
    if name == "polynomial":
        degrees = range(1, order + 1)
        choices = [c for d in degrees for c in itertools.combinations_with_replacement(range(n), d)]
        return [math.prod(z[i] for i in c) for c in choices]
    if name == "fourier":
        unit = [(min(max(x, -3.0), 3.0) + 3) / 6 for x in z]
        grid = [c for c in itertools.product(range(order + 1), repeat=n) if any(c)]
        return [math.cos(math.pi * sum(a * b for a, b in zip(c, unit, strict=True))) for c in grid]
    centres = [-3 + 6 * j / (order - 1) for j in range(order)]
    weights = [[math.exp(-(((x - m) * (order - 1) / 6) ** 2) / 2) for m in centres] for x in z]
    shares = [[w / sum(row) for w in row] for row in weights]
    return [
        math.prod(row[j] for row, j in zip(shares, c, strict=True)) for c in itertools.product(range(order), repeat=n)
    ]


LOOPED = {
    "tanh": math.tanh,
    "relu": lambda x: max(x, 0.0),
    "elu": lambda x: x if x > 0 else math.exp(x) - 1,
    "swish": lambda x: x / (1 + math.exp(-x)),
}


def looped_command(control, s):
    z = [(float(a) - float(m)) * float(k) for a, m, k in zip(s, control.mean, control.scale, strict=True)]
    x = looped_features(control.features, z, control.order)
    for number, (weight, bias) in enumerate(control.layers):
        x = [sum(float(weight[i, j]) * x[i] for i in range(len(x))) + float(bias[j]) for j in range(len(bias))]
        x = [LOOPED[control.activation](y) for y in x] if number < len(control.layers) - 1 else x
    x = [math.tanh(y) for y in x] if control.squash else x
    limits = control.interface.limits
    return x if limits is None else [k * min(max(y, -1.0), 1.0) for y, k in zip(x, limits, strict=True)]


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("features", FEATURES)
def test_the_reference_is_the_formula(features, activation):
    squash = (len(features) + len(activation)) % 2 == 0
    network = ("network.order=3", f"network.activation={activation}", f"network.squash={str(squash).lower()}")
    stored = a_policy("env=pendulum", "network.widths=[5,4]", f"network.features={features}", *network)
    control = make_controller(stored, {})
    obs = np.random.default_rng(0).normal(size=(5, control.observation_size)).astype(np.float32)
    expected = [looped_command(control, s) for s in obs]
    np.testing.assert_allclose(reference.compute_commands(control, obs), expected, rtol=0, atol=1e-12)


# --- good controllers are written -------------------------------------------------------------------------------------


def changed(stored, limits=None, mean=0.0, gain=1.0):
    """The same with other limits, an offset of all observations, and steeper in the first layer."""
    interface = stored.interface if limits is None else stored.interface._replace(limits=limits)
    normalizer = stored.policy.normalizer
    normalizer = normalizer._replace(mean=normalizer.mean + mean)
    first = ("actor", "params", "MLP_0", "Dense_0", "kernel")
    params = jax.tree_util.tree_map_with_path(
        lambda path, x: gain * x if tuple(key.key for key in path) == first else x, stored.policy.params
    )
    return stored._replace(interface=interface, policy=stored.policy._replace(params=params, normalizer=normalizer))


PENDULUM = ("env=pendulum", "network.widths=[32,32]")
RELU = (*PENDULUM, "network.activation=relu", "network.squash=false")
TWENTY = ("env=quadratic", "env.state_size=20", "network=mlp", "network.widths=[64,64]", "algo=td")
GOOD = {
    "1000 N": (PENDULUM, {"limits": (1000.0,)}),
    "1e6 N": (PENDULUM, {"limits": (1e6,)}),
    "thousandths": (PENDULUM, {"limits": (1e-3,)}),
    "20 motors of 80 N m": (TWENTY, {"limits": (80.0,) * 20}),
    "of mixed limits": (TWENTY, {"limits": (1e-3, 1.0, 1e3, 1e4) * 5}),
    "one locked joint": (TWENTY, {"limits": (0.0,) + (80.0,) * 19}),
    "offsets": (PENDULUM, {"mean": 1e5}),
    "offsets of a million, 1000 N": (PENDULUM, {"mean": 1e6, "limits": (1000.0,)}),
    "not squashed": (RELU, {"limits": (1000.0,)}),
    "no limits, large actions": ((*TWENTY, "network.squash=false", "network.activation=relu"), {"gain": 1e4}),
    "no limits, small actions": ((*TWENTY, "network.squash=false"), {"gain": 1e-5}),
    "steep": (RELU, {"gain": 1e4}),
    "steep, squashed": (PENDULUM, {"gain": 1e3, "limits": (1000.0,)}),
}


@pytest.fixture
def export(monkeypatch, capsys, tmp_path):
    """`export(stored, *arguments)`: what the command says of the policy."""

    def run(stored, *arguments):
        monkeypatch.setattr("jaxpg.store.policies.load", lambda *_: stored)
        monkeypatch.setattr("jaxpg.deploy.exporter.describe_origin", lambda *_: {"policy": "drawn"})
        command_line.main(["run=somewhere", f"out={tmp_path / 'out'}", *arguments])
        return capsys.readouterr().out

    return run


@pytest.mark.parametrize("name", GOOD)
def test_good_controllers_are_written(name, export, tmp_path):
    options, changes = GOOD[name]
    said = export(changed(a_policy(*options), **changes), "format=all")
    assert len([*(tmp_path / "out").iterdir()]) == 6
    assert [line.split()[0] for line in said.splitlines()[2:]] == ["jax", *FORMATS]


@pytest.mark.parametrize("limit", [1e-3, 1.0, 1e4])
def test_slight_errors_are_seen_in_any_unit(limit, export, monkeypatch, tmp_path):
    stored = changed(a_policy(*PENDULUM), limits=(limit,))
    slight = header.HEADER.replace("command[i] = {command};", "command[i] = {command} * (policy_real)1.0003;")
    monkeypatch.setattr(header, "HEADER", slight)
    with pytest.raises(UserError, match=r"format=c: the commands differ from the formula's by .*e-04 of the limit"):
        export(stored)
    assert not (tmp_path / "out").exists()


def test_what_jax_gets_wrong_is_not_ours(export):
    stored = a_policy(*PENDULUM)

    def wrong(policy, obs):
        return stored.act(policy, obs) + 1e-3

    with pytest.raises(UserError, match=r"^jax: the commands differ from the formula's by 1\.0e-03 of the limit"):
        export(stored._replace(act=wrong))


def test_units():
    stored = a_policy(*TWENTY)
    control = make_controller(stored, {})
    exact = np.tile(np.arange(20.0), (3, 1)) - 5
    assert reference.error_units(control, exact)[0].tolist() == np.abs(np.arange(20.0) - 5).tolist()
    assert reference.error_units(control._replace(squash=True), exact)[0].tolist() == [1.0] * 20
    limited = control._replace(interface=control.interface._replace(limits=tuple(range(20))))
    assert reference.error_units(limited, exact)[0].tolist() == [*range(20)]
    assert reference.largest_error(np.array([[0.0]]), np.array([[0.0]]), np.zeros(1)) == 0
    assert reference.largest_error(np.array([[1e-9]]), np.array([[0.0]]), np.zeros(1)) == np.inf
    assert np.isnan(reference.largest_error(np.array([[np.nan]]), np.array([[0.0]]), np.ones(1)))


def test_an_ordinary_network_is_not_steep():
    for options in (PENDULUM, TWENTY, RELU):
        stored = a_policy(*options)
        assert make_trial(make_controller(stored, {}), collect_observations(stored)).tolerance < 5 * TOLERANCE


# --- what it is tried on ----------------------------------------------------------------------------------------------


class Counting:
    """Observes a constant and the number of steps so far."""

    observation_size, action_size = 2, 1

    def reset(self, rng):
        return initial_state(jnp.zeros(()), jnp.array([1.5, 0.0]))

    def step(self, state, action):
        count = state.pipeline_state + 1
        return state.replace(pipeline_state=count, obs=jnp.stack([jnp.array(1.5), count]))


@pytest.mark.parametrize("variance", [0.0, 1e-14])
def test_a_constant_observation_is_played(variance):
    stored = a_policy("env=quadratic", "env.state_size=2")
    statistics = RunningStatistics(jnp.array(100.0), jnp.array([1.5000001, 50.0]), jnp.array([variance, 1000.0]))
    interface = Interface(("constant", "count"), ("u",), None)
    stored = stored._replace(env=Counting(), interface=interface, policy=stored.policy._replace(normalizer=statistics))
    steps = np.repeat(np.arange(100.0), 50)
    rows = collect_observations(stored)
    assert rows.shape == (10_000, 2)
    np.testing.assert_array_equal(rows[:5000], np.stack([np.full(5000, 1.5), steps], axis=1))
    assert len(play_observations(stored)) == 5000
    assert np.ptp(rows[5000:, 1]) > 100  # those are drawn


def test_observations_that_training_took_as_they_are_are_played_too():
    """Far from 0, where nothing is known of their deviation."""
    stored = a_policy("env=quadratic", "env.state_size=2", "algo.normalize_observations=false")
    interface = Interface(("constant", "count"), ("u",), None)
    policy = stored.policy._replace(normalizer=normalization.init(2))
    rows = collect_observations(stored._replace(env=Counting(), interface=interface, policy=policy))
    np.testing.assert_array_equal(rows[:5000, 1], np.repeat(np.arange(100.0), 50))
    np.testing.assert_array_equal(rows[:, 0], 1.5)
    assert rows[5000:, 1].mean() == pytest.approx(49.5, abs=4)  # standard error 0.8


def test_what_is_tried_is_said(export):
    stored = a_policy(*PENDULUM)
    said = export(stored).splitlines()[1]
    assert said == (
        f"tested     on 10,000 observations, {len(play_observations(stored)):,} from episodes and the others random; "
        "errors relative to the limit, against float64"
    )


# --- going on with learning -------------------------------------------------------------------------------------------

LEARNER = ("env=exploding-servo", "env.growth=1e4", "algo=online", "network=linear", "network.features=identity")
SLOWEST = ("algo.actor_lr=1e-14", "algo.critic_lr=1e-14")
SLOW = ("algo.actor_lr=1e-4", "algo.critic_lr=1e-4")
CALM = "network.sigma_is=fixed"
TRIED = {  # share of the episodes that explode, and what is said; a sigma that is learned from them runs away
    "some explode": (("env.share=0.5", CALM, *SLOW), r"differs from JAX by \d\.\de-0[5-9] at most in \d{3} updates"),
    "observations far from 0, as they are": (
        ("env.share=0", "env.unit=1e3", "algo.normalize_observations=false", CALM, *SLOWEST),
        r"differs from JAX by \S+ at most in 1,000 updates",
    ),
    "all explode": (("env.share=1", CALM, *SLOW), "not tested: no episode that was played can be learned from"),
    "it runs away": (
        ("env.share=0", *SLOW),
        r"differs from JAX by \d\.\de-0[5-9] at most in \d{2,3} updates; rounding may add more in the other \d{3}",
    ),
}


@pytest.mark.parametrize("name", TRIED)
def test_a_learner_is_tried_as_far_as_floats_tell(name, export, tmp_path):
    options, said = TRIED[name]
    assert re.fullmatch(f" +learning {said}", export(a_policy(*LEARNER, *options)).splitlines()[-1])
    assert (tmp_path / "out" / "learn.c").exists()


def test_a_learner_that_learns_something_else_is_not_written(export, monkeypatch, tmp_path):
    """Nor where the right one runs away."""
    line = "+= step_critic * z->value_bias"
    slight = c_learner.CODE.replace(line, line.replace("step_critic", "(policy_real)1.01 * step_critic"))
    assert slight != c_learner.CODE
    monkeypatch.setattr(c_learner, "CODE", slight)
    with pytest.raises(UserError, match=r"format=c: the learner's parameters differ from JAX's by .* after update \d"):
        export(a_policy(*LEARNER, *SLOW, "env.share=0"))
    assert not (tmp_path / "out").exists()
