"""brax's own environments, by name: `make("brax", name="inverted_pendulum")`.

They are used unchanged, as this project's environments return brax's State too. They carry all of brax's pipeline
state, and are as fast as brax is on a CPU.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from dataclasses import dataclass
from typing import Any

from envs.options import OptionError, describe_unknown, option

# Steps are slow, so checkpoints come after fewer of them.
_SLOW = {"total_steps": 2_000_000, "eval_episodes": 16, "checkpoint_interval": 500_000}
TRAINING = {
    "td": {**_SLOW, "num_envs": 64},
    "reinforce": {**_SLOW, "num_envs": 16},
    "ppo": {  # the best of a handful of settings on the reacher
        **_SLOW,
        "num_envs": 128,
        "num_steps": 32,
        "algo.epochs": 4,
        "algo.minibatches": 8,
        "algo.actor_lr": 0.0005,
        "algo.gamma": 0.98,
        "algo.reward_scale": 0.1,
    },
}


@dataclass(frozen=True)
class BraxConfig:
    """Options of a brax environment."""

    name: str = option("inverted_pendulum", "brax's name of the environment")
    backend: str = option("mjx", "brax's physics", choices=("mjx", "generalized", "positional", "spring"))
    episode_length: int = option(1000, "steps until the time limit", at_least=1)


def make(config: BraxConfig) -> Any:
    """The brax environment.

    Raises:
      OptionError: brax has no such environment (with the nearest name), or it does not run.
    """
    if config.name == "swimmer":  # brax.fluid passes jax.numpy.clip an argument that no longer exists
        raise OptionError(["env.name=swimmer: brax's does not run with jax 0.10 or newer"])
    # At every import brax says that it is no longer maintained, and MJX that Warp is missing: neither helps here.
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        from brax import envs

        try:
            return envs.get_environment(config.name, backend=config.backend)
        except KeyError:
            pass
    known = ("ant", "fast", "halfcheetah", "hopper", "humanoid", "humanoidstandup", "inverted_pendulum")
    known += ("inverted_double_pendulum", "pusher", "reacher", "walker2d")
    raise OptionError([describe_unknown("brax environment", config.name, known)])
