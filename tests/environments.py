"""A small environment of somebody's own, which tests change one thing of, and how it is registered for a test."""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

import envs
from envs.base import initial_state
from envs.options import option

SIZES = ("num_envs=2", "num_steps=4", "total_steps=32", "log_interval=16", "eval_interval=16", "eval_episodes=2")
SIZES += ("network.widths=[4]", "env.episode_length=4", "report=false")


@dataclasses.dataclass(frozen=True)
class Config:
    """Options of the point."""

    speed: float = option(0.1, "of the point at action 1", above=0)
    episode_length: int = option(8, "steps until the time limit", at_least=1)


@struct.dataclass
class Position:
    x: jax.Array
    steps: jax.Array


class Point:
    """A point that is pushed: x' = x + speed a; it observes (x, x^2), and earns -x'^2."""

    observation_size, action_size = 2, 1
    metric_names = ("distance",)

    def __init__(self, config=None):
        self.config = config or Config()

    def observe(self, x):
        return jnp.stack([x, x**2])

    def reward(self, x):
        return -(x**2)

    def done(self, x):
        return (jnp.abs(x) > 2).astype(float)

    def metrics(self, x):
        return {"distance": jnp.abs(x)}

    def reset(self, rng):
        x = jax.random.uniform(rng, minval=-1.0, maxval=1.0)
        return initial_state(Position(x, jnp.zeros((), jnp.int32)), self.observe(x), self.metric_names)

    def step(self, state, action):
        position = state.pipeline_state
        x = position.x + self.config.speed * jnp.clip(action[0], -1, 1)
        return state.replace(
            pipeline_state=Position(x, position.steps + 1),
            obs=self.observe(x),
            reward=self.reward(x),
            done=self.done(x),
            metrics=self.metrics(x),
        )


def register(monkeypatch, name, build=Point, config=Config, training=None):
    """Registers an environment for the time of a test."""
    monkeypatch.setattr(envs, "REGISTRY", dict(envs.REGISTRY))
    envs.register(name, envs.Entry(config, build, {} if training is None else training))
