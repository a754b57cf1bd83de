"""Records complete episodes step by step, for reports and videos."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.scenes import find_phase_plane
from jaxpg.deploy.controller import to_physical
from jaxpg.evaluation import play
from jaxpg.program.backend import RUN_ONCE
from jaxpg.program.state import Policy
from jaxpg.store.policies import StoredPolicy
from jaxpg.watch.view import View, find_view


class Look(NamedTuple):
    """How states `[...]` look; None for what the environment lacks.

    Attributes:
      qpos: joint positions, `[..., nq]`.
      goal: position of the goal, `[..., 3]` [m].
      rotation: orientation of the goal, `[..., 3, 3]`.
      plane: coordinates in the phase plane, `[..., 2]`.
    """

    qpos: Any
    goal: Any
    plane: Any
    rotation: Any = None


class Recording(NamedTuple):
    """N episodes of one policy, time first; after the end of an episode states stay fixed and rewards are 0.

    Attributes:
      look: before each step and after the last one, `[T + 1, N, ...]`.
      command: in physical units, `[T, N, m]`.
      reward: `[T, N]`.
      value: V(s_t), the sum of discounted rewards that the critic expects, `[T, N]`.
      length: steps until termination, divergence or the time limit, `[N]`.
      metrics: metrics of the environment, for each step the last finite ones, `[T, N]` by name.
      diverged: whether the physics diverged, `[N]` of bool.
    """

    look: Look
    command: np.ndarray
    reward: np.ndarray
    value: np.ndarray
    length: np.ndarray
    metrics: dict[str, np.ndarray]
    diverged: np.ndarray

    @property
    def episode_return(self) -> np.ndarray:
        """Undiscounted, `[N]`."""
        alive = np.arange(len(self.reward))[:, None] < self.length
        return np.where(alive, self.reward, 0.0).sum(axis=0, dtype=np.float64)


def record(
    stored: StoredPolicy, policies: Sequence[Policy], starts: jax.Array, view: View | None = None
) -> list[Recording]:
    """An episode of each policy from each start.

    Args:
      stored: has the environment and `act`.
      policies: policies with the same network.
      starts: random keys of the starts, `[N]`.
      view: what can be drawn of the environment; None: find it.
    """
    look = jax.vmap(make_look(view or find_view(stored.env)))
    play = jax.jit(lambda policy: _play(stored, policy, starts, look)).lower(stored.policy).compile(RUN_ONCE)
    return [Recording(*jax.tree.map(np.asarray, play(policy))) for policy in policies]


def _play(stored: StoredPolicy, policy: Policy, starts: jax.Array, look: Callable[[Any], Look]) -> tuple:
    """The fields of a `Recording`."""
    env = stored.env

    def observe(step):
        value = stored.value(policy, step.before.obs)
        return look(step.after), to_physical(stored.interface, step.action), step.reward, value, step.metrics

    length = stored.config.env.episode_length
    episodes, (after, command, reward, value, metrics) = play(
        env, functools.partial(stored.act, policy), starts, length, observe
    )
    first = look(jax.vmap(env.reset)(jax.random.clone(starts)))  # the same starts on purpose
    looks = jax.tree.map(lambda x, rest: jnp.concatenate([x[None], rest]), first, after)
    return looks, command, reward, value, episodes.length, metrics, episodes.diverged


def make_look(view: View) -> Callable[[Any], Look]:
    """Returns `look(State) -> Look`."""
    scene, plane = view

    def look(state):
        return Look(
            qpos=scene.qpos(state) if scene else None,
            goal=scene.goal(state) if scene and scene.goal else None,
            plane=plane.coordinates(state) if plane else None,
            rotation=scene.goal_rotation(state) if scene and scene.goal_rotation else None,
        )

    return look


def compute_value_map(stored: StoredPolicy, policies: Sequence[Policy], columns: int, rows: int) -> list[np.ndarray]:
    """V over the environment's phase plane, for each policy: `[rows, columns]`, row 0 at the lower end of y."""
    plane = find_phase_plane(stored.env)
    assert plane is not None  # whoever asks has it
    x, y = (jnp.linspace(low, high, n) for (low, high), n in zip(plane.ranges, (columns, rows), strict=True))
    obs = jax.vmap(lambda b: jax.vmap(lambda a: plane.observe(a, b))(x))(y)
    value = jax.jit(stored.value)
    return [np.asarray(value(policy, obs)) for policy in policies]
