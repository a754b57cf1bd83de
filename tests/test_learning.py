"""Gradient steps on a rollout: its parts, and several steps as a loop."""

import operator

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from probes import Counter

from jaxpg import normalization
from jaxpg.batch import make_batch_fn
from jaxpg.estimators import gae
from jaxpg.methods import td
from jaxpg.networks import mlp_networks
from jaxpg.policy import sampling_policy
from jaxpg.ppo import minibatch_steps, ppo_loss, split_environments
from jaxpg.vector_env import vectorize

NETWORKS = mlp_networks(2, 1, (8,))


def a_batch(params):
    """The first rollout of six episodes of `Counter`, five steps."""
    method, vector, statistics = td(0.9, 5, gae(0.95)), vectorize(Counter(), 6, 10), normalization.init(2)
    policy_fn = sampling_policy(NETWORKS, params, statistics)
    _, steps = method.collect(vector, policy_fn, vector.reset(jax.random.key(0)), jax.random.key(1))
    return make_batch_fn(NETWORKS, method, 10, 1.0, True)(params, statistics, steps)


@pytest.mark.parametrize("minibatches", [1, 2, 3])
def test_parts_hold_every_environment_once(minibatches):
    batch = a_batch(NETWORKS.init(jax.random.key(2)))
    number = jnp.broadcast_to(jnp.arange(6.0), (5, 6))
    seen = set()
    for seed in range(8):
        marked = batch._replace(advantage=number, u=number[..., None])
        parts = split_environments(marked, jax.random.key(seed), minibatches)
        assert parts.advantage.shape == (minibatches, 5, 6 // minibatches)
        np.testing.assert_array_equal(parts.advantage, parts.u[..., 0])  # all fields in the same order
        np.testing.assert_array_equal(
            parts.advantage, parts.advantage[:, :1] + jnp.zeros((5, 1))
        )  # steps stay together
        np.testing.assert_array_equal(np.sort(parts.advantage[:, 0].ravel()), np.arange(6))
        seen.add(tuple(parts.advantage[:, 0].ravel().tolist()))
    assert len(seen) > 1  # another order in another epoch


def steps_taken(epochs, minibatches, max_kl=None, **of_loss):
    """Parameters after PPO's update with plain gradient steps of 0.5, and the metrics; the same by a loop."""
    params, optimizer = NETWORKS.init(jax.random.key(2)), optax.sgd(0.5)
    batch, loss = a_batch(params), ppo_loss(NETWORKS, 0.01, **of_loss)
    found, _, metrics = jax.jit(minibatch_steps(loss, optimizer, epochs, minibatches, max_kl))(
        params, optimizer.init(params), batch, jax.random.key(3)
    )
    by_loop, divergence = params, []
    for key in jax.random.split(jax.random.key(3), epochs):
        parts = split_environments(batch, key, minibatches)
        for i in range(minibatches):
            slope, terms = jax.grad(loss, has_aux=True)(by_loop, jax.tree.map(operator.itemgetter(i), parts))
            divergence.append(float(terms["kl"]))
            if max(divergence) <= (max_kl or np.inf):
                by_loop = jax.tree.map(lambda x, g: x - 0.5 * g, by_loop, slope)
    return found, by_loop, metrics, divergence


@pytest.mark.parametrize("clip", [0.05, None])
def test_minibatch_steps_are_a_loop_over_epochs_and_minibatches(clip):
    found, by_loop, metrics, divergence = steps_taken(3, 2, clip=clip, value_clip=0.2)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), found, by_loop)
    assert metrics["gradient_steps"] == 6
    np.testing.assert_allclose(metrics["kl"], np.mean(divergence), rtol=1e-3)


def test_steps_end_where_the_policy_has_moved_too_far():
    *_, divergence = steps_taken(4, 2, clip=None)
    assert 0 < divergence[1] < divergence[3] < divergence[-1]
    limit = (divergence[3] + max(divergence[:3])) / 2
    found, by_loop, metrics, _ = steps_taken(4, 2, limit, clip=None)
    assert metrics["gradient_steps"] == 3
    np.testing.assert_allclose(metrics["kl"], np.mean(divergence[:3]), rtol=1e-3)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), found, by_loop)
