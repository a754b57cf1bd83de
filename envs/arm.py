"""Reach a goal with a planar two-link arm.

Each episode draws a goal x_goal uniformly over a ring around the shoulder. With the end effector x_ee(q), the joint
torques tau_t and d_t = |x_ee(q_t) - x_goal|, the reward of the state and action before the step is

    lesson:   r_t = -lambda_pos d_t^2                        - lambda_torque |tau_t|^2     (the lesson's section 5.2)
    precise:  r_t = -lambda_pos (d_t^2 + PULL d_t)           - lambda_torque |tau_t|^2

The square is flat near the goal (at 2 cm its slope is 0.04 per metre). The distance added by `precise`, the default,
has the same slope everywhere, down to the last centimetre. Never terminates; the time limit is a truncation. `success`
is reported at every step; that of the last step counts for the episode.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct

from envs.base import ASSETS, Interface, MjxEnv, State, initial_state
from envs.options import OptionError, option
from envs.physics import PHYSICS, load_spec
from envs.scenes import Scene

PULL = 1.0  # weight of the distance relative to its square in the precise reward [m]
STANDARD_GRAVITY = 9.81  # [m/s^2]


@dataclass(frozen=True)
class ArmConfig:
    """Options of the arm."""

    reward: str = option(
        "precise", "squared distance, or one that also pulls over the last centimetres", choices=("lesson", "precise")
    )
    control: str = option("torque", "what an action commands", choices=("torque", "velocity"))
    gravity: bool = option(False, "the arm moves in the upright plane, under gravity")
    lambda_pos: float = option(1.0, "weight of the position error in the reward [1/m^2]", at_least=0)
    lambda_torque: float = option(0.001, "weight of the torque in the reward [1/(N m)^2]", at_least=0)
    torque_limit: float = option(2.0, "largest torque of either joint [N m]", above=0)
    velocity_limit: float = option(4.0, "largest commanded speed, control=velocity [rad/s]", above=0)
    velocity_gain: float = option(1.0, "torque per speed error, control=velocity [N m s/rad]", above=0)
    damping: float = option(0.1, "damping of either joint [N m s/rad]", at_least=0)
    upper_length: float = option(0.5, "length of the first link [m]", above=0)
    fore_length: float = option(0.5, "length of the second link [m]", above=0)
    upper_mass: float = option(0.25, "mass of the first link [kg]", above=0)
    fore_mass: float = option(0.15, "mass of the second link [kg]", above=0)
    goal_min: float = option(0.2, "inner radius of the ring of goals [m]", at_least=0)
    goal_max: float = option(0.95, "outer radius of the ring of goals [m]", above=0)
    success_radius: float = option(0.05, "distance that counts as reached [m]", above=0)
    dt: float = option(0.05, "time between two actions [s]", above=0, at_most=1)
    num_substeps: int = option(5, "physics steps between two actions", at_least=1)
    physics: str = option("scalar", "MuJoCo's step as scalar equations, MJX, or C MuJoCo", choices=tuple(PHYSICS))
    episode_length: int = option(100, "steps until the time limit", at_least=1)

    def __post_init__(self):
        low, high = abs(self.upper_length - self.fore_length), self.upper_length + self.fore_length
        if not low <= self.goal_min < self.goal_max <= high:
            raise OptionError(
                [
                    f"env.goal_min={self.goal_min:g} env.goal_max={self.goal_max:g}: goals must lie in the reachable "
                    f"ring, {low:g} <= goal_min < goal_max <= {high:g} for these link lengths"
                ]
            )


TRAINING = {
    "ppo": {
        "num_envs": 128,
        "num_steps": 50,
        "total_steps": 6_000_000,
        "log_interval": 100_000,
        "eval_interval": 500_000,
        "algo.epochs": 4,
        "algo.num_shards": 2,
        "algo.minibatches": 8,
        "algo.actor_lr": 0.004,
        "algo.critic_lr": 0.008,
        "algo.final_lr": 0.02,
        "algo.gamma": 0.9,
        "algo.lambda_": 0.85,
        "algo.reward_scale": 10.0,
        "algo.normalize_advantages": False,  # they shrink with the distance, and so do the steps
        "network.widths": [32, 32],
        "network.activation": "elu",
    },
    "td": {
        "num_envs": 64,
        "num_steps": 16,
        "total_steps": 18_000_000,
        "log_interval": 100_000,
        "eval_interval": 500_000,
        "algo.gamma": 0.9,
        "algo.final_lr": 0.01,
        "algo.reward_scale": 5.0,
        "algo.normalize_advantages": False,
    },
    "reinforce": {
        "num_envs": 16,
        "total_steps": 8_000_000,
        "log_interval": 100_000,
        "eval_interval": 500_000,
        "algo.gamma": 0.9,
    },
}


@struct.dataclass
class ArmState:
    """qpos `[2]`: joint angles [rad]; qvel `[2]`: joint velocities [rad/s]; goal `[2]`: its position [m]."""

    qpos: jax.Array
    qvel: jax.Array
    goal: jax.Array


class Arm(MjxEnv):
    """The arm as an environment; see the module's docstring for its equations."""

    def __init__(self, config: ArmConfig = ArmConfig()):
        self.config = config
        self.lengths = (config.upper_length, config.fore_length)
        super().__init__(_make_spec(config), config.num_substeps, config.physics, check=False)

    @property
    def interface(self) -> Interface:
        config, joints = self.config, ("shoulder", "elbow")
        kind, unit = ("torque", "N m") if config.control == "torque" else ("velocity", "rad/s")
        limit = config.torque_limit if config.control == "torque" else config.velocity_limit
        angles = [f"{function}(q_{joint})" for function in ("cos", "sin") for joint in joints]
        speeds = [f"q_{joint}' [rad/s]" for joint in joints]
        places = [f"{name}_{axis} [m]" for name in ("goal", "error") for axis in "xy"]
        return Interface(
            (*angles, *speeds, *places), tuple(f"{joint} {kind} [{unit}]" for joint in joints), (limit, limit)
        )

    @property
    def scene(self) -> Scene:
        return super().scene._replace(
            goal=lambda state: jnp.append(state.pipeline_state.goal, 0.0), goal_radius=self.config.success_radius
        )

    def reset(self, rng: jax.Array) -> State:
        """q ~ U(-pi, pi)^2 at rest, goal uniform over the ring's area."""
        key_angles, key_goal = jax.random.split(rng)
        qpos = jax.random.uniform(key_angles, (2,), minval=-jnp.pi, maxval=jnp.pi)
        goal = sample_ring(key_goal, self.config.goal_min, self.config.goal_max)
        state = ArmState(qpos, jnp.zeros_like(qpos), goal)
        return initial_state(state, observe(state, self.lengths), metric_names=("distance", "success"))

    def step(self, state: State, action: jax.Array) -> State:
        """One step of `dt` under the commanded torques or velocities, the action clipped to [-1, 1]."""
        before = state.pipeline_state
        ctrl, torque = self._command(before, jnp.clip(action, -1.0, 1.0))
        qpos, qvel = self.physics_step(before.qpos, before.qvel, ctrl)
        after = ArmState(qpos, qvel, before.goal)
        distance = goal_distance(after, self.lengths)
        success = (distance < self.config.success_radius).astype(distance.dtype)
        return state.replace(
            pipeline_state=after,
            obs=observe(after, self.lengths),
            reward=reward(goal_distance(before, self.lengths), torque, self.config),
            metrics={"distance": distance, "success": success},
        )

    def _command(self, state: ArmState, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The actuators' control, and the torque that it requests in this state."""
        config = self.config
        if config.control == "torque":
            torque = config.torque_limit * action
            return torque, torque
        velocity = config.velocity_limit * action
        torque = config.velocity_gain * (velocity - state.qvel)
        return velocity, jnp.clip(torque, -config.torque_limit, config.torque_limit)


def end_effector(qpos: jax.Array, lengths: tuple[float, float]) -> jax.Array:
    """Forward kinematics x_ee = l1 (cos q1, sin q1) + l2 (cos(q1 + q2), sin(q1 + q2)), `[2]` in metres."""
    upper, fore = lengths
    shoulder, wrist = qpos[0], qpos[0] + qpos[1]
    return jnp.stack(
        [
            upper * jnp.cos(shoulder) + fore * jnp.cos(wrist),
            upper * jnp.sin(shoulder) + fore * jnp.sin(wrist),
        ]
    )


def goal_distance(state: ArmState, lengths: tuple[float, float]) -> jax.Array:
    """d = |x_ee(q) - x_goal| in metres; its gradient is 0, not NaN, at the goal itself."""
    error = end_effector(state.qpos, lengths) - state.goal
    squared = jnp.sum(error**2)
    at_goal = squared == 0.0
    return jnp.where(at_goal, 0.0, jnp.sqrt(jnp.where(at_goal, 1.0, squared)))


def observe(state: ArmState, lengths: tuple[float, float]) -> jax.Array:
    """(cos q, sin q, q', x_goal, x_goal - x_ee), `[10]`."""
    error = state.goal - end_effector(state.qpos, lengths)
    return jnp.concatenate([jnp.cos(state.qpos), jnp.sin(state.qpos), state.qvel, state.goal, error])


def reward(distance: jax.Array, torque: jax.Array, config: ArmConfig) -> jax.Array:
    """The lesson's or the precise reward of a distance [m] and the joint torques `[2]` [N m]; see the module."""
    cost = distance**2 if config.reward == "lesson" else distance**2 + PULL * distance
    return -config.lambda_pos * cost - config.lambda_torque * jnp.sum(torque**2)


def sample_ring(key: jax.Array, inner: float, outer: float) -> jax.Array:
    """A point uniform over the area of a ring: radius sqrt(U(inner^2, outer^2)), any angle; `[2]` in metres."""
    key_radius, key_angle = jax.random.split(key)
    radius = jnp.sqrt(jax.random.uniform(key_radius, minval=inner**2, maxval=outer**2))
    angle = jax.random.uniform(key_angle, minval=-jnp.pi, maxval=jnp.pi)
    return radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def _make_spec(config: ArmConfig):
    """The MJCF with the options written into it: lengths, inertias, gravity, actuators."""
    spec = load_spec(ASSETS / "arm.xml")
    spec.option.timestep = config.dt / config.num_substeps
    spec.option.gravity = [0.0, -STANDARD_GRAVITY if config.gravity else 0.0, 0.0]
    links = (("upper", config.upper_mass, config.upper_length), ("fore", config.fore_mass, config.fore_length))
    for name, mass, length in links:
        body, across = spec.body(name), mass * length**2 / 12
        body.mass, body.ipos, body.inertia = mass, [length / 2, 0.0, 0.0], [1e-3 * across, across, across]
        spec.geom(name).fromto = [0.0, 0.0, 0.0, length, 0.0, 0.0]
    spec.body("fore").pos = [config.upper_length, 0.0, 0.0]
    spec.site("end_effector").pos = [config.fore_length, 0.0, 0.0]
    spec.camera("top").pos = [0.0, 0.0, 3 * (config.upper_length + config.fore_length)]
    for name in ("shoulder", "elbow"):
        spec.joint(name).damping[0] = config.damping  # a polynomial in the speed: its linear coefficient
        actuator = spec.actuator(name)
        actuator.ctrlrange = [-config.torque_limit, config.torque_limit]
        if config.control == "velocity":
            actuator.set_to_velocity(kv=config.velocity_gain)
            actuator.ctrlrange = [-config.velocity_limit, config.velocity_limit]
            actuator.forcerange = [-config.torque_limit, config.torque_limit]
    return spec
