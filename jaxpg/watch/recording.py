"""Complete episodes step by step: what reports and videos are drawn from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.scenes import scene
from jaxpg.deploy.controller import physical
from jaxpg.run.policies import StoredPolicy
from jaxpg.run.program import RUN_ONCE
from jaxpg.run.state import Policy
from jaxpg.types import Metrics


class Look(NamedTuple):
    """What is seen of states `[...]`; None where the environment has no such thing.

    Attributes:
      qpos: joint positions, `[..., nq]`.
      goal: where to get, `[..., 3]` [m].
      plane: coordinates in the phase plane, `[..., 2]`.
    """

    qpos: Any
    goal: Any
    plane: Any


class Recording(NamedTuple):
    """N episodes of one policy, time first; what comes after an episode's end is to be left out.

    Attributes:
      look: before each step and after the last one, `[T + 1, N, ...]`.
      command: in physical units, `[T, N, m]`.
      reward: `[T, N]`.
      value: V(s_t), the critic's guess of the discounted rewards to come, `[T, N]`.
      length: steps until termination or the time limit, `[N]`.
      metrics: the environment's, after each step, `[T, N]` by name.
    """

    look: Look
    command: np.ndarray
    reward: np.ndarray
    value: np.ndarray
    length: np.ndarray
    metrics: Metrics

    @property
    def episode_return(self) -> np.ndarray:
        """Undiscounted, `[N]`."""
        alive = np.arange(len(self.reward))[:, None] < self.length
        return np.sum(np.where(alive, self.reward, 0.0), axis=0, dtype=np.float64)


def record(stored: StoredPolicy, policies: Sequence[Policy], starts: jax.Array) -> list[Recording]:
    """An episode of each policy from each start.

    Args:
      stored: how policies act, and where.
      policies: all of the same network.
      starts: random keys that fix them, `[N]`.
    """
    play = jax.jit(lambda policy: _play(stored, policy, starts)).lower(stored.policy).compile(RUN_ONCE)
    return [jax.tree.map(np.asarray, play(policy)) for policy in policies]


def _play(stored: StoredPolicy, policy: Policy, starts: jax.Array) -> Recording:
    env, look = stored.env, jax.vmap(looking(stored.env))

    def step(state, _):
        action = stored.act(policy, state.obs)
        after = jax.vmap(env.step)(state, action)
        return after, (
            look(after),
            physical(stored.interface, action),
            after.reward,
            stored.value(policy, state.obs),
            after.done,
            after.metrics,
        )

    first = jax.vmap(env.reset)(starts)
    _, (seen, command, reward, values, done, metrics) = jax.lax.scan(
        step, first, length=stored.config.env.episode_length
    )
    seen = jax.tree.map(lambda x, rest: jnp.concatenate([x[None], rest]), look(first), seen)
    ended = jnp.cumsum(done, axis=0) - done > 0
    return Recording(seen, command, reward, values, jnp.sum(~ended, axis=0), metrics)


def looking(env: Any):
    """`look(State) -> Look` of an environment's states."""
    view, plane = scene(env), getattr(env, "phase_plane", None)

    def look(state):
        return Look(
            qpos=view.qpos(state) if view else None,
            goal=view.goal(state) if view and view.goal else None,
            plane=plane.coordinates(state) if plane else None,
        )

    return look


def value_map(stored: StoredPolicy, policies: Sequence[Policy], columns: int, rows: int) -> list[np.ndarray]:
    """V over the phase plane of the environment, for each policy: `[rows, columns]`, row 0 at the lower end of y."""
    plane = stored.env.phase_plane
    x, y = (jnp.linspace(low, high, n) for (low, high), n in zip(plane.ranges, (columns, rows), strict=True))
    obs = jax.vmap(lambda b: jax.vmap(lambda a: plane.observe(a, b))(x))(y)
    value = jax.jit(stored.value)
    return [np.asarray(value(policy, obs)) for policy in policies]
