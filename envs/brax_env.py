"""brax's own environments, by name: `make("brax", name="inverted_pendulum")`.

They are used as they are, as this project's environments return brax's State too. Of those with MuJoCo's physics only
the physics step is another one (`envs.brax_physics`).
"""

from __future__ import annotations

import contextlib
import io
import warnings
from dataclasses import dataclass
from typing import Any

from envs.options import OptionError, describe_unknown, option
from envs.physics import PHYSICS

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
    backend: str = option(
        "mjx", "brax's physics; mjx is MuJoCo's", choices=("mjx", "generalized", "positional", "spring")
    )
    physics: str = option("scalar", "MuJoCo's step as scalar equations, MJX, or C MuJoCo", choices=tuple(PHYSICS))
    episode_length: int = option(1000, "steps until the time limit", at_least=1)


def make(config: BraxConfig) -> Any:
    """The brax environment.

    Raises:
      OptionError: brax has no such environment (with the nearest name), or it does not run; or `physics` is given with
        another backend than MuJoCo's.
    """
    if config.backend != "mjx" and config.physics != BraxConfig.physics:
        raise OptionError([f"env.physics={config.physics} needs env.backend=mjx; it is {config.backend}"])
    if config.name == "swimmer":  # brax.fluid passes jax.numpy.clip an argument that no longer exists
        raise OptionError(["env.name=swimmer: brax's does not run with jax 0.10 or newer"])
    # At every import brax says that it is no longer maintained, and MJX that Warp is missing: neither helps here.
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        from brax import envs

        try:
            env = envs.get_environment(config.name, backend=config.backend)
        except KeyError:
            pass
        else:
            return _with_physics(env, config)
    known = ("ant", "fast", "halfcheetah", "hopper", "humanoid", "humanoidstandup", "inverted_pendulum")
    known += ("inverted_double_pendulum", "pusher", "reacher", "walker2d")
    raise OptionError([describe_unknown("brax environment", config.name, known)])


def _with_physics(env: Any, config: BraxConfig) -> Any:
    is_mujoco = config.backend == "mjx" and hasattr(env, "sys")  # brax's toy `fast` has no physics
    if not is_mujoco or config.physics == "mjx":
        return env
    from envs.brax_physics import replace_physics  # loads brax

    return replace_physics(env, config.physics)
