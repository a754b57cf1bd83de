"""A trained policy for programs of one's own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from envs.base import Interface
from jaxpg.deploy.controller import command_fn
from jaxpg.errors import UserError
from jaxpg.program.state import Policy as Parameters
from jaxpg.store import policies
from jaxpg.store.cache import physics_cache

CHECKPOINTS = ("best", "last")


@dataclass(frozen=True)
class Policy:
    """A deterministic policy, its value function and their parameters.

    The methods take numpy and give numpy, for one observation `[n]` or several `[..., n]`, in float32. The functions
    are compiled and pure, for what is jitted, differentiated or mapped around them.

    Attributes:
      interface: names, units and limits of observations and commands.
      observation_size, action_size: n and m.
      params: what was learned, an argument of the functions.
      command_fn: `command_fn(params, obs)`, `[..., n]` to `[..., m]`: limit * clip(action, -1, 1) in physical units, as
        exported controllers have it; 0 where an observation is not valid (docs/deploy.md).
      action_fn: `action_fn(params, obs)`, `[..., m]`: what the environment's `step` takes.
      value_fn: `value_fn(params, obs)`, `[...]`: the sum of discounted rewards that the critic expects.
    """

    interface: Interface
    observation_size: int
    action_size: int
    params: Parameters
    command_fn: Callable[[Parameters, Any], jax.Array]
    action_fn: Callable[[Parameters, Any], jax.Array]
    value_fn: Callable[[Parameters, Any], jax.Array]

    def __call__(self, obs: Any) -> np.ndarray:
        """The command, in physical units; raises ValueError for another shape than `[..., n]`, as all methods do."""
        return np.asarray(self.command_fn(self.params, self._observation(obs)))

    def action(self, obs: Any) -> np.ndarray:
        """The action for the environment's `step`."""
        return np.asarray(self.action_fn(self.params, self._observation(obs)))

    def value(self, obs: Any) -> np.ndarray:
        """V(s), what is expected of the discounted rewards to come."""
        return np.asarray(self.value_fn(self.params, self._observation(obs)))

    def _observation(self, obs: Any) -> np.ndarray:
        obs, size = np.asarray(obs, np.float32), self.observation_size
        if obs.ndim == 0 or obs.shape[-1] != size:
            raise ValueError(f"an observation is [{size}], several are [..., {size}]; this one is {list(obs.shape)}")
        return obs


def load(run: str | Path, checkpoint: str = "best", agent: int | None = None) -> Policy:
    """A policy from a run folder; see `jaxpg.load`."""
    if checkpoint not in CHECKPOINTS:
        raise UserError(f"checkpoint={checkpoint}: must be {' or '.join(CHECKPOINTS)}")
    with physics_cache(True):
        stored = policies.load(str(run), checkpoint, agent)
    return Policy(
        interface=stored.interface,
        observation_size=stored.env.observation_size,
        action_size=stored.env.action_size,
        params=stored.policy,
        command_fn=jax.jit(command_fn(stored)),
        action_fn=jax.jit(stored.act),
        value_fn=jax.jit(stored.value),
    )
