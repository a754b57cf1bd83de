"""Plays complete episodes of a stored policy, in its own environment or in Gymnasium's."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import numpy as np

import envs
from envs.base import with_fields
from envs.batches import divide_batch
from envs.hints import pip_install
from jaxpg.errors import UserError
from jaxpg.evaluation import evaluate
from jaxpg.store.names import rename_metrics
from jaxpg.store.policies import StoredPolicy
from jaxpg.store.statistics import penalize_diverged


class Results(NamedTuple):
    """Results of N episodes.

    Attributes:
      returns: returns, with diverged episodes penalized (`penalize_diverged`), `[N]`.
      diverged: whether the physics diverged, `[N]` of bool.
      metrics: metrics of the environment at the last step, `[N]` by their logged names (`rename_metrics`).
    """

    returns: np.ndarray
    diverged: np.ndarray
    metrics: dict[str, np.ndarray]


def play_native(stored: StoredPolicy, num_episodes: int, seed: int) -> Results:
    """Episodes in the environment that the policy was trained on, on all devices; the seed fixes the starts."""

    def play(policy, starts):
        return evaluate(stored.env, functools.partial(stored.act, policy), starts, stored.config.env.episode_length)

    starts = jax.random.split(jax.random.key(seed), num_episodes)
    episodes = jax.tree.map(np.asarray, divide_batch(play, (None, 0))(stored.policy, starts))
    returns = penalize_diverged(episodes.episode_return, episodes.diverged)
    return Results(returns, episodes.diverged, rename_metrics(episodes.metrics))


def replace_by_baseline(stored: StoredPolicy) -> StoredPolicy:
    """The stored policy, replaced by the textbook controller of its environment, which sees the whole state.

    Raises:
      UserError: the environment has none.
    """
    if not hasattr(stored.env, "baseline"):
        raise UserError(f"policy=baseline: env={stored.config.choices['env']} has no controller to compare with")
    return stored._replace(env=_ObservesBaseline(stored.env), act=lambda policy, obs: obs)


class _ObservesBaseline:
    """An environment whose observation is the action of its own controller."""

    def __init__(self, env: Any):
        self.env = env

    def reset(self, rng: jax.Array) -> Any:
        return self._observe(self.env.reset(rng))

    def step(self, state: Any, action: jax.Array) -> Any:
        return self._observe(self.env.step(state, action))

    def _observe(self, state: Any) -> Any:
        return with_fields(state, obs=self.env.baseline(state))


def play_gymnasium(stored: StoredPolicy, num_episodes: int, seed: int) -> Results:
    """Episodes in Gymnasium's Pendulum-v1, started with the seeds seed, seed + 1, ...

    Raises:
      UserError: the environment is not the pendulum with Gymnasium's constants, or Gymnasium is not installed.
    """
    if stored.config.choices["env"] != "pendulum" or stored.config.env != envs.REGISTRY["pendulum"].config():
        raise UserError("backend=gymnasium plays Pendulum-v1: it takes runs of env=pendulum with its default options")
    try:
        import gymnasium
    except ImportError:
        raise UserError(f"backend=gymnasium needs Gymnasium: {pip_install('gymnasium')}") from None
    pendulums = gymnasium.make_vec("Pendulum-v1", num_envs=num_episodes, vectorization_mode="sync")
    actions = pendulums.single_action_space
    assert isinstance(actions, gymnasium.spaces.Box)
    limit = actions.high
    act = jax.jit(stored.act)
    obs, _ = pendulums.reset(seed=seed)
    returns = np.zeros(num_episodes)
    truncated = np.zeros(num_episodes, bool)
    while not truncated.all():  # Pendulum-v1 never terminates: all episodes end together at its time limit
        obs, reward, _, truncated, _ = pendulums.step(limit * np.asarray(act(stored.policy, obs)))
        returns += reward
    pendulums.close()
    return Results(returns, np.zeros(num_episodes, bool), {})
