"""A trained policy as what a robot runs: physical observations in, physical commands out, and nothing of JAX.

    command = limit * clip(squash(f(phi((s - m) / sqrt(v + epsilon)))), -1, 1)

with the features phi and the network f of the actor, and squash = tanh or nothing. Every format is written from here.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Interface
from jaxpg import normalization
from jaxpg.evaluation import play
from jaxpg.run.policies import StoredPolicy
from jaxpg.run.schema import Online

NUM_OBSERVATIONS = 10_000  # on which what was written is compared with JAX
NUM_EPISODES = 50
FAR = 10.0


class Layer(NamedTuple):
    """x -> weight' x + bias: `[inputs, outputs]` and `[outputs]`."""

    weight: np.ndarray
    bias: np.ndarray


class Learner(NamedTuple):
    """What a linear-Gaussian controller needs to go on learning as `algo=online` does.

    Attributes:
      value: the critic's layer.
      log_std: log sigma, `[m]`.
      options: those of the algorithm, `jaxpg.run.schema.Online`.
      learns_sigma: whether sigma is one of the policy's parameters.
    """

    value: Layer
    log_std: np.ndarray
    options: Online
    learns_sigma: bool


class Controller(NamedTuple):
    """The numbers of a policy, all float32.

    Attributes:
      name: a word, such as "pendulum".
      interface: names, units and limits of observations and commands.
      mean, scale: observations enter as (s - mean) * scale, `[n]`.
      features, order: phi, a name in `jaxpg.features.FEATURES` and its order.
      layers: of f, with the activation between them.
      activation: a name in `jaxpg.networks.ACTIVATIONS`.
      squash: whether the tanh of the last layer is taken.
      origin: where it comes from, in words by name.
      learner: for going on with learning, if it has been trained step by step; else None.
    """

    name: str
    interface: Interface
    mean: np.ndarray
    scale: np.ndarray
    features: str
    order: int
    layers: list[Layer]
    activation: str
    squash: bool
    origin: dict[str, str]
    learner: Learner | None

    @property
    def observation_size(self) -> int:
        return len(self.mean)

    @property
    def action_size(self) -> int:
        return len(self.layers[-1].bias)


def controller(stored: StoredPolicy, origin: dict[str, str]) -> Controller:
    """The numbers of a stored policy.

    Args:
      stored: the policy.
      origin: as in `Controller`.
    """
    config, network = stored.config, stored.config.network
    dense = stored.policy.params["actor"]["params"]["MLP_0"]
    layers = [dense[f"Dense_{i}"] for i in range(len(dense))]
    return Controller(
        name=re.sub(r"\W", "_", config.task),
        interface=stored.interface,
        mean=np.asarray(stored.policy.normalizer.mean),
        scale=np.asarray(normalization.inverse_deviation(stored.policy.normalizer)),
        features=network.features,
        order=network.order,
        layers=[Layer(np.asarray(layer["kernel"]), np.asarray(layer["bias"])) for layer in layers],
        activation=getattr(network, "activation", "tanh"),
        squash=network.squash,
        origin=origin,
        learner=_learner(stored),
    )


def _learner(stored: StoredPolicy) -> Learner | None:
    config, params = stored.config, stored.policy.params
    learns_sigma = config.network.sigma_is == "learned"
    linear = config.choices["network"] == "linear" and config.network.sigma_is in ("fixed", "learned")
    if config.choices["algo"] != "online" or not linear:
        return None
    value = params["critic"]["params"]["Dense_0"]
    size = params["actor"]["params"]["MLP_0"]["Dense_0"]["bias"].shape
    log_std = params["actor"]["params"]["log_std"] if learns_sigma else np.full(size, np.log(config.network.sigma))
    return Learner(
        value=Layer(np.asarray(value["kernel"]), np.asarray(value["bias"])),
        log_std=np.asarray(log_std, np.float32),
        options=config.algo,
        learns_sigma=learns_sigma,
    )


def commanding(stored: StoredPolicy) -> Callable[[jax.Array], jax.Array]:
    """`command(obs)`, `[..., n]` to `[..., m]`: the controller as JAX computes it."""
    return lambda obs: physical(stored.interface, stored.act(stored.policy, obs))


def physical(interface: Interface, action: jax.Array) -> jax.Array:
    """What an action `[..., m]` commands, in physical units and within the limits."""
    limits = interface.limits
    return action if limits is None else jnp.array(limits) * jnp.clip(action, -1.0, 1.0)


def observations(stored: StoredPolicy) -> np.ndarray:
    """What the controller sees, `[10000, n]`: half as it plays itself, half drawn around training's.

    Rows further than `FAR` deviations from training's mean, as a controller plays that diverges, are drawn too.
    """
    number = NUM_OBSERVATIONS // 2
    length = number // NUM_EPISODES
    key_start, key_drawn = jax.random.split(jax.random.key(0))

    @jax.jit
    def played(policy):
        act, starts = functools.partial(stored.act, policy), jax.random.split(key_start, NUM_EPISODES)
        return play(stored.env, act, starts, length, lambda step: (step.before.obs, step.alive))[1]

    normalizer = jax.tree.map(np.asarray, stored.policy.normalizer)
    deviation = np.sqrt(normalizer.variance)
    obs, alive = (np.asarray(x) for x in played(stored.policy))
    seen = obs[alive]
    near = np.all(np.abs(seen - normalizer.mean) <= FAR * deviation, axis=1)
    drawn = np.asarray(jax.random.normal(key_drawn, (NUM_OBSERVATIONS - near.sum(), seen.shape[1])))
    return np.concatenate([seen[near], normalizer.mean + 2 * deviation * drawn]).astype(np.float32)
