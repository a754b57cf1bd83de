"""A trained policy as a robot runs it: physical observations in, physical commands out, without JAX.

    command = limit * clip(squash(f(phi(z))), -1, 1),    z = (s - m) * scale

with the features phi and the network f of the actor, the scale of `jaxpg.normalization`, and squash either tanh or the
identity. All export formats are written from this form.

An observation is valid if all |z_i| <= `MAX_DEVIATION`, so none is NaN, infinite, or large enough to overflow. If the
observation is not valid or the action is not finite, every command is 0.
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
from jaxpg.deploy.identifiers import escape_text, make_identifier
from jaxpg.errors import UserError
from jaxpg.evaluation import play
from jaxpg.program.state import Policy
from jaxpg.store.policies import StoredPolicy

MAX_DEVIATION = 1e6  # standard deviations from training's mean
NUM_OBSERVATIONS = 10_000  # that an export is tested on
NUM_EPISODES = 50
MAX_PLAYED_DEVIATION = 10.0


class Layer(NamedTuple):
    """x -> weight' x + bias: `[inputs, outputs]` and `[outputs]`."""

    weight: np.ndarray
    bias: np.ndarray


class Learner(NamedTuple):
    """What a linear-Gaussian controller needs to continue learning with `algo=online`.

    Attributes:
      value: the critic's layer.
      log_std: log sigma, `[m]`.
      options: options of the algorithm.
      learns_sigma: whether sigma is a parameter of the policy.
    """

    value: Layer
    log_std: np.ndarray
    options: Online
    learns_sigma: bool


class Controller(NamedTuple):
    """The numbers of a policy, all float32.

    Attributes:
      name: prefix of files and identifiers, such as "pendulum".
      interface: names, units and limits of observations and commands.
      mean, scale: observations enter as (s - mean) * scale, `[n]`.
      features, order: phi, as a name in `jaxpg.program.networks.FEATURES` and its order.
      layers: layers of f, with the activation between them.
      activation: a name in `jaxpg.program.networks.ACTIVATIONS`.
      squash: whether tanh is applied to the last layer.
      origin: descriptions of where the policy comes from, by name.
      learner: state for further learning if the policy was trained step by step, else None.
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


def make_controller(stored: StoredPolicy, origin: dict[str, str], name: str | None = None) -> Controller:
    """The controller of a stored policy.

    Args:
      stored: the policy.
      origin: as in `Controller`.
      name: as in `Controller`; None derives it from the task.

    Raises:
      UserError: a number is not finite, the environment's interface has the wrong number of entries, or files and
        identifiers cannot begin with the name.
    """
    config, network = stored.config, stored.config.network
    dense = stored.policy.params["actor"]["params"]["MLP_0"]
    layers = [dense[f"Dense_{i}"] for i in range(len(dense))]
    controller = Controller(
        name=make_identifier(config.task) if name is None else _check_name(name),
        interface=_normalize_interface(stored.interface),
        mean=np.asarray(stored.policy.normalizer.mean),
        scale=np.asarray(normalization.inverse_deviation(stored.policy.normalizer)),
        features=network.features,
        order=network.order,
        layers=[Layer(np.asarray(layer["kernel"]), np.asarray(layer["bias"])) for layer in layers],
        activation=network.activation,
        squash=network.squash,
        origin={key: escape_text(text) for key, text in origin.items()},
        learner=_make_learner(stored),
    )
    _check_numbers(controller)
    return controller


def _check_name(name: str) -> str:
    if name != make_identifier(name):
        raise UserError(f"name={name}: not a prefix for C identifiers and file names; try name={make_identifier(name)}")
    return name


def _normalize_interface(interface: Interface) -> Interface:
    """The interface as tuples of printable strings and of floats."""
    names, commands, limits = interface
    names, commands = (tuple(escape_text(str(text)) for text in texts) for texts in (names, commands))
    return Interface(names, commands, None if limits is None else tuple(float(x) for x in limits))


def _check_numbers(controller: Controller) -> None:
    limits = controller.interface.limits
    sizes = {
        "interface.observations": (len(controller.interface.observations), controller.observation_size),
        "interface.commands": (len(controller.interface.commands), controller.action_size),
        "interface.limits": (controller.action_size if limits is None else len(limits), controller.action_size),
    }
    for name, (size, expected) in sizes.items():
        if size != expected:
            raise UserError(f"the environment's {name} has {size} entries, expected {expected}")
    numbers = {
        "observation statistics": [controller.mean, controller.scale],
        "network": jax.tree.leaves(controller.layers),
    }
    for name, arrays in (numbers | {"limits": [limits or 0.0]}).items():
        if not all(np.all(np.isfinite(array)) for array in arrays):
            raise UserError(f"the policy cannot be exported: its {name} contain numbers that are not finite")


def _make_learner(stored: StoredPolicy) -> Learner | None:
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


def make_command_fn(stored: StoredPolicy) -> Callable[[Policy, jax.Array], jax.Array]:
    """`command(policy, obs)`, `[..., n]` to `[..., m]`: the controller in JAX, with the parameters as an argument."""

    def command(policy, obs):
        action = stored.act(policy, obs)
        z = (obs - policy.normalizer.mean) * normalization.inverse_deviation(policy.normalizer)
        valid = jnp.all(jnp.abs(z) <= MAX_DEVIATION, axis=-1) & jnp.all(jnp.isfinite(action), axis=-1)
        return jnp.where(valid[..., None], to_physical(stored.interface, action), 0.0)

    return command


def make_command(stored: StoredPolicy) -> Callable[[jax.Array], jax.Array]:
    """`command(obs)`, `[..., n]` to `[..., m]`: `make_command_fn` with the stored parameters."""
    command = make_command_fn(stored)
    return lambda obs: command(stored.policy, obs)


def to_physical(interface: Interface, action: jax.Array) -> jax.Array:
    """The command for an action `[..., m]`, in physical units and within the limits."""
    limits = interface.limits
    return action if limits is None else jnp.array(limits) * jnp.clip(action, -1.0, 1.0)


def collect_observations(stored: StoredPolicy) -> np.ndarray:
    """Test observations, `[10000, n]`: some from episodes that the controller plays, the others random."""
    played = play_observations(stored)
    return np.concatenate([played, draw_observations(stored, played)])


def play_observations(stored: StoredPolicy) -> np.ndarray:
    """Observations from 5,000 steps that the controller plays, `[<= 5000, n]`.

    Rows more than `MAX_PLAYED_DEVIATION` standard deviations from training's mean are left out, as a diverging
    controller produces them. Without normalization in training, only rows that are not valid are left out.
    """
    length = NUM_OBSERVATIONS // 2 // NUM_EPISODES
    keys = jax.random.split(jax.random.key(0), NUM_EPISODES)

    @jax.jit
    def play_episodes(policy):
        act = functools.partial(stored.act, policy)
        return play(stored.env, act, keys, length, lambda step: (step.before.obs, step.alive))[1]

    obs, alive = (np.asarray(x) for x in play_episodes(stored.policy))
    visited = obs[alive].astype(np.float32)
    if not stored.policy.normalizer.count:
        return visited[np.all(np.abs(visited) <= MAX_DEVIATION, axis=1)]
    mean, deviation = _training_statistics(stored)
    last_digits = 1e-6 * np.abs(mean)  # a constant's mean differs from it by these
    return visited[np.all(np.abs(visited - mean) <= MAX_PLAYED_DEVIATION * deviation + last_digits, axis=1)]


def draw_observations(stored: StoredPolicy, played: np.ndarray) -> np.ndarray:
    """Random observations around training's mean with twice its deviation; as many as complete `played` to 10,000.

    Without normalization in training, mean and deviation are those of `played`, unless it is empty.
    """
    mean, deviation = _training_statistics(stored)
    if not stored.policy.normalizer.count and len(played):
        mean, deviation = played.mean(axis=0), played.std(axis=0)
    noise = np.asarray(jax.random.normal(jax.random.key(1), (NUM_OBSERVATIONS - len(played), len(mean))))
    return (mean + 2 * deviation * noise).astype(np.float32)


def _training_statistics(stored: StoredPolicy) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of training's observations."""
    normalizer = stored.policy.normalizer
    return np.asarray(normalizer.mean), np.sqrt(np.asarray(normalizer.variance))
