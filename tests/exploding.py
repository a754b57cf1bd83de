"""Environments whose physics explodes, and a program with the project's commands for them."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

import envs
from envs.base import initial_state
from envs.options import option
from jaxpg.__main__ import main, run_command


@dataclass(frozen=True)
class ExplodingConfig:
    episode_length: int = option(30, "steps until the time limit", at_least=1)
    share: float = option(0.1, "share of the joints that are unstable", at_least=0, at_most=1)
    growth: float = option(10.0, "factor of an unstable joint's error in a step", above=1)
    unit: float = option(1.0, "of the observation", above=0)


class Joint(NamedTuple):
    angle: jax.Array
    unstable: jax.Array


class Servo:
    """A joint that a servo moves by a fifth of the way to its command; one that is unstable runs away from it.

    The reward is that of an angle near 0.5.
    """

    observation_size, action_size, dt = 1, 1, 0.1

    def __init__(self, config=ExplodingConfig()):
        self.config = config

    def reset(self, rng):
        key_angle, key_kind = jax.random.split(rng)
        angle = 0.3 * jax.random.normal(key_angle)
        unstable = (jax.random.uniform(key_kind) < self.config.share).astype(angle.dtype)
        return initial_state(Joint(angle, unstable), self.observe(angle))

    def observe(self, angle):
        return self.config.unit * angle[None]

    def reward(self, angle):
        return -((angle - 0.5) ** 2)

    def step(self, state, action):
        angle, unstable = state.pipeline_state
        error = angle - jnp.clip(action[0], -1, 1)
        angle = jnp.where(unstable > 0, angle + self.config.growth * (error + 1.0), angle - 0.2 * error)
        return state.replace(
            pipeline_state=Joint(angle, unstable),
            obs=self.observe(angle),
            reward=self.reward(angle),
            done=jnp.zeros(()),
        )


class Blind(Servo):
    """The same, seen by its sine and paid within bounds: only the state tells that it explodes."""

    def observe(self, angle):
        return jnp.sin(angle)[None]

    def reward(self, angle):
        return jnp.sin(angle)


class Falls(Servo):
    """Falls by 0.4 a step, from 1; below the ground the formulas are not defined: the reward is NaN there.

    The metric `success` is 0 / 0 in every step but the first.
    """

    def reset(self, rng):
        height = 1.0 + 0.1 * jax.random.uniform(rng)
        return initial_state(Joint(height, 0 * height), self.observe(height), ("success",))

    def step(self, state, action):
        height = state.pipeline_state.angle - 0.4
        reward = jnp.log(height + 0.4) - (action[0] - 0.3) ** 2
        first = state.pipeline_state.angle >= 1.0
        success = jnp.where(first, 1.0, jnp.nan)
        return state.replace(
            pipeline_state=Joint(height, 0 * height),
            obs=jnp.sqrt(height + 0.4)[None],
            reward=reward,
            done=(height <= 0).astype(height.dtype),
            metrics={"success": success},
        )


SIZES = {"num_envs": 8, "num_steps": 8, "total_steps": 640, "log_interval": 128, "eval_interval": 128}
SIZES |= {"eval_episodes": 8}
for name, kind in {"exploding-servo": Servo, "exploding-blind": Blind, "falls": Falls}.items():
    envs.register(name, envs.Entry(ExplodingConfig, kind, {"td": SIZES}))

if __name__ == "__main__":
    run_command(main)
