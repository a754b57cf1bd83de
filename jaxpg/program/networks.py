"""Builds the networks of a run, with the functions named by its options."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from envs.base import Env
from jaxpg import features, networks
from jaxpg.config.configuration import Config
from jaxpg.config.entries import NETWORKS
from jaxpg.distributions import GAUSSIAN, SQUASHED_GAUSSIAN
from jaxpg.networks import Networks, Sigma, linear_networks, mlp_networks

ACTIVATIONS = {"tanh": jnp.tanh, "relu": jax.nn.relu, "elu": jax.nn.elu, "swish": jax.nn.swish}
FEATURES = {
    "identity": features.identity,
    "polynomial": features.polynomial,
    "fourier": features.fourier,
    "radial": features.radial,
}
NUM_FEATURES: dict[str, Callable[[int, int], int]] = {  # as functions of the observation size and the order
    "identity": lambda size, order: size,
    "polynomial": lambda size, order: math.comb(size + order, order) - 1,
    "fourier": lambda size, order: (order + 1) ** size - 1,
    "radial": lambda size, order: order**size,
}
# A scheduled sigma is a parameter, set by `jaxpg.program.sigma`.
SIGMAS: dict[str, Callable[[float], Sigma]] = {
    "fixed": networks.fixed,
    "learned": networks.learned,
    "scheduled": networks.learned,
    "state": networks.state_dependent,
}


def make_networks(config: Config, env: Env) -> Networks:
    """Actor and critic for the environment's sizes."""
    return NETWORKS[config.choices["network"]].make(config.network, env.observation_size, env.action_size)


def make_mlp(options: Any, observation_size: int, action_size: int) -> Networks:
    """Builds the entry `mlp`."""
    activation = ACTIVATIONS[options.activation]
    return mlp_networks(observation_size, action_size, options.widths, activation, **_make_shared_arguments(options))


def make_linear(options: Any, observation_size: int, action_size: int) -> Networks:
    """Builds the entry `linear`."""
    return linear_networks(observation_size, action_size, **_make_shared_arguments(options))


def _make_shared_arguments(options: Any) -> dict[str, Any]:
    """The arguments that both kinds of networks take."""
    return {
        "features": functools.partial(FEATURES[options.features], order=options.order),
        "sigma": SIGMAS[options.sigma_is](options.sigma),
        "distribution": SQUASHED_GAUSSIAN if options.squash else GAUSSIAN,
    }
