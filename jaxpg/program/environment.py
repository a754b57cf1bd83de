"""Makes the environment of a run."""

from __future__ import annotations

from typing import Any

import envs
from envs.base import Env
from envs.options import OptionError
from jaxpg.config.configuration import Config
from jaxpg.program.networks import NUM_FEATURES

MAX_FEATURES = 10_000  # a grid over many observations soon exceeds any memory


def make_env(config: Config) -> Env:
    """The environment; raises OptionError if it reports a mistake, or would have too many features."""
    env = envs.make_from_config(config.choices["env"], config.env)
    _check_features(config.network, env.observation_size)
    return env


def _check_features(network: Any, observation_size: int) -> None:
    number = NUM_FEATURES[network.features](observation_size, network.order)
    if number > MAX_FEATURES:
        name = f"network.features={network.features} network.order={network.order}"
        raise OptionError(
            [f"{name}: {number:,} features of {observation_size} observations; the maximum is {MAX_FEATURES:,}"]
        )


def get_training_length(config: Config) -> int:
    """Steps of a training episode; TD may cut it before the time limit, and bootstraps there as well."""
    limit = config.env.episode_length
    return min(config.algo.episode_length or limit, limit)
