"""Small brax-shaped environments whose right answers are known."""

import jax
import jax.numpy as jnp

from envs.base import State


class Counter:
    """Observes (start, steps since the reset), with start ~ U(0, 1); reward 1; terminates after `life` steps."""

    action_size = 1
    observation_size = 2

    def __init__(self, life=1_000_000):
        self.life = life

    def reset(self, key):
        obs = jnp.stack([jax.random.uniform(key), jnp.zeros(())])
        return State(None, obs, jnp.zeros(()), jnp.zeros(()))

    def step(self, state, action):
        obs = state.obs + jnp.array([0.0, 1.0])
        return state.replace(obs=obs, reward=jnp.ones(()), done=(obs[1] >= self.life).astype(jnp.float32))


class Constant:
    """One state, reward 1 for ever: V = 1 / (1 - gamma) however often a time limit cuts the episode."""

    action_size = 1
    observation_size = 1

    def reset(self, key):
        return State(None, jnp.ones(1), jnp.zeros(()), jnp.zeros(()))

    def step(self, state, action):
        return state.replace(reward=jnp.ones(()))


class Target:
    """One step, then terminal: reward -(action - 0.5)^2, so the best action is 0.5."""

    action_size = 1
    observation_size = 1

    def reset(self, key):
        return State(None, jnp.ones(1), jnp.zeros(()), jnp.zeros(()))

    def step(self, state, action):
        return state.replace(reward=-((action[0] - 0.5) ** 2), done=jnp.ones(()))
