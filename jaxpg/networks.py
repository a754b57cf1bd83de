"""Actor and critic as flax networks, handed to the programs as three pure functions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxpg.distributions import SQUASHED_GAUSSIAN, Distribution
from jaxpg.features import identity
from jaxpg.types import PyTree

# A sigma that depends on the state stays within e^-3 and e^3 times its initial value: without bounds the states that
# are seldom visited get any sigma, and some seeds of the pendulum end at 10^5.
SIGMA_RANGE = 3.0


class Networks(NamedTuple):
    """A policy and a value function without their parameters.

    Attributes:
      init: `init(key) -> {"actor": ..., "critic": ...}`.
      policy: `policy(params["actor"], obs) -> (mean, log_std)` of the Gaussian over u, `[..., action_size]` and
        `[action_size]`, or both `[..., action_size]` where sigma depends on the state.
      value: `value(params["critic"], obs) -> V(s)`, `[...]`.
      distribution: the actions made of u, and their densities.
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


@jax.jit  # flax traces the initializers at every application, to compare shapes: this is traced once for each shape
def _orthonormalize(a: jax.Array) -> jax.Array:
    """Orthonormal columns spanning the same spaces as the first 1, 2, ... columns of `a`, `[n, m]` with n >= m."""

    def step(q, i):
        column = a[:, i]
        for _ in range(2):  # once loses orthogonality to rounding; twice is enough
            column = column - q @ (q.T @ column)
        return q.at[:, i].set(column / jnp.linalg.norm(column)), None

    return jax.lax.scan(step, jnp.zeros_like(a), jnp.arange(a.shape[1]))[0]


# log_std(actor, obs) -> log sigma, `[action_size]` or `[N, action_size]`, called in the actor's own scope
Sigma = Callable[["GaussianActor", jax.Array], jax.Array]


def fixed(std: float) -> Sigma:
    """Sigma is `std`, and no parameter."""

    def log_std(actor, obs):
        return _full_log(std, actor.action_size)

    return log_std


def learned(std: float) -> Sigma:
    """Sigma is a parameter, at first `std`. An optimizer may also lead it along a schedule."""

    def log_std(actor, obs):
        return actor.param("log_std", _log_constant(std), (actor.action_size,))

    return log_std


def state_dependent(std: float) -> Sigma:
    """Sigma is a function of the observation, by a network like the mean's.

        log(sigma / std) = R tanh(x / R),    R = `SIGMA_RANGE`

    with x the network's output, 0 or nearly so at first.
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
    """u ~ N(mu(s), sigma^2), with an MLP for the mean and one sigma for each action.

    Attributes:
      widths, action_size, activation: of the MLP; without hidden layers the mean is linear.
      output_gain: of the mean's last layer; 0 begins with the mean 0 everywhere.
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
        """A network of the actor's sizes; it belongs to the actor whose `__call__` asks for it."""
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
      observation_size, action_size: of the environment.
      widths: hidden units by layer, the same for actor and critic.
      activation: of the hidden layers.
      features: phi, one of `jaxpg.features` at a given order. With the products of two observations an energy, say, is
        linear in what the first layer sees.
      sigma: of the Gaussian over u: `fixed(std)`, `learned(std)` or `state_dependent(std)`.
      distribution: what is made of u.

    >>> networks = mlp_networks(observation_size=3, action_size=1)
    >>> params = networks.init(jax.random.key(0))
    >>> mean, log_std = networks.policy(params["actor"], jnp.zeros((5, 3)))
    >>> mean.shape, log_std.shape, networks.value(params["critic"], jnp.zeros((5, 3))).shape
    ((5, 1), (1,), (5,))
    """
    actor = GaussianActor(tuple(widths), action_size, activation, 0.01, sigma)
    critic = MLP(tuple(widths), 1, output_gain=1.0, activation=activation)
    return _networks(actor, critic, features, observation_size, distribution)


def linear_networks(
    observation_size: int,
    action_size: int,
    features: Callable[[jax.Array], jax.Array] = identity,
    sigma: Sigma = learned(1.0),
    distribution: Distribution = SQUASHED_GAUSSIAN,
) -> Networks:
    """Mean and value linear in fixed features of the observation, 0 at the beginning.

        mu(s) = W phi(s) + b,    V(s) = w' phi(s) + c

    Args:
      observation_size, action_size: of the environment.
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
    return _networks(actor, critic, features, observation_size, distribution)


def linear_mean(actor: PyTree) -> tuple[jax.Array, jax.Array]:
    """W `[action_size, features]` and b `[action_size]` of the parameters `params["actor"]` of `linear_networks`."""
    layer = actor["params"]["MLP_0"]["Dense_0"]
    return layer["kernel"].T, layer["bias"]


def _networks(actor, critic, phi, observation_size: int, distribution: Distribution) -> Networks:
    """The flax modules, applied to phi(s), as pure functions."""

    def init(key):
        key_actor, key_critic = jax.random.split(key)
        x = phi(jnp.zeros(observation_size))
        return {"actor": actor.init(key_actor, x), "critic": critic.init(key_critic, x)}

    def policy(params, obs):
        mean, log_std = actor.apply(params, phi(_rows(obs)))
        mean = mean.reshape(*obs.shape[:-1], -1)
        return mean, log_std.reshape(mean.shape) if log_std.ndim > 1 else log_std

    def value(params, obs):
        return critic.apply(params, phi(_rows(obs))).reshape(obs.shape[:-1])

    return Networks(init, policy, value, distribution)


def _rows(obs: jax.Array) -> jax.Array:
    """`[..., n]` as one matrix: XLA multiplies it, and above all its gradient, twice as fast as a stack of matrices."""
    return obs.reshape(-1, obs.shape[-1])
