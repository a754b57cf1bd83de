"""A trained policy for your own Python program."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from envs.base import Interface
from jaxpg.deploy.controller import make_command_fn
from jaxpg.errors import UserError
from jaxpg.program.state import Policy as Parameters
from jaxpg.store import policies
from jaxpg.store.cache import physics_cache

CHECKPOINTS = ("best", "last")


@dataclass(frozen=True)
class Policy:
    """A deterministic policy, its value function and their parameters.

    The methods take and return numpy arrays, for one observation `[n]` or several `[..., n]`, in float32. The functions
    are pure and compiled, so they can be used under `jit`, `grad` and `vmap`.

    Attributes:
      interface: names, units and limits of observations and commands.
      observation_size, action_size: n and m.
      params: the learned parameters, an argument of the functions.
      command_fn: `command_fn(params, obs)`, `[..., n]` to `[..., m]`: limit * clip(action, -1, 1) in physical units, as
        in exported controllers; 0 where an observation is not valid (docs/deploy.md).
      action_fn: `action_fn(params, obs)`, `[..., m]`: the action for the environment's `step`.
      value_fn: `value_fn(params, obs)`, `[...]`: the sum of discounted rewards that the critic expects.
    """

    interface: Interface
    observation_size: int
    action_size: int
    params: Parameters
    command_fn: Callable[[Parameters, Any], jax.Array]
    action_fn: Callable[[Parameters, Any], jax.Array]
    value_fn: Callable[[Parameters, Any], jax.Array]

    def __repr__(self) -> str:
        return f"Policy({', '.join(self.interface.observations)} -> {', '.join(self.interface.commands)})"

    def __call__(self, obs: Any) -> np.ndarray:
        """The command, in physical units; like all methods, raises ValueError unless the shape is `[..., n]`."""
        return np.asarray(self.command_fn(self.params, self._observation(obs)))

    def action(self, obs: Any) -> np.ndarray:
        """The action for the environment's `step`."""
        return np.asarray(self.action_fn(self.params, self._observation(obs)))

    def value(self, obs: Any) -> np.ndarray:
        """V(s), the expected sum of discounted rewards."""
        return np.asarray(self.value_fn(self.params, self._observation(obs)))

    def _observation(self, obs: Any) -> np.ndarray:
        obs, size = np.asarray(obs, np.float32), self.observation_size
        if obs.ndim == 0 or obs.shape[-1] != size:
            raise ValueError(f"expected an observation of shape [{size}] or [..., {size}], not {list(obs.shape)}")
        return obs


def load(run: str | os.PathLike[str], checkpoint: str = "best", agent: int | None = None) -> Policy:
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
        command_fn=jax.jit(make_command_fn(stored)),
        action_fn=jax.jit(stored.act),
        value_fn=jax.jit(stored.value),
    )
