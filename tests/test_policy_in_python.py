"""`jaxpg.load(run)`: a policy in a program of one's own, numpy in and out, in physical units."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stored import a_policy

import jaxpg
from jaxpg.deploy import reference
from jaxpg.deploy.controller import make_controller
from jaxpg.errors import UserError
from jaxpg.store import policies


@pytest.fixture(scope="module")
def run(command, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    sizes = ("num_envs=2", "num_steps=4", "total_steps=32", "log_interval=8", "eval_interval=8", "eval_episodes=2")
    options = ("env=quadratic", "env.state_size=2", "env.episode_length=8", "num_seeds=2", "report=false")
    result = command("train", *options, *sizes, f"run_dir={folder}")
    assert result.returncode == 0, result.stderr
    return folder


@pytest.fixture
def drawn(monkeypatch):
    """`drawn(*options) -> (stored, policy)`: what `load` gives of a policy that is drawn."""

    def make(*options):
        stored = a_policy(*options)
        monkeypatch.setattr("jaxpg.store.policies.load", lambda *_: stored)
        return stored, jaxpg.load("somewhere")

    return make


def test_a_policy_is_shown_by_its_names(drawn):
    _, policy = drawn("env=pendulum")
    assert repr(policy) == "Policy(cos(theta), sin(theta), theta' [rad/s] -> torque [N m])"


def test_commands_are_the_formulas(drawn):
    stored, policy = drawn("env=arm", "network.widths=[8]")
    obs = np.random.default_rng(0).normal(size=(5, 4, policy.observation_size))
    expected = reference.compute_commands(make_controller(stored, {}), np.float32(obs).reshape(20, -1)).reshape(5, 4, 2)
    command = policy(obs)
    assert isinstance(command, np.ndarray)
    np.testing.assert_allclose(command, expected, rtol=0, atol=1e-5)
    np.testing.assert_allclose(policy(obs[0, 0].tolist()), expected[0, 0], rtol=0, atol=1e-5)
    np.testing.assert_allclose(policy.action(obs) * np.array(policy.interface.limits), expected, rtol=0, atol=1e-5)
    assert policy.interface == stored.interface
    assert (policy.observation_size, policy.action_size) == (obs.shape[-1], 2)


def test_an_observation_that_is_not_valid_commands_zero(drawn):
    _, policy = drawn("env=arm", "network.widths=[8]", "network.activation=relu")
    obs = np.zeros((3, policy.observation_size))
    obs[1, 2] = np.nan
    command = policy(obs)
    np.testing.assert_array_equal(command[1], [0, 0])
    np.testing.assert_array_equal(command[0], command[2])
    assert (command[0] != 0).all()


def test_functions_are_pure_and_can_be_transformed(drawn):
    _, policy = drawn("env=pendulum", "network.widths=[8]")
    obs = jnp.array([[1.0, 0.0, 0.5], [0.0, 1.0, -2.0]])
    mapped = jax.jit(jax.vmap(policy.command_fn, in_axes=(None, 0)))(policy.params, obs)
    np.testing.assert_allclose(mapped, policy(obs), atol=1e-6)
    slope = jax.grad(lambda s: policy.value_fn(policy.params, s))(obs[0])
    step = jnp.array([1e-3, 0.0, 0.0])
    difference = policy.value(obs[0] + step) - policy.value(obs[0] - step)
    np.testing.assert_allclose(slope[0], difference / 2e-3, rtol=1e-2)
    doubled = policy.params._replace(params=jax.tree.map(lambda x: 2 * x, policy.params.params))
    assert np.abs(policy.command_fn(doubled, obs) - policy(obs)).max() > 1e-3


def test_the_policy_of_a_run(run):
    """Which checkpoint and which agent; the value is the critic's, `[...]`."""
    stored = policies.load(str(run), "last", 1)
    policy = jaxpg.load(run, checkpoint="last", agent=1)
    obs = np.random.default_rng(0).normal(size=(3, 2)).astype(np.float32)
    np.testing.assert_allclose(policy.action(obs), stored.act(stored.policy, obs), atol=1e-6)
    np.testing.assert_allclose(policy.value(obs), stored.value(stored.policy, obs), atol=1e-6)
    assert policy.value(obs[0]).shape == ()
    assert np.abs(policy(obs) - jaxpg.load(run, "last", 0)(obs)).max() > 0


def test_mistakes_say_what_would_be_right(run, drawn, tmp_path):
    with pytest.raises(UserError, match="is not a run folder"):
        jaxpg.load(tmp_path)
    with pytest.raises(UserError, match="agent=2: the run has agents 0 to 1"):
        jaxpg.load(run, agent=2)
    with pytest.raises(UserError, match="checkpoint=newest: must be best or last"):
        jaxpg.load(run, checkpoint="newest")
    _, policy = drawn("env=pendulum", "network.widths=[8]")
    for shape in ((), (4,), (3, 4)):
        with pytest.raises(ValueError, match=r"expected an observation of shape \[3\] or \[\.\.\., 3\], not "):
            policy(np.zeros(shape))


def test_it_costs_nothing_until_it_is_called():
    code = "import jaxpg, sys; jaxpg.load; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"mujoco", "brax", "orbax", "envs"} & set(loaded)
