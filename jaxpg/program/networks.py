"""The networks of a run, by the name that the configuration gives them."""

from __future__ import annotations

from typing import Any

from jaxpg.config.configuration import Config
from jaxpg.config.schema import NETWORKS
from jaxpg.distributions import GAUSSIAN, SQUASHED_GAUSSIAN
from jaxpg.networks import Networks, linear_networks, mlp_networks


def make_networks(config: Config, env: Any) -> Networks:
    """Actor and critic for the environment's sizes."""
    return NETWORKS[config.choices["network"]].built(config.network, env.observation_size, env.action_size)


def mlp(options: Any, observation_size: int, action_size: int) -> Networks:
    """The entry `mlp`."""
    return mlp_networks(observation_size, action_size, options.widths, options.activation, **_shared(options))


def linear(options: Any, observation_size: int, action_size: int) -> Networks:
    """The entry `linear`."""
    return linear_networks(observation_size, action_size, **_shared(options))


def _shared(options: Any) -> dict[str, Any]:
    """What every Gaussian policy of features is told."""
    return {
        "features": options.features,
        "order": options.order,
        "initial_std": options.sigma,
        "sigma": options.sigma_is,
        "distribution": SQUASHED_GAUSSIAN if options.squash else GAUSSIAN,
    }
