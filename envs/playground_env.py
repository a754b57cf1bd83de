"""MuJoCo Playground's environments, by name: `make("playground", name="CartpoleBalance")`.

Playground steps them by `mjx.step`; here `envs.playground_physics` stands in for it. If Playground has several
observations by name, such as one for the critic only, the entry "state" is used.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import subprocess
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax

from envs.base import State
from envs.hints import pip_install
from envs.options import OptionError, describe_unknown, option
from envs.physics import PHYSICS
from envs.scenes import Scene

# Steps are slow, so checkpoints come after fewer of them.
_SLOW = {"total_steps": 2_000_000, "eval_episodes": 16, "checkpoint_interval": 500_000}
TRAINING = {
    "ppo": {  # the best of a handful of settings on CartpoleBalance, where TD(lambda) with its defaults learns little
        **_SLOW,
        "num_envs": 128,
        "num_steps": 32,
        "algo.epochs": 4,
        "algo.minibatches": 8,
        "algo.actor_lr": 0.0005,
        "algo.gamma": 0.995,
        "algo.reward_scale": 0.1,
    },
    "td": {**_SLOW, "num_envs": 64},
    "reinforce": {**_SLOW, "num_envs": 16},
}


@dataclass(frozen=True)
class PlaygroundConfig:
    """Options of a Playground environment."""

    name: str = option("CartpoleBalance", "Playground's name of the environment")
    physics: str = option("scalar", "MuJoCo's step as scalar equations, MJX, or C MuJoCo", choices=tuple(PHYSICS))
    episode_length: int = option(1000, "steps until the time limit", at_least=1)


class Playground:
    """A Playground environment with brax's interface; Playground's State is in `State.pipeline_state`.

    Args:
      env: has Playground's `reset(key) -> State` and `step(State, action) -> State`.
      physics: "mjx", which is Playground's own; or "scalar" or "mujoco".
    """

    def __init__(self, env: Any, physics: str = "mjx"):
        self.env, self.action_size = env, env.action_size
        self._in_place = contextlib.nullcontext if physics == "mjx" else _make_physics(env, physics)

    @property
    def observation_size(self) -> int:
        return jax.eval_shape(self.reset, jax.random.key(0)).obs.shape[-1]

    @property
    def backend(self) -> str:
        return "mjx"

    @property
    def unwrapped(self) -> Any:
        return self.env

    @property
    def dt(self) -> float:
        return self.env.dt

    @property
    def scene(self) -> Scene:
        return Scene(self.env.mj_model, lambda state: state.pipeline_state.data.qpos)

    def reset(self, rng: jax.Array) -> State:
        """Playground's reset; it gets the key as two numbers, since it stores keys in its states."""
        with self._in_place():
            return adapt_state(self.env.reset(jax.random.key_data(rng)))

    def step(self, state: State, action: jax.Array) -> State:
        """Playground's step."""
        with self._in_place():
            return adapt_state(self.env.step(state.pipeline_state, action))


def _make_physics(env: Any, physics: str) -> Callable[[], contextlib.AbstractContextManager]:
    from envs.playground_physics import Physics  # loads mujoco

    return Physics(env, physics).in_place


def adapt_state(state: Any) -> State:
    """Playground's whole state within brax's, with an array as observation."""
    obs = state.obs["state"] if isinstance(state.obs, Mapping) else state.obs
    return State(state, obs, state.reward, state.done, state.metrics)


def make(config: PlaygroundConfig) -> Playground:
    """The environment of that name.

    Raises:
      OptionError: Playground is not installed, has no such environment (with the nearest name), or cannot make it. Its
        robots are from MuJoCo Menagerie, which it downloads at first use, and a few of its environments do not work
        with the current MuJoCo.
    """
    if importlib.util.find_spec("mujoco_playground") is None:
        raise OptionError([f"env=playground needs MuJoCo Playground: {pip_install('playground')}"])
    # Hides messages of its dependencies while they are imported.
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        from mujoco_playground import registry  # pyright: ignore[reportMissingImports] # an extra of its own

        if config.name not in registry.ALL_ENVS:
            raise OptionError([describe_unknown("Playground environment", config.name, registry.ALL_ENVS)])
        try:
            env = registry.load(config.name, config_overrides={"impl": "jax"})
        except (OSError, subprocess.SubprocessError) as error:
            reason = f"its robot is from MuJoCo Menagerie, which Playground could not download ({error})"
        except AttributeError as error:
            reason = f"Playground does not work with this release of MuJoCo ({error})"
        else:
            return Playground(env, config.physics)
    raise OptionError([f"env.name={config.name}: {reason}"])
