"""Stored policies without a training."""

import functools

import jax
import jax.numpy as jnp

import envs
from jaxpg.config.parsing import compose
from jaxpg.normalization import RunningStatistics
from jaxpg.program.networks import make_networks
from jaxpg.program.state import Policy
from jaxpg.store.policies import make_stored_policy


@functools.cache
def an_env(name, options):
    return envs.REGISTRY[name].build(options)


@functools.cache
def a_policy(*options):
    """A stored policy whose numbers are drawn, larger than those that training begins with."""
    config = compose(options)
    env = an_env(config.choices["env"], config.env)
    networks, keys = make_networks(config, env), iter(jax.random.split(jax.random.key(0), 100))
    params = networks.init(next(keys))
    params = jax.tree.map(lambda x: x + 0.1 * jax.random.normal(next(keys), x.shape), params)
    normalizer = RunningStatistics(
        count=jnp.array(100.0),
        mean=jax.random.normal(next(keys), (env.observation_size,)),
        variance=jnp.exp(jax.random.normal(next(keys), (env.observation_size,))),
    )

    return make_stored_policy(config, env, Policy(params, normalizer), update=1, agent="seed 0")
