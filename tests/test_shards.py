"""An agent's environments in parts: together they learn what one part with all of them learns."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from probes import Counter
from processes import outcome, training
from test_learning import NETWORKS, a_batch

from jaxpg import collectives, normalization
from jaxpg.actor_critic import actor_critic
from jaxpg.estimators import gae, normalize_advantages
from jaxpg.methods import td
from jaxpg.nonfinite import stop_at_nonfinite
from jaxpg.ppo import minibatch_steps, ppo, ppo_loss
from jaxpg.shards import AXIS, shard
from jaxpg.training import initial_state, train_scan
from jaxpg.updates import actor_critic_loss, gradient_step
from jaxpg.vector_env import episode_metrics, vectorize

ALGORITHMS = {
    "td": (actor_critic, {}),
    "ppo": (ppo, {"epochs": 2, "minibatches": 3}),
    "ppo that ends early": (ppo, {"epochs": 3, "max_kl": 1e-4}),
}


def algorithm(name, num_envs, axis_name, life=4):
    make, options = ALGORITHMS[name]
    return make(
        vectorize(Counter(life), num_envs, 7),
        NETWORKS,
        optax.adam(0.01),
        td(0.9, 5, gae(0.95)),
        entropy_coef=0.01,
        axis_name=axis_name,
        **options,
    )


def in_two(tree, axis=1):
    """`[T, N, ...]` as `[2, T, N / 2, ...]`."""
    return jax.tree.map(lambda x: jnp.stack(jnp.split(x, 2, axis)), tree)


def close(left, right, rtol=1e-4, atol=1e-6):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=rtol, atol=atol), left, right)


# --- what the parts tell each other -----------------------------------------------------------------------------------


@settings(deadline=None)
@given(st.lists(st.booleans(), min_size=6, max_size=6))
def test_the_first_place_is_counted_through_all_parts(places):
    where = jnp.array(places)
    expected = places.index(True) if any(places) else -1
    parts = where.reshape(3, 2)
    found = jax.vmap(lambda part: collectives.find_first(part, AXIS), axis_name=AXIS)(parts)
    np.testing.assert_array_equal(found, expected)
    assert collectives.find_first(where, None) == expected


def test_normalized_advantages_are_those_of_the_whole_batch():
    advantage = jax.random.normal(jax.random.key(0), (5, 6)) * jnp.arange(1.0, 7) + 3  # each part has its own moments
    weight = (jax.random.uniform(jax.random.key(1), (5, 6)) < 0.7).astype(jnp.float32)
    parts = jax.vmap(lambda a, w: normalize_advantages(a, w, axis_name=AXIS), axis_name=AXIS)
    found = jnp.concatenate(list(parts(in_two(advantage), in_two(weight))), axis=1)
    close(found, normalize_advantages(advantage, weight), rtol=1e-5)


def test_running_statistics_are_those_of_all_parts():
    before = normalization.update(normalization.init(3), jnp.arange(12.0).reshape(4, 3))
    batch = jax.random.normal(jax.random.key(0), (5, 6, 3)) * 4 + jnp.arange(6.0)[:, None]
    update = jax.vmap(lambda part: normalization.update(before, part, AXIS), out_axes=None, axis_name=AXIS)
    close(update(in_two(batch)), normalization.update(before, batch), rtol=1e-5)


def test_episodes_are_counted_in_all_parts():
    vector = vectorize(Counter(life=3), 6, 10)
    state = vector.reset(jax.random.key(0))

    def step(state, key):
        state, outcome = vector.step(state, jnp.zeros((6, 1)), key)
        return state, outcome._replace(diverged=outcome.terminated * (jnp.arange(6) > 3))

    _, steps = jax.lax.scan(step, state, jax.random.split(jax.random.key(1), 5))
    whole = episode_metrics(steps)
    assert (whole["episodes"], whole["return_sum"], whole["diverged"], whole["diverged_env"]) == (4, 12, 2, 4)
    parts = jax.vmap(lambda part: episode_metrics(part, AXIS), out_axes=None, axis_name=AXIS)(in_two(steps))
    close(parts, whole)


@pytest.mark.parametrize("steps", [None, {"epochs": 3}, {"epochs": 3, "max_kl": 1e-3}])
def test_gradient_steps_are_those_of_the_whole_batch(steps):
    """Parameters, optimizer and metrics; with a single minibatch the order of the environments does not matter."""
    params, optimizer = NETWORKS.init(jax.random.key(2)), optax.adam(0.01)
    batch = a_batch(params)

    def make_update(axis_name):
        if steps is None:
            return gradient_step(actor_critic_loss(NETWORKS, 0.01), optimizer, axis_name)
        return minibatch_steps(ppo_loss(NETWORKS, 0.01), optimizer, minibatches=1, axis_name=axis_name, **steps)

    def part(axis_name):
        return lambda batch: make_update(axis_name)(params, optimizer.init(params), batch, jax.random.key(3))

    whole = jax.jit(part(None))(batch)
    parts = jax.jit(jax.vmap(part(AXIS), out_axes=None, axis_name=AXIS))(in_two(batch))
    close(parts, whole, rtol=1e-3, atol=1e-5)


# --- whole algorithms -------------------------------------------------------------------------------------------------


STUDIES = [pytest.param(name, marks=pytest.mark.study) for name in ("ppo", "ppo that ends early")]


@pytest.mark.parametrize("name", ["td", *STUDIES])
def test_parts_on_devices_of_their_own_are_parts_on_one(name):
    """The same mathematics by `shard_map` and by `vmap`, over 20 updates."""
    assert len(jax.devices()) == 2

    def run(devices):
        both = stop_at_nonfinite(shard(algorithm(name, 6, AXIS), 2, devices))
        return jax.jit(lambda key: train_scan(both, key, 20))(jax.random.key(4))

    with jax.debug_key_reuse(False):  # see test_vmapped_seeds_are_single_seeds
        (state, metrics), (on_one, same_metrics) = run(jax.devices()), run(jax.devices()[:1])
    assert state.env_state.obs.shape == (12, 2)
    assert state.update == 20
    close(state, on_one, rtol=2e-3, atol=1e-4)
    close(metrics, same_metrics, rtol=2e-3, atol=1e-4)
    if name == "ppo that ends early":
        assert metrics["gradient_steps"].min() < 3
    assert metrics["episodes"].sum() > 12


def test_each_part_has_random_numbers_of_its_own():
    both = shard(algorithm("td", 6, AXIS), 2, jax.devices())
    state = jax.jit(lambda key: initial_state(both, key))(jax.random.key(0))
    first, second = np.split(np.asarray(state.env_state.obs), 2)
    assert not np.isin(first[:, 0], second[:, 0]).any()
    assert len(jax.tree.leaves(state.params)[0].sharding.device_set) == 2  # every device has them


# --- whole runs -------------------------------------------------------------------------------------------------------

SIZES = ("env=quadratic", "network=linear", "num_envs=8", "num_steps=4", "log_interval=64", "eval_interval=128")
RUN = (*SIZES, "algo.num_shards=2", "eval_episodes=4", "checkpoint_interval=640", "total_steps=6400", "report=false")


def test_a_run_in_parts_that_was_stopped_is_the_run_that_was_not(command, command_environment, tmp_path):
    """To the bit, parameters on one device or on two."""
    assert command("train", *RUN, f"run_dir={tmp_path / 'whole'}").returncode == 0
    with training(command_environment, *RUN, f"run_dir={tmp_path / 'run'}", "resume=auto") as process:
        while not (tmp_path / "run" / "checkpoints" / "20").exists():
            assert process.poll() is None
        process.kill()
        process.wait()
    result = command("train", f"resume={tmp_path / 'run'}")
    assert result.returncode == 0, result.stderr
    assert re.search(r"^resuming .* at [\d,]+ of 6,400 steps$", result.stdout, re.MULTILINE)
    assert outcome(tmp_path / "run") == outcome(tmp_path / "whole")
    other = command("train", f"resume={tmp_path / 'run'}", "algo.num_shards=1")
    assert other.returncode == 2
    assert "algo.num_shards=1" in other.stderr
