"""Swing up a torque-limited pendulum: Gymnasium's Pendulum-v1 as a MuJoCo model.

A uniform rod of mass m and length l turns about one end; theta = 0 is upright (m l^2 / 3 about the pivot):

    theta'' = 3 g / (2 l) sin(theta) + 3 / (m l^2) tau,      |tau| <= torque_limit
    r_t     = -(wrap(theta)^2 + 0.1 theta'^2 + 0.001 tau^2),  of the state and torque before the step

Integrated by the semi-implicit Euler rule, with the speed clipped before the position is advanced. Never terminates;
the time limit of 200 steps is a truncation. Best possible mean return about -137.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct

from envs.base import ASSETS, Interface, MjxEnv, State, initial_state
from envs.options import option
from envs.physics import PHYSICS, load_spec
from envs.scenes import PhasePlane


@dataclass(frozen=True)
class PendulumConfig:
    """Options of the pendulum; the defaults are Gymnasium's."""

    mass: float = option(1.0, "mass of the rod [kg]", above=0)
    length: float = option(1.0, "length of the rod [m]", above=0)
    gravity: float = option(10.0, "gravitational acceleration [m/s^2]", at_least=0)
    torque_limit: float = option(2.0, "largest torque, reached at |action| = 1 [N m]", above=0)
    speed_limit: float = option(8.0, "angular speed is clipped to this [rad/s]", above=0)
    dt: float = option(0.05, "time between two actions, one physics step [s]", above=0, at_most=1)
    physics: str = option("scalar", "MuJoCo's step as scalar equations, MJX, or C MuJoCo", choices=tuple(PHYSICS))
    episode_length: int = option(200, "steps until the time limit", at_least=1)


TRAINING = {
    "ppo": {
        "num_envs": 512,
        "num_steps": 30,
        "total_steps": 490_000,
        "log_interval": 50_000,
        "eval_interval": 50_000,
        "algo.num_shards": 2,
        "algo.minibatches": 8,
        "algo.actor_lr": 0.005,
        "algo.critic_lr": 0.01,
        "algo.final_lr": 0.01,
        "algo.gamma": 0.995,
        "algo.lambda_": 0.9,
        "algo.reward_scale": 0.2,
        "algo.episode_length": 100,  # covers the swing-up and little of the balancing after it
        # With the squares, the energy is linear in the observation, and the energy decides whether a swing suffices.
        "network.features": "polynomial",
        "network.order": 2,
        "network.widths": [32, 32],
        "network.sigma": 1.3,
        "network.squash": False,  # the best torque is mostly the limit itself, which tanh never reaches
    },
    "td": {
        "num_envs": 32,
        "num_steps": 16,
        "total_steps": 5_000_000,
        "algo.gamma": 0.97,
        "algo.lambda_": 0.95,
        "algo.final_lr": 0.02,
        "algo.reward_scale": 0.02,
        "network.activation": "relu",
        "network.sigma": 1.0,
        "network.sigma_is": "fixed",  # if it is learned, some seeds are never solved
    },
    "reinforce": {
        "num_envs": 16,
        "total_steps": 3_000_000,
        "algo.actor_lr": 0.002,
        "algo.critic_lr": 0.005,
        "algo.gamma": 0.977,
        "algo.max_gradient_norm": 10.0,
        "algo.reward_scale": 0.04,
        "network.activation": "relu",
        "network.sigma": 1.0,
    },
    "online": {
        "num_envs": 16,
        "num_steps": 100,
        "total_steps": 2_000_000,
        "algo.reward_scale": 0.1,
        "algo.actor_lr": 0.002,
        "algo.critic_lr": 0.01,
        "network": "linear",
        "network.features": "fourier",
        "network.order": 3,
        "network.sigma": 0.5,
        "network.sigma_is": "fixed",
    },
}


BEST_RETURN = -137.4  # standard error 1.2: dynamic programming on a grid of 721 x 401 states, 4,096 starts


@struct.dataclass
class PendulumState:
    """qpos `[1]`: angle from upright [rad]; qvel `[1]`: angular velocity [rad/s]."""

    qpos: jax.Array
    qvel: jax.Array


class Pendulum(MjxEnv):
    """The pendulum as an environment; see the module's docstring for its equations."""

    def __init__(self, config: PendulumConfig = PendulumConfig()):
        self.config = config
        super().__init__(_make_spec(config), physics=config.physics, check=False)

    @property
    def interface(self) -> Interface:
        return Interface(("cos(theta)", "sin(theta)", "theta' [rad/s]"), ("torque [N m]",), (self.config.torque_limit,))

    @property
    def references(self) -> dict[str, float]:
        """The mean return of the best possible policy, known only for Gymnasium's constants."""
        is_gymnasium = dataclasses.replace(self.config, physics="scalar") == PendulumConfig()
        return {"best possible": BEST_RETURN} if is_gymnasium else {}

    @property
    def phase_plane(self) -> PhasePlane:
        limit = self.config.speed_limit
        return PhasePlane(
            labels=("theta [rad]", "theta' [rad/s]"),
            ranges=((-jnp.pi, jnp.pi), (-limit, limit)),
            wraps=(True, False),
            coordinates=lambda state: jnp.concatenate([state.pipeline_state.qpos, state.pipeline_state.qvel]),
            observe=observe,
        )

    def reset(self, rng: jax.Array) -> State:
        """theta ~ U(-pi, pi), theta' ~ U(-1, 1)."""
        key_angle, key_speed = jax.random.split(rng)
        qpos = jax.random.uniform(key_angle, (1,), minval=-jnp.pi, maxval=jnp.pi)
        qvel = jax.random.uniform(key_speed, (1,), minval=-1.0, maxval=1.0)
        return initial_state(PendulumState(qpos, qvel), observe(qpos[0], qvel[0]))

    def step(self, state: State, action: jax.Array) -> State:
        """One step of `dt` under the torque `torque_limit * action`, the action clipped to [-1, 1]."""
        config, before = self.config, state.pipeline_state
        torque = config.torque_limit * jnp.clip(action, -1.0, 1.0)
        _, qvel = self.physics_step(before.qpos, before.qvel, torque)
        # MuJoCo has no limit on the speed of a joint: clip, then repeat the rule's last line, q' = q + dt v'.
        qvel = jnp.clip(qvel, -config.speed_limit, config.speed_limit)
        qpos = before.qpos + config.dt * qvel
        return state.replace(
            pipeline_state=PendulumState(qpos, qvel),
            obs=observe(qpos[0], qvel[0]),
            reward=reward(before.qpos[0], before.qvel[0], torque[0]),
        )


def observe(theta: jax.Array, theta_dot: jax.Array) -> jax.Array:
    """(cos theta, sin theta, theta'), `[3]`."""
    return jnp.stack([jnp.cos(theta), jnp.sin(theta), theta_dot])


def reward(theta: jax.Array, theta_dot: jax.Array, torque: jax.Array) -> jax.Array:
    """-(wrap(theta)^2 + 0.1 theta'^2 + 0.001 tau^2), with the angle wrapped to [-pi, pi)."""
    wrapped = jnp.mod(theta + jnp.pi, 2 * jnp.pi) - jnp.pi
    return -(wrapped**2 + 0.1 * theta_dot**2 + 0.001 * torque**2)


def _make_spec(config: PendulumConfig):
    """The MJCF with the options applied: the inertia follows mass and length, the geometry the length."""
    spec = load_spec(ASSETS / "pendulum.xml")
    spec.option.timestep = config.dt
    spec.option.gravity = [0.0, 0.0, -config.gravity]
    rod = spec.body("rod")
    rod.mass = config.mass
    rod.ipos = [0.0, 0.0, config.length / 2]
    across = config.mass * config.length**2 / 12
    rod.inertia = [across, across, 1e-4 * across]
    spec.geom("rod").fromto = [0.0, 0.0, 0.0, 0.0, 0.0, config.length]
    spec.site("tip").pos = [0.0, 0.0, config.length]
    spec.camera("side").pos = [0.0, -3 * config.length, 0.0]
    spec.actuator("torque").ctrlrange = [-config.torque_limit, config.torque_limit]
    return spec
