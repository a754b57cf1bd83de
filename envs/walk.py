"""Walk as commanded: a robot on legs follows a velocity of its base.

The command (v_x*, v_y*, w*) is a velocity of the base over the ground, forwards and to the left, and its rate of
turning about its own z axis. It is uniform within its ranges, and 0 in a share `stand` of the cases. An action sets the
legs' servos, q* = q_stand + scale a. With the rotation R and velocity x' of the base and its angular velocity w in its
own frame, v = R^T x', g = R^T (0, 0, -1), the reward of a step is, in the state after it,

    r = exp(-|v_xy - v_xy*|^2 / sigma) + lambda_turn exp(-(w_z - w*)^2 / sigma_turn) - P
    P = lambda_bounce v_z^2 + lambda_sway (w_x^2 + w_y^2) + lambda_tilt |g - g_stand|^2 + lambda_torque |tau|^2
        + lambda_rate |a - a_before|^2 + lambda_pose |q - q_stand|^2 + lambda_limit sum_i e_i^2
        + lambda_slip sum_k |f_k|^2 max(0, 1 - h_k / clearance)^2
        + lambda_air sum_k (max(0, air_time - T_k) [k lands] + min(max(0, T_k - air_time), air_time) [k is in the air])
        + lambda_fall [fallen]

where tau are the torques of the actuators, e_i is how far joint i is within `limit_margin` of the ends of its range,
f_k is the horizontal velocity of foot k and h_k its height over the ground, and T_k for how long it has been in the
air. So steps take about `air_time`, and a robot that stands has all feet on the ground. An episode ends with a fall:
the base is lower than `fall_height` times its height when it stands, or tilted by more than `fall_angle`. The time
limit is a truncation.

`success` is 1 in the last step of an episode if the robot has not fallen and the mean of |v_xy - v_xy*| over the last
2 s is below `success_speed`.

Source: rewards of this kind are those of Rudin et al., "Learning to walk in minutes using massively parallel deep
reinforcement learning" (CoRL 2021).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs.base import Interface, State, initial_state
from envs.options import OptionError, option
from envs.physics import PHYSICS, compile_forward
from envs.robots.legs import CONTACTS, LegOptions, read_legs
from envs.robots.quaternions import find_down, rotate_back, turn_about_z
from envs.robots.sources import load_robot
from envs.robots.tasks import RobotEnv, divide_step, find_jerk

SHIPPED = ("quadruped",)
LANDED = 0.005  # a foot lower than this is on the ground [m]
LAST = 2.0  # the end of an episode that counts for success [s]
RANGES = ("forward", "left", "turn")


@dataclass(frozen=True)
class WalkConfig:
    """Options of the walking robot."""

    robot: str = option("quadruped", "quadruped, path/to/robot.xml, or menagerie:NAME")
    scale: float = option(0.5, "largest offset of a joint's set-point [rad or m]", above=0)
    stiffness: float | None = option(None, "of the servos [N m/rad] [default: the model's]", above=0)
    damping: float | None = option(None, "of the servos [N m s/rad] [default: the model's]", at_least=0)
    contacts: str = option("feet", "what touches the ground before the robot has fallen", choices=CONTACTS)
    forward: list[float] = option([-0.8, 0.8], "range of commanded velocities forwards [m/s]")
    left: list[float] = option([-0.4, 0.4], "range of commanded velocities to the left [m/s]")
    turn: list[float] = option([-1.0, 1.0], "range of commanded rates of turning [rad/s]")
    stand: float = option(0.1, "share of commands to stand still", at_least=0, at_most=1)
    commands: int = option(1, "commands in an episode, one after the other", at_least=1)
    start_spread: float = option(0.1, "of the joints around their stand at random starts [rad or m]", at_least=0)
    observe_velocity: bool = option(True, "observe the base's velocity, which a robot must estimate")
    sigma: float = option(0.25, "width of the reward for the velocity [m^2/s^2]", above=0)
    sigma_turn: float = option(0.25, "width of the reward for turning [rad^2/s^2]", above=0)
    lambda_turn: float = option(0.5, "weight of the reward for turning", at_least=0)
    lambda_bounce: float = option(0.5, "weight of the squared vertical velocity [s^2/m^2]", at_least=0)
    lambda_sway: float = option(0.02, "weight of the squared rates of roll and pitch [s^2/rad^2]", at_least=0)
    lambda_tilt: float = option(1.0, "weight of the squared sine of the tilt", at_least=0)
    lambda_torque: float = option(2e-4, "weight of the squared torques [1/(N m)^2]", at_least=0)
    lambda_rate: float = option(0.02, "weight of the squared change of the action", at_least=0)
    lambda_pose: float = option(0.1, "weight of the squared offsets of the joints [1/rad^2]", at_least=0)
    lambda_limit: float = option(1.0, "weight of the squared nearness to joint limits [1/rad^2]", at_least=0)
    limit_margin: float = option(0.05, "distance from a limit that counts as near [rad or m]", above=0)
    lambda_slip: float = option(0.05, "weight of the squared velocity of feet near the ground [s^2/m^2]", at_least=0)
    clearance: float = option(0.06, "height from which a foot may move freely [m]", above=0)
    lambda_air: float = option(1.0, "weight of the time by which a step is too short or too long [1/s]", at_least=0)
    air_time: float = option(0.2, "time that a step shall take [s]", at_least=0)
    lambda_fall: float = option(1.0, "penalty of a fall", at_least=0)
    fall_height: float = option(0.6, "share of the standing height that is a fall", at_least=0, below=1)
    fall_angle: float = option(0.7, "tilt that is a fall [rad]", above=0, at_most=3.1)
    success_speed: float = option(0.15, "error of the velocity that counts as followed [m/s]", above=0)
    dt: float = option(0.02, "time between two actions [s]", above=0, at_most=1)
    physics: str = option("scalar", "MuJoCo's step as scalar equations, MJX, or C MuJoCo", choices=tuple(PHYSICS))
    episode_length: int = option(250, "steps until the time limit", at_least=1)

    def __post_init__(self):
        wrong = [name for name in RANGES if not _is_range(getattr(self, name))]
        if wrong:
            raise OptionError(
                [f"env.{name}={getattr(self, name)}: expected the lowest and the highest, [low,high]" for name in wrong]
            )


def _is_range(ends: list[float]) -> bool:
    return len(ends) == 2 and ends[0] <= ends[1]


TRAINING = {
    "ppo": {
        "num_envs": 512,
        "num_steps": 32,
        "total_steps": 6_000_000,
        "log_interval": 250_000,
        "eval_interval": 1_000_000,
        "eval_episodes": 256,
        "algo.epochs": 4,
        "algo.num_shards": 2,
        "algo.minibatches": 8,
        "algo.actor_lr": 0.001,
        "algo.critic_lr": 0.001,
        "algo.final_lr": 0.1,
        "algo.gamma": 0.97,
        "algo.lambda_": 0.95,
        "algo.reward_scale": 0.3,
        "network.widths": [128, 64],
        "network.activation": "elu",
    }
}


@struct.dataclass
class Record:
    """What metrics and penalties remember of an episode.

    Attributes:
      steps: since the start.
      actions: the last action and the one before `[2, m]`; 0 before the start.
      feet: where the feet are `[F, 3]` [m].
      air: for how long each foot has been in the air `[F]` [s].
      errors: sums of |v_xy - v_xy*| [m/s] and |w_z - w*| [rad/s] over the second half of the episode, `[2]`.
      last: sum of |v_xy - v_xy*| over the last 2 s.
      height: sum of the base's height over the second half [m].
      torque: sum of the mean |tau| of the joints [N m].
      power: sum of sum_i |tau_i q_i'| [W].
      jerk: sum of the mean squared second difference of the actions.
    """

    steps: jax.Array
    actions: jax.Array
    feet: jax.Array
    air: jax.Array
    errors: jax.Array
    last: jax.Array
    height: jax.Array
    torque: jax.Array
    power: jax.Array
    jerk: jax.Array


@struct.dataclass
class WalkState:
    """The robot's motion, its commands, and the record of the episode.

    Attributes:
      qpos, qvel: positions `[nq]` and velocities `[nv]` of the model.
      qacc_warmstart: where the solver of constraints starts, `[nv]`.
      act: activations of actuators `[na]`; None without them.
      commands: (v_x*, v_y*, w*) `[K, 3]` [m/s, rad/s].
      record: for metrics.
    """

    qpos: jax.Array
    qvel: jax.Array
    qacc_warmstart: jax.Array
    act: jax.Array | None
    commands: jax.Array
    record: Record


class Motion(NamedTuple):
    """How the base moves, in its own frame.

    Attributes:
      velocity: v = R^T x' `[3]` [m/s].
      turning: angular velocity w `[3]` [rad/s].
      down: g = R^T (0, 0, -1) `[3]`.
    """

    velocity: jax.Array
    turning: jax.Array
    down: jax.Array


class Walk(RobotEnv):
    """A robot that walks as commanded; see the module's docstring for its equations."""

    def __init__(self, config: WalkConfig = WalkConfig()):
        self.config = config
        spec = load_robot(config.robot, SHIPPED)
        num_substeps = divide_step(spec, config.dt)
        self.robot = robot = read_legs(spec, LegOptions(config.stiffness, config.damping, config.contacts))
        super().__init__(spec, robot.model, num_substeps, config.physics)
        self.find_feet = compile_forward(robot.model, outputs=tuple(f"site_xpos[{site}]" for site in robot.feet))
        self.qpos_of, self.dof_of = robot.qpos_of, robot.dof_of
        self.angles, base = robot.qpos[self.qpos_of], robot.base_qpos
        self.stand_down = np.asarray(find_down(jnp.asarray(robot.qpos[base + 3 : base + 7])))
        self.low, self.high = _find_set_point_ranges(robot.joints)
        self.half, self.last = config.episode_length // 2, min(round(LAST / config.dt), config.episode_length)

    @property
    def action_size(self) -> int:
        return len(self.robot.joints)

    @property
    def interface(self) -> Interface:
        names = tuple(f"{joint.name} set-point - stand [{joint.unit}]" for joint in self.robot.joints)
        return Interface(self._name_observations(), names, (self.config.scale,) * self.action_size)

    def reset(self, rng: jax.Array) -> State:
        """Standing at the origin, turned anywhere, q ~ q_stand + U(-start_spread, start_spread)^n, without velocity."""
        key_pose, key_commands = jax.random.split(rng)
        model, (qpos, feet) = self.robot.model, self._draw_pose(key_pose)
        state = WalkState(
            qpos=qpos,
            qvel=jnp.zeros(model.nv),
            qacc_warmstart=jnp.zeros(model.nv),
            act=jnp.asarray(self.robot.act, float) if model.na else None,
            commands=self._draw_commands(key_commands),
            record=start_record(feet, self.action_size),
        )
        return initial_state(state, self.observe(state), tuple(self._find_metrics(state, jnp.zeros((), bool))))

    def step(self, state: State, action: jax.Array) -> State:
        """One step of `dt` with the set-points of the action, clipped to [-1, 1]."""
        before, action = state.pipeline_state, jnp.clip(action, -1.0, 1.0)
        set_points = jnp.clip(self.robot.set_points + self.config.scale * action, self.low, self.high)
        after, force = self.advance(before, self.robot.find_controls(set_points))
        torque, fallen = force[self.dof_of], self.has_fallen(after)
        after = after.replace(record=self._update_record(before, after, action, torque))
        return state.replace(
            pipeline_state=after,
            obs=self.observe(after),
            reward=self._find_reward(before, after, torque, fallen),
            done=fallen.astype(state.done.dtype),
            metrics=self._find_metrics(after, fallen),
        )

    def find_motion(self, state: WalkState) -> Motion:
        """How the base moves, in its own frame. In MuJoCo its velocity is of the world, its angular velocity is not."""
        base, dof = self.robot.base_qpos, self.robot.base_dof
        quaternion = state.qpos[base + 3 : base + 7]
        velocity = rotate_back(quaternion, state.qvel[dof : dof + 3])
        return Motion(velocity, state.qvel[dof + 3 : dof + 6], find_down(quaternion))

    def find_command(self, state: WalkState) -> jax.Array:
        """The present command (v_x*, v_y*, w*); that of the last part from the time limit on."""
        config = self.config
        part = jnp.minimum(state.record.steps * config.commands // config.episode_length, config.commands - 1)
        return state.commands[part.astype(int)]

    def has_fallen(self, state: WalkState) -> jax.Array:
        """Whether the base is too low or tilted too much."""
        robot, base = self.robot, self.robot.base_qpos
        is_low = state.qpos[base + 2] - robot.floor < self.config.fall_height * robot.height
        cosine = jnp.dot(find_down(state.qpos[base + 3 : base + 7]), self.stand_down)
        return is_low | (cosine < math.cos(self.config.fall_angle))

    def observe(self, state: WalkState) -> jax.Array:
        """What the policy sees, `[observation_size]`: (v, w, g, q - q_stand, q', a_before, v_x*, v_y*, w*)."""
        motion = self.find_motion(state)
        parts = [motion.velocity] if self.config.observe_velocity else []
        parts += [motion.turning, motion.down, state.qpos[self.qpos_of] - self.angles, state.qvel[self.dof_of]]
        return jnp.concatenate([*parts, state.record.actions[0], self.find_command(state)])

    def _name_observations(self) -> tuple[str, ...]:
        """The names in the order of `observe`."""
        joints = self.robot.joints
        names = [f"velocity {axis} [m/s]" for axis in "xyz"] if self.config.observe_velocity else []
        names += [f"angular velocity {axis} [rad/s]" for axis in "xyz"]
        names += [f"direction of gravity {axis}" for axis in "xyz"]
        names += [f"{joint.name} - stand [{joint.unit}]" for joint in joints]
        names += [f"{joint.name}' [{joint.unit}/s]" for joint in joints]
        names += [f"last set-point of {joint.name} / limit" for joint in joints]
        return (*names, "commanded velocity x [m/s]", "commanded velocity y [m/s]", "commanded turning [rad/s]")

    def _locate_feet(self, qpos: jax.Array) -> jax.Array:
        """Where the feet are `[F, 3]` [m]."""
        return jnp.stack(self.find_feet(qpos))

    def _draw_pose(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """(qpos `[nq]`, places of the feet `[F, 3]`), with the lowest foot on the ground."""
        key_joints, key_turn = jax.random.split(key)
        robot, spread, base = self.robot, self.config.start_spread, self.robot.base_qpos
        shift = jax.random.uniform(key_joints, (self.action_size,), minval=-spread, maxval=spread)
        turn = jax.random.uniform(key_turn, minval=-jnp.pi, maxval=jnp.pi)
        qpos = jnp.asarray(robot.qpos, float).at[self.qpos_of].set(jnp.clip(self.angles + shift, *robot.ranges))
        qpos = qpos.at[base + 3 : base + 7].set(turn_about_z(turn, qpos[base + 3 : base + 7]))
        feet = self._locate_feet(qpos)
        height = jnp.min(self._find_heights(feet))
        return qpos.at[base + 2].add(-height), feet.at[:, 2].add(-height)

    def _find_heights(self, feet: jax.Array) -> jax.Array:
        """Heights of feet at `[F, 3]` over the ground `[F]` [m]."""
        return feet[:, 2] - self.robot.floor - self.robot.foot_heights

    def _draw_commands(self, key: jax.Array) -> jax.Array:
        """An episode's commands `[K, 3]`."""
        key_command, key_stand = jax.random.split(key)
        low, high = jnp.asarray([getattr(self.config, name) for name in RANGES], float).T
        number = self.config.commands
        commands = jax.random.uniform(key_command, (number, 3), minval=low, maxval=high)
        return commands * (jax.random.uniform(key_stand, (number, 1)) >= self.config.stand)

    def _find_errors(self, before: WalkState, motion: Motion) -> tuple[jax.Array, jax.Array]:
        """(v_xy - v_xy* `[2]`, w_z - w*), of the command under which the robot moved."""
        command = self.find_command(before)
        return motion.velocity[:2] - command[:2], motion.turning[2] - command[2]

    def _find_reward(self, before: WalkState, after: WalkState, torque: jax.Array, fallen: jax.Array) -> jax.Array:
        """R of the step between the two states; see the module."""
        config, motion = self.config, self.find_motion(after)
        error, turn_error = self._find_errors(before, motion)
        reward = jnp.exp(-jnp.sum(error**2) / config.sigma)
        reward += config.lambda_turn * jnp.exp(-(turn_error**2) / config.sigma_turn)
        penalty = config.lambda_bounce * motion.velocity[2] ** 2 + config.lambda_sway * jnp.sum(motion.turning[:2] ** 2)
        penalty += config.lambda_tilt * jnp.sum((motion.down - self.stand_down) ** 2)
        penalty += config.lambda_torque * jnp.sum(torque**2) + config.lambda_fall * fallen
        penalty += self._find_leg_penalty(after) + self._find_foot_penalty(before.record, after.record)
        return reward - penalty

    def _find_leg_penalty(self, state: WalkState) -> jax.Array:
        """Penalties of actions and joints."""
        config, angles = self.config, state.qpos[self.qpos_of]
        last, before = state.record.actions
        near = self.robot.find_nearness(angles, config.limit_margin)
        penalty = config.lambda_rate * jnp.sum((last - before) ** 2) + config.lambda_limit * jnp.sum(near**2)
        return penalty + config.lambda_pose * jnp.sum((angles - self.angles) ** 2)

    def _find_foot_penalty(self, before: Record, after: Record) -> jax.Array:
        """Penalties of feet that slip, or land too early or too late."""
        config, height = self.config, self._find_heights(after.feet)
        speed = jnp.sum((after.feet - before.feet)[:, :2] ** 2, axis=1) / config.dt**2
        slip = jnp.sum(speed * jnp.maximum(0.0, 1 - height / config.clearance) ** 2)
        landed = (before.air > 0) & (after.air == 0)
        early = landed * jnp.maximum(0.0, config.air_time - before.air)
        late = jnp.clip(after.air - config.air_time, 0.0, config.air_time)
        return config.lambda_slip * slip + config.lambda_air * jnp.sum(early + late)

    def _update_record(self, before: WalkState, after: WalkState, action: jax.Array, torque: jax.Array) -> Record:
        """The record after a step."""
        record, motion = before.record, self.find_motion(after)
        steps, feet = record.steps + 1, self._locate_feet(after.qpos)
        late, latest = steps > self.half, steps > self.config.episode_length - self.last
        error, turn_error = self._find_errors(before, motion)
        speed = jnp.sqrt(jnp.sum(error**2))
        height = after.qpos[self.robot.base_qpos + 2] - self.robot.floor
        is_up = self._find_heights(feet) > LANDED
        return Record(
            steps=steps,
            actions=jnp.stack([action, record.actions[0]]),
            feet=feet,
            air=jnp.where(is_up, record.air + self.config.dt, 0.0),
            errors=record.errors + late * jnp.stack([speed, jnp.abs(turn_error)]),
            last=record.last + latest * speed,
            height=record.height + late * height,
            torque=record.torque + jnp.mean(jnp.abs(torque)),
            power=record.power + jnp.sum(jnp.abs(torque * after.qvel[self.dof_of])),
            jerk=record.jerk + find_jerk(action, record.actions),
        )

    def _find_metrics(self, state: WalkState, fallen: jax.Array) -> dict[str, jax.Array]:
        """Means over the episode so far, or over its second half so far (0 before it)."""
        record, steps = state.record, jnp.maximum(state.record.steps, 1.0)
        late = jnp.maximum(record.steps - self.half, 1.0)
        followed = record.last / self.last < self.config.success_speed
        success = (record.steps >= self.config.episode_length) & followed & ~fallen
        return {
            "success": success.astype(record.steps.dtype),
            "velocity_error": record.errors[0] / late,
            "turn_error": record.errors[1] / late,
            "fallen": fallen.astype(record.steps.dtype),
            "height": record.height / late,
            "torque": record.torque / steps,
            "power": record.power / steps,
            "jerk": record.jerk / steps,
        }


def start_record(feet: jax.Array, action_size: int) -> Record:
    """The record at the start, with feet at `[F, 3]`."""
    zero = jnp.zeros(())
    return Record(
        steps=zero,
        actions=jnp.zeros((2, action_size)),
        feet=feet,
        air=jnp.zeros(len(feet)),
        errors=jnp.zeros(2),
        last=zero,
        height=zero,
        torque=zero,
        power=zero,
        jerk=zero,
    )


def _find_set_point_ranges(joints) -> tuple[np.ndarray, np.ndarray]:
    """(lowest, highest) set-points [n]: those of the servos' controls."""
    low, high = np.array([joint.drive.quantity_range() for joint in joints]).T
    return low, high
