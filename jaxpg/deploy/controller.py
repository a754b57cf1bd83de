"""A trained policy as what a robot runs: physical observations in, physical commands out, and nothing of JAX.

    command = limit * clip(squash(f(phi(z))), -1, 1),    z = (s - m) * scale

with the features phi and the network f of the actor, the scale of `jaxpg.normalization`, and squash = tanh or nothing.
Every format is written from here.

An observation is valid if all |z_i| <= `FARTHEST`: none is NaN, infinite, or so large that floats run out of range. Of
one that is not valid, or whose action is not finite, every command is 0.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Interface
from jaxpg import normalization
from jaxpg.config.schema import Linear, Online
from jaxpg.deploy.names import identifier, printable
from jaxpg.errors import UserError
from jaxpg.evaluation import play
from jaxpg.program.state import Policy
from jaxpg.store.policies import StoredPolicy

FARTHEST = 1e6  # deviations from training's mean: beyond, an observation is not valid
NUM_OBSERVATIONS = 10_000  # on which a controller is tried
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
      options: those of the algorithm, `jaxpg.config.schema.Online`.
      learns_sigma: whether sigma is one of the policy's parameters.
    """

    value: Layer
    log_std: np.ndarray
    options: Online
    learns_sigma: bool


class Controller(NamedTuple):
    """The numbers of a policy, all float32.

    Attributes:
      name: what files and identifiers begin with, such as "pendulum".
      interface: names, units and limits of observations and commands.
      mean, scale: observations enter as (s - mean) * scale, `[n]`.
      features, order: phi, a name in `jaxpg.program.networks.FEATURES` and its order.
      layers: of f, with the activation between them.
      activation: a name in `jaxpg.program.networks.ACTIVATIONS`.
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


def controller(stored: StoredPolicy, origin: dict[str, str], name: str | None = None) -> Controller:
    """The numbers of a stored policy.

    Args:
      stored: the policy.
      origin: as in `Controller`.
      name: as in `Controller`; None makes one of the task's.

    Raises:
      UserError: a number is not finite, the environment names more or fewer numbers than there are, or the name is none
        that files and identifiers can begin with.
    """
    config, network = stored.config, stored.config.network
    dense = stored.policy.params["actor"]["params"]["MLP_0"]
    layers = [dense[f"Dense_{i}"] for i in range(len(dense))]
    made = Controller(
        name=identifier(config.task) if name is None else _checked_name(name),
        interface=_plain(stored.interface),
        mean=np.asarray(stored.policy.normalizer.mean),
        scale=np.asarray(normalization.inverse_deviation(stored.policy.normalizer)),
        features=network.features,
        order=network.order,
        layers=[Layer(np.asarray(layer["kernel"]), np.asarray(layer["bias"])) for layer in layers],
        activation=network.activation,
        squash=network.squash,
        origin={key: printable(text) for key, text in origin.items()},
        learner=_learner(stored),
    )
    _check_numbers(made)
    return made


def _checked_name(name: str) -> str:
    if name != identifier(name):
        raise UserError(f"name={name}: C identifiers and files cannot begin so; name={identifier(name)} is possible")
    return name


def _plain(interface: Interface) -> Interface:
    """The same in tuples of printable texts and of floats, whatever the environment has them in."""
    names, commands, limits = interface
    texts = (tuple(printable(str(text)) for text in names) for names in (names, commands))
    return Interface(*texts, None if limits is None else tuple(float(x) for x in limits))


def _check_numbers(made: Controller) -> None:
    limits = made.interface.limits
    sizes = {
        "interface.observations": (len(made.interface.observations), made.observation_size),
        "interface.commands": (len(made.interface.commands), made.action_size),
        "interface.limits": (made.action_size if limits is None else len(limits), made.action_size),
    }
    for name, (found, expected) in sizes.items():
        if found != expected:
            raise UserError(f"the environment's {name} has {found} entries, and must have {expected}")
    numbers = {"observation statistics": [made.mean, made.scale], "network": jax.tree.leaves(made.layers)}
    for name, arrays in (numbers | {"limits": [limits or 0.0]}).items():
        if not all(np.all(np.isfinite(array)) for array in arrays):
            raise UserError(f"the policy cannot leave the library: in its {name} are numbers that are not finite")


def _learner(stored: StoredPolicy) -> Learner | None:
    config, params = stored.config, stored.policy.params
    learns_sigma = config.network.sigma_is == "learned"
    linear = isinstance(config.network, Linear) and config.network.sigma_is in ("fixed", "learned")
    if not isinstance(config.algo, Online) or not linear:
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


def command_fn(stored: StoredPolicy) -> Callable[[Policy, jax.Array], jax.Array]:
    """`command(policy, obs)`, `[..., n]` to `[..., m]`, of a policy's parameters: the controller as JAX computes it."""

    def command(policy, obs):
        action = stored.act(policy, obs)
        z = (obs - policy.normalizer.mean) * normalization.inverse_deviation(policy.normalizer)
        valid = jnp.all(jnp.abs(z) <= FARTHEST, axis=-1) & jnp.all(jnp.isfinite(action), axis=-1)
        return jnp.where(valid[..., None], physical(stored.interface, action), 0.0)

    return command


def commanding(stored: StoredPolicy) -> Callable[[jax.Array], jax.Array]:
    """`command(obs)`, `[..., n]` to `[..., m]`: as `command_fn`, with the stored parameters."""
    command = command_fn(stored)
    return lambda obs: command(stored.policy, obs)


def physical(interface: Interface, action: jax.Array) -> jax.Array:
    """What an action `[..., m]` commands, in physical units and within the limits."""
    limits = interface.limits
    return action if limits is None else jnp.array(limits) * jnp.clip(action, -1.0, 1.0)


def observations(stored: StoredPolicy) -> np.ndarray:
    """What the controller is tried on, `[10000, n]`: what it sees as it plays, and others that are drawn."""
    seen = played(stored)
    return np.concatenate([seen, drawn(stored, seen)])


def played(stored: StoredPolicy) -> np.ndarray:
    """What the controller sees in 5,000 steps of its own, `[<= 5000, n]`.

    Rows further than `FAR` deviations from training's mean, as a controller plays that diverges, are left out; where
    training took the observations as they are, rows that are not valid.
    """
    length = NUM_OBSERVATIONS // 2 // NUM_EPISODES
    keys = jax.random.split(jax.random.key(0), NUM_EPISODES)

    @jax.jit
    def seen_by(policy):
        act = functools.partial(stored.act, policy)
        return play(stored.env, act, keys, length, lambda step: (step.before.obs, step.alive))[1]

    obs, alive = (np.asarray(x) for x in seen_by(stored.policy))
    seen = obs[alive].astype(np.float32)
    if not stored.policy.normalizer.count:
        return seen[np.all(np.abs(seen) <= FARTHEST, axis=1)]
    mean, deviation = _scatter(stored)
    last_digits = 1e-6 * np.abs(mean)  # a constant's mean is the constant but for these
    return seen[np.all(np.abs(seen - mean) <= FAR * deviation + last_digits, axis=1)]


def drawn(stored: StoredPolicy, seen: np.ndarray) -> np.ndarray:
    """Observations around training's mean, with twice its deviation; with those that were seen they are 10,000.

    Where training took the observations as they are, around those that were seen, if there are some.
    """
    mean, deviation = _scatter(stored)
    if not stored.policy.normalizer.count and len(seen):
        mean, deviation = seen.mean(axis=0), seen.std(axis=0)
    noise = np.asarray(jax.random.normal(jax.random.key(1), (NUM_OBSERVATIONS - len(seen), len(mean))))
    return (mean + 2 * deviation * noise).astype(np.float32)


def _scatter(stored: StoredPolicy) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of the observations in training."""
    normalizer = stored.policy.normalizer
    return np.asarray(normalizer.mean), np.sqrt(np.asarray(normalizer.variance))
