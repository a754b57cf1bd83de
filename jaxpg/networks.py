"""Actor and critic as flax networks, given to the algorithms as pure functions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxpg.distributions import SQUASHED_GAUSSIAN, Distribution
from jaxpg.features import identity
from jaxpg.types import PyTree

# A sigma that depends on the state stays within e^-3 and e^3 times its initial value. Without bounds it drifts in
# states that are rarely visited: with some seeds of the pendulum it ends at 10^5.
SIGMA_RANGE = 3.0


class Networks(NamedTuple):
    """A policy and a value function, as functions of their parameters.

    Attributes:
      init: `init(key) -> {"actor": ..., "critic": ...}`.
      policy: `policy(params["actor"], obs) -> (mean, log_std)` of the Gaussian over u, `[..., action_size]` and
        `[action_size]`; both `[..., action_size]` if sigma depends on the state.
      value: `value(params["critic"], obs) -> V(s)`, `[...]`.
      distribution: the distribution of the actions made from u.
    """

    init: Callable[[jax.Array], PyTree]
    policy: Callable[[PyTree, jax.Array], tuple[jax.Array, jax.Array]]
    value: Callable[[PyTree, jax.Array], jax.Array]
    distribution: Distribution


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
    """Weights distributed uniformly over the matrices with orthonormal rows or columns, times `gain`.

    Computed by Gram-Schmidt from a Gaussian matrix. Flax's initializer of the same name calls LAPACK, and under `vmap`
    over seeds its batched calls hang on some jaxlib releases.

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


@jax.jit  # flax traces initializers at every application, to compare shapes; with jit, once per shape
def _orthonormalize(a: jax.Array) -> jax.Array:
    """Orthonormal columns spanning the same spaces as the first 1, 2, ... columns of `a`, `[n, m]` with n >= m."""

    def step(q, i):
        column = a[:, i]
        for _ in range(2):  # after one pass, rounding errors remain
            column = column - q @ (q.T @ column)
        return q.at[:, i].set(column / jnp.linalg.norm(column)), None

    return jax.lax.scan(step, jnp.zeros_like(a), jnp.arange(a.shape[1]))[0]


# log_std(actor, obs) -> log sigma, `[action_size]` or `[N, action_size]`; called in the actor's scope
Sigma = Callable[["GaussianActor", jax.Array], jax.Array]


def fixed(std: float) -> Sigma:
    """Sigma is the constant `std`."""

    def log_std(actor, obs):
        return _full_log(std, actor.action_size)

    return log_std


def learned(std: float) -> Sigma:
    """Sigma is a parameter with the initial value `std`; it may also be set by a schedule."""

    def log_std(actor, obs):
        return actor.param("log_std", _log_constant(std), (actor.action_size,))

    return log_std


def state_dependent(std: float) -> Sigma:
    """Sigma is a function of the observation, with a network like that of the mean.

        log(sigma / std) = R tanh(x / R),    R = `SIGMA_RANGE`

    where x is the network's output, initially 0 or close to it.
    """

    def log_std(actor, obs):
        x = actor.make_mlp()(obs)
        return _full_log(std, actor.action_size) + SIGMA_RANGE * jnp.tanh(x / SIGMA_RANGE)

    return log_std


def _log_constant(std: float) -> nn.initializers.Initializer:
    return nn.initializers.constant(jnp.log(std))


def _full_log(std: float, size: int) -> jax.Array:
    return jnp.full((size,), jnp.log(std), float)


class GaussianActor(nn.Module):
    """u ~ N(mu(s), sigma^2), with an MLP for the mean and one sigma per action.

    Attributes:
      widths, action_size, activation: as in `MLP`; without hidden layers the mean is linear.
      output_gain: gain of the mean's last layer; with 0 the initial mean is 0.
      sigma: `fixed(std)`, `learned(std)` or `state_dependent(std)`.
    """

    widths: Sequence[int]
    action_size: int
    activation: Callable[[jax.Array], jax.Array]
    output_gain: float
    sigma: Sigma

    @nn.compact
    def __call__(self, obs: jax.Array) -> tuple[jax.Array, jax.Array]:
        return self.make_mlp()(obs), self.sigma(self, obs)

    def make_mlp(self) -> MLP:
        """An MLP with the actor's sizes; to be called within `__call__`."""
        return MLP(self.widths, self.action_size, self.output_gain, self.activation)


def mlp_networks(
    observation_size: int,
    action_size: int,
    widths: Sequence[int] = (64, 64),
    activation: Callable[[jax.Array], jax.Array] = jnp.tanh,
    features: Callable[[jax.Array], jax.Array] = identity,
    sigma: Sigma = learned(1.0),
    distribution: Distribution = SQUASHED_GAUSSIAN,
) -> Networks:
    """Separate MLPs for the mean of the policy and for the value.

        mu(s) = f(phi(s)),    V(s) = g(phi(s))

    Args:
      observation_size, action_size: sizes of the environment.
      widths: hidden units of each layer, the same for actor and critic.
      activation: activation of the hidden layers.
      features: phi, one of `jaxpg.features` at a given order. With second-order features an energy, for example, is
        linear in the input of the first layer.
      sigma: standard deviation of u: `fixed(std)`, `learned(std)` or `state_dependent(std)`.
      distribution: the distribution of the actions made from u.

    >>> networks = mlp_networks(observation_size=3, action_size=1)
    >>> params = networks.init(jax.random.key(0))
    >>> mean, log_std = networks.policy(params["actor"], jnp.zeros((5, 3)))
    >>> mean.shape, log_std.shape, networks.value(params["critic"], jnp.zeros((5, 3))).shape
    ((5, 1), (1,), (5,))
    """
    actor = GaussianActor(tuple(widths), action_size, activation, 0.01, sigma)
    critic = MLP(tuple(widths), 1, output_gain=1.0, activation=activation)
    return _make_networks(actor, critic, features, observation_size, distribution)


def linear_networks(
    observation_size: int,
    action_size: int,
    features: Callable[[jax.Array], jax.Array] = identity,
    sigma: Sigma = learned(1.0),
    distribution: Distribution = SQUASHED_GAUSSIAN,
) -> Networks:
    """Mean and value linear in fixed features of the observation, initially 0.

        mu(s) = W phi(s) + b,    V(s) = w' phi(s) + c

    Args:
      observation_size, action_size: sizes of the environment.
      features: phi, one of `jaxpg.features` at a given order.
      sigma, distribution: as in `mlp_networks`; a `state_dependent` sigma is linear in phi too, within its bounds.

    Source: the lesson, section 7.

    >>> from functools import partial
    >>> from jaxpg.features import polynomial
    >>> networks = linear_networks(observation_size=2, action_size=1, features=partial(polynomial, order=2))
    >>> jax.tree.map(jnp.shape, networks.init(jax.random.key(0))["critic"])
    {'params': {'Dense_0': {'bias': (1,), 'kernel': (5, 1)}}}
    """
    actor = GaussianActor((), action_size, jnp.tanh, 0.0, sigma)
    critic = MLP((), 1, output_gain=0.0, activation=jnp.tanh)
    return _make_networks(actor, critic, features, observation_size, distribution)


def linear_mean(actor: PyTree) -> tuple[jax.Array, jax.Array]:
    """W `[action_size, features]` and b `[action_size]` from the parameters `params["actor"]` of `linear_networks`."""
    layer = actor["params"]["MLP_0"]["Dense_0"]
    return layer["kernel"].T, layer["bias"]


def _make_networks(actor, critic, phi, observation_size: int, distribution: Distribution) -> Networks:
    """`Networks` of the flax modules, applied to phi(s)."""

    def init(key):
        key_actor, key_critic = jax.random.split(key)
        x = phi(jnp.zeros(observation_size))
        return {"actor": actor.init(key_actor, x), "critic": critic.init(key_critic, x)}

    def policy(params, obs):
        mean, log_std = actor.apply(params, phi(_flatten_batch(obs)))
        mean = mean.reshape(*obs.shape[:-1], -1)
        return mean, log_std.reshape(mean.shape) if log_std.ndim > 1 else log_std

    def value(params, obs):
        return critic.apply(params, phi(_flatten_batch(obs))).reshape(obs.shape[:-1])

    return Networks(init, policy, value, distribution)


def _flatten_batch(obs: jax.Array) -> jax.Array:
    """`[..., n]` as one matrix: in XLA its products, above all in gradients, are twice as fast as a stack's."""
    return obs.reshape(-1, obs.shape[-1])
