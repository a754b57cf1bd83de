"""Actor and critic as flax networks, handed to the programs as three pure functions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxpg.types import PyTree

ACTIVATIONS = {"tanh": jnp.tanh, "relu": jax.nn.relu, "elu": jax.nn.elu, "swish": jax.nn.swish}


class Networks(NamedTuple):
    """A policy and a value function without their parameters.

    Attributes:
      init: `init(key) -> {"actor": ..., "critic": ...}`.
      policy: `policy(params["actor"], obs) -> (mean, log_std)` of the Gaussian over u, `[..., action_size]` and
        `[action_size]`.
      value: `value(params["critic"], obs) -> V(s)`, `[...]`.
    """

    init: Callable[[jax.Array], PyTree]
    policy: Callable[[PyTree, jax.Array], tuple[jax.Array, jax.Array]]
    value: Callable[[PyTree, jax.Array], jax.Array]


class MLP(nn.Module):
    """Hidden layers with orthogonal weights of gain sqrt 2, then a linear layer of gain `output_gain`."""

    widths: Sequence[int]
    output_size: int
    output_gain: float
    activation: Callable[[jax.Array], jax.Array]

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for width in self.widths:
            x = self.activation(nn.Dense(width, kernel_init=orthogonal(2.0**0.5))(x))
        return nn.Dense(self.output_size, kernel_init=orthogonal(self.output_gain))(x)


def orthogonal(gain: float) -> nn.initializers.Initializer:
    """Weights drawn uniformly from the matrices with orthonormal rows or columns, times `gain`.

    Gram-Schmidt on a Gaussian matrix; flax's initializer of the same name asks LAPACK for a QR decomposition, and
    batched LAPACK calls, which `vmap` over seeds would make of it, hang on some jaxlib releases.

    Source: Saxe, McClelland and Ganguli, arXiv 1312.6120.

    >>> weights = orthogonal(2.0)(jax.random.key(0), (3, 2))
    >>> bool(jnp.allclose(weights.T @ weights, 4 * jnp.eye(2), atol=1e-5))
    True
    """

    def init(key, shape, dtype=jnp.float32):
        tall = (max(shape), min(shape))
        columns = gain * _orthonormalize(jax.random.normal(key, tall, dtype))
        return columns if shape == tall else columns.T

    return init


def _orthonormalize(a: jax.Array) -> jax.Array:
    """Orthonormal columns spanning the same spaces as the first 1, 2, ... columns of `a`, `[n, m]` with n >= m."""

    def step(q, i):
        column = a[:, i]
        for _ in range(2):  # once loses orthogonality to rounding; twice is enough
            column = column - q @ (q.T @ column)
        return q.at[:, i].set(column / jnp.linalg.norm(column)), None

    return jax.lax.scan(step, jnp.zeros_like(a), jnp.arange(a.shape[1]))[0]


class GaussianActor(nn.Module):
    """u ~ N(mu(s), sigma^2): an MLP for the mean, one sigma for each action, fixed or learned."""

    widths: Sequence[int]
    action_size: int
    activation: Callable[[jax.Array], jax.Array]
    initial_std: float
    learn_std: bool

    @nn.compact
    def __call__(self, obs: jax.Array) -> tuple[jax.Array, jax.Array]:
        mean = MLP(self.widths, self.action_size, output_gain=0.01, activation=self.activation)(obs)
        initial = nn.initializers.constant(jnp.log(self.initial_std))
        if self.learn_std:
            return mean, self.param("log_std", initial, (self.action_size,))
        return mean, initial(None, (self.action_size,))


def mlp_networks(
    observation_size: int,
    action_size: int,
    widths: Sequence[int] = (64, 64),
    activation: str = "tanh",
    initial_std: float = 1.0,
    learn_std: bool = True,
) -> Networks:
    """Separate MLPs for the mean of the policy and for the value.

    Args:
      observation_size, action_size: of the environment.
      widths: hidden units by layer, the same for actor and critic.
      activation: a name in `ACTIVATIONS`.
      initial_std: sigma of the Gaussian over u, before squashing; positive.
      learn_std: whether sigma is a parameter or stays as it is.

    >>> networks = mlp_networks(observation_size=3, action_size=1)
    >>> params = networks.init(jax.random.key(0))
    >>> mean, log_std = networks.policy(params["actor"], jnp.zeros((5, 3)))
    >>> mean.shape, log_std.shape, networks.value(params["critic"], jnp.zeros((5, 3))).shape
    ((5, 1), (1,), (5,))
    """
    actor = GaussianActor(tuple(widths), action_size, ACTIVATIONS[activation], initial_std, learn_std)
    critic = MLP(tuple(widths), 1, output_gain=1.0, activation=ACTIVATIONS[activation])

    def init(key):
        key_actor, key_critic = jax.random.split(key)
        obs = jnp.zeros(observation_size)
        return {"actor": actor.init(key_actor, obs), "critic": critic.init(key_critic, obs)}

    return Networks(init, actor.apply, lambda params, obs: critic.apply(params, obs)[..., 0])
