"""A linear-quadratic problem as an environment: the state is observed, and nothing ever terminates.

`envs.linear_quadratic` has the equations and closed forms of the problem. Actions have no limits.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Interface, State, initial_state
from envs.linear_quadratic import Problem, optimum
from envs.options import option


@dataclass(frozen=True)
class QuadraticConfig:
    """Options of the linear-quadratic problem; the defaults are the lesson's example, section 8.3.

    With several variables, each drives the one before it: A = I + 0.1 N, with N = 1 above the diagonal.
    """

    state_size: int = option(1, "variables of the state, each with its own action", at_least=1, at_most=100)
    start: float = option(0.5, "initial mean of every variable")
    start_spread: float = option(0.0, "initial standard deviation of every variable", at_least=0)
    noise: float = option(0.0, "standard deviation of the noise on the state per step", at_least=0)
    action_cost: float = option(0.01, "weight of the squared action", above=0)
    episode_length: int = option(50, "steps until the time limit", at_least=1)


_POLICY = {
    "network": "linear",
    "network.sigma_is": "fixed",
    "network.squash": False,
    "algo.normalize_observations": False,
}
_QUADRATIC = {"network.features": "polynomial", "network.order": 2}  # the value function is of this form
TRAINING = {
    "td": {
        **_POLICY,
        **_QUADRATIC,
        "num_envs": 32,
        "total_steps": 400_000,
        "algo.actor_lr": 0.05,
        "algo.critic_lr": 0.05,
    },
    "reinforce": {
        **_POLICY,
        "network.features": "identity",
        "num_envs": 32,
        "total_steps": 800_000,
        "algo.baseline": "leave_one_out",
        "algo.actor_lr": 0.1,
        "algo.final_lr": 0.01,
    },
    "online": {
        **_POLICY,
        **_QUADRATIC,
        "num_envs": 1,
        "num_steps": 50,
        "total_steps": 200_000,
        "algo.actor_lr": 0.02,
        "algo.critic_lr": 0.02,
    },
}


def chain(config: QuadraticConfig, discount: float = 0.99) -> Problem:
    """The problem with these options; by default the lesson's."""
    eye = np.eye(config.state_size)
    return Problem(
        A=eye + 0.1 * np.eye(config.state_size, k=1),
        B=0.1 * eye,
        Q=eye,
        R=config.action_cost * eye,
        W=config.noise**2 * eye,
        initial_mean=config.start * np.ones(config.state_size),
        initial_covariance=config.start_spread**2 * eye,
        horizon=config.episode_length,
        discount=discount,
    )


class LinearQuadratic:
    """A `Problem` as an environment with brax's interface; the caller limits episodes to its horizon.

    Args:
      problem: the problem. With noise, the state carries a random key for it.
    """

    def __init__(self, problem: Problem):
        self.problem = problem
        self.observation_size, self.action_size = problem.B.shape
        self._spread = _root(problem.initial_covariance)
        self._noise = _root(problem.W)

    @property
    def interface(self) -> Interface:
        states, actions = (
            tuple(f"{name}_{i}" for i in range(n))
            for name, n in (("s", self.observation_size), ("a", self.action_size))
        )
        return Interface(states, actions, limits=None)

    @property
    def references(self) -> dict[str, float]:
        """The largest possible mean return of an episode, undiscounted."""
        return {"best possible": optimum(dataclasses.replace(self.problem, discount=1.0))}

    def reset(self, rng: jax.Array) -> State:
        """s_0 ~ N(m_0, S_0)."""
        key_start, key_noise = jax.random.split(rng)
        s = jnp.asarray(self.problem.initial_mean, float)
        if self._spread.any():
            s = s + self._spread @ jax.random.normal(key_start, s.shape, s.dtype)
        return initial_state(jax.random.key_data(key_noise) if self._noise.any() else None, s)

    def step(self, state: State, action: jax.Array) -> State:
        """s' = A s + B a + w,  r = -(s'^T Q s' + a^T R a)."""
        problem, carried = self.problem, state.pipeline_state
        following = problem.A @ state.obs + problem.B @ action
        if self._noise.any():
            key, key_noise = jax.random.split(jax.random.wrap_key_data(carried))
            carried = jax.random.key_data(key)
            following = following + self._noise @ jax.random.normal(key_noise, following.shape, following.dtype)
        cost = following @ problem.Q @ following + action @ problem.R @ action
        return state.replace(pipeline_state=carried, obs=following, reward=-cost)


def _root(covariance: np.ndarray) -> np.ndarray:
    """The symmetric square root of a covariance, which may be singular."""
    squares, axes = np.linalg.eigh(covariance)
    return axes * np.sqrt(np.maximum(squares, 0)) @ axes.T


def make(config: QuadraticConfig) -> LinearQuadratic:
    """The environment with these options."""
    return LinearQuadratic(chain(config))
