"""Drive to a pose on the ground: a robot on two driven wheels, from a file or the one that is shipped.

The middle of the axle shall reach the goal (x_g, y_g, heading_g) and stay there. The wheels cannot move it sideways, so
where it is beside its goal, being near is of no use. What counts is the way that is left if the robot turns towards the
goal, or its back to it, drives there, and turns to the goal's heading. With the distance d, the goal's bearing alpha
from straight ahead, and its heading theta from the robot's,

    turns = min(|alpha| + |theta - alpha|, 2 pi - |alpha| - |theta - alpha|)       the smaller is forwards or backwards
    D     = d + rho (n turns + (1 - n) |theta|),         n = d^2 / (d^2 + NEAR^2),      rho = lambda_angle

where rho turns angles into metres: with half the track, D is the way of a wheel. At the goal itself there is no
bearing, so there only theta counts. The reward of the state and action before the step is

    lesson:   r = -lambda_pos (d^2 + rho (1 - n') theta^2)                             - P      (section 5.2)
    precise:  r = -lambda_pos (D + PULL log(1 + D / PRECISION))                        - P
    P = lambda_torque |tau|^2 + lambda_velocity |w|^2 + lambda_rate |a - a_before|^2

with n' = d^2 / (d^2 + FAR^2), the wheels' torques tau and speeds w. A fall, a lean of more than `fall_angle`, ends the
episode and costs `lambda_fall`; the time limit is a truncation. `success` is 1 once the robot has stayed within
`success_radius` and `success_angle` for `hold_time`, for as long as it stays; that of the last step counts.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs.arm import sample_ring
from envs.base import Interface, State, initial_state
from envs.options import OptionError, option
from envs.physics import COLLISION, PHYSICS
from envs.robots import WHEEL_CONTROLS, load_robot, make_wheel_control
from envs.robots.quaternions import to_matrix, turn_about_z
from envs.robots.tasks import RobotEnv, count_hold_steps, divide_step, find_length, log_guesses
from envs.robots.wheels import (
    SPEED,
    TIME_CONSTANT,
    find_rolling_inertia,
    find_wheel_speeds,
    limit_speeds,
    steer_to_pose,
    wrap,
)
from envs.scenes import Scene

if TYPE_CHECKING:
    import mujoco

NEAR, FAR = 0.02, 0.2  # distances below which the heading counts, precise and lesson [m]
PRECISION, PULL = 0.05, 0.1  # of the logarithm in the precise reward [m]
SCALES = (0.2, 0.05, 0.01)  # at which the error is observed besides [m]
FIELD = 45.0  # of view, of the camera that is added [degrees]
SHIPPED = ("drive",)
TEXTBOOK_RETURN = -76.4  # of `envs.robots.wheels.steer_to_pose` with the default options: mean of 500 episodes


@dataclass(frozen=True)
class DriveConfig:
    """Options of the driving robot."""

    robot: str = option("drive", "drive, or path/to/robot.xml with two driven wheels")
    control: str = option("velocity", "what an action commands", choices=WHEEL_CONTROLS)
    torque: float = option(0.1, "share of the torque limits, control=torque", above=0, at_most=1)
    speed: float | None = option(None, "largest wheel speed [rad/s] [default: the servos', or 0.5 m/s]", above=0)
    goal_min: float = option(0.0, "smallest distance of goals from the start [m]", at_least=0)
    goal_max: float = option(1.0, "largest distance of goals from the start [m]", above=0)
    reward: str = option(
        "precise", "squared errors, or the way that is left on two wheels", choices=("lesson", "precise")
    )
    lambda_pos: float = option(1.0, "weight of the errors [1/m or 1/m^2]", at_least=0)
    lambda_angle: float = option(0.1, "metres that an angle counts for [m/rad]", at_least=0)
    lambda_torque: float = option(0.0, "weight of the squared torques [1/(N m)^2]", at_least=0)
    lambda_velocity: float = option(0.0, "weight of the squared wheel speeds [s^2/rad^2]", at_least=0)
    lambda_rate: float = option(0.0, "weight of the squared change of the action", at_least=0)
    lambda_fall: float = option(50.0, "cost of a fall", at_least=0)
    fall_angle: float = option(0.6, "lean that counts as a fall [rad]", above=0, below=1.5)
    success_radius: float = option(0.05, "distance that counts as reached [m]", above=0)
    success_angle: float = option(0.1, "angle that counts as reached [rad]", above=0)
    hold_time: float = option(0.2, "how long the goal must be held [s]", at_least=0)
    dt: float = option(0.05, "time between two actions [s]", above=0, at_most=1)
    physics: str = option("scalar", "MuJoCo's step as scalar equations, MJX, or C MuJoCo", choices=tuple(PHYSICS))
    collision: str = option("primitives", "which geoms collide", choices=COLLISION)
    episode_length: int = option(200, "steps until the time limit", at_least=1)

    def __post_init__(self):
        if not self.goal_min < self.goal_max:
            raise OptionError([f"env.goal_min={self.goal_min:g}: expected less than env.goal_max={self.goal_max:g}"])


TRAINING = {
    "ppo": {
        "num_envs": 128,
        "num_steps": 25,
        "total_steps": 1_000_000,
        "log_interval": 50_000,
        "eval_interval": 100_000,
        "algo.epochs": 4,
        "algo.num_shards": 2,
        "algo.minibatches": 4,
        "algo.actor_lr": 0.004,
        "algo.critic_lr": 0.008,
        "algo.final_lr": 0.05,
        "algo.gamma": 0.97,
        "algo.lambda_": 0.9,
        "algo.reward_scale": 5.0,
        "algo.normalize_advantages": False,  # they shrink with the distance, and so do the steps
        "network.widths": [64, 64],
        "network.activation": "elu",
    }
}


@struct.dataclass
class DriveState:
    """The robot's motion, its goal, and what is remembered of the episode.

    Attributes:
      qpos, qvel: positions `[nq]` and velocities `[nv]` of all joints.
      qacc_warmstart: where the solver of constraints starts, `[nv]`.
      act: activations of actuators `[na]`; None without them.
      goal: (x_g, y_g, heading_g) `[3]` [m, m, rad].
      action: the last one `[2]`; 0 before the start.
      held: for how many steps the goal has been held.
    """

    qpos: jax.Array
    qvel: jax.Array
    qacc_warmstart: jax.Array
    act: jax.Array | None
    goal: jax.Array
    action: jax.Array
    held: jax.Array


class Motion(NamedTuple):
    """Where the robot is and how it moves, of the middle of its axle.

    Attributes:
      place: (x, y) `[2]` [m].
      heading: of its forward axis in the plane [rad].
      lean: the world's upward axis in the robot's frame `[3]`; (0, 0, 1) at rest.
      velocity: forwards, to the left, upwards `[3]` [m/s].
      turning: about these axes `[3]` [rad/s].
    """

    place: jax.Array
    heading: jax.Array
    lean: jax.Array
    velocity: jax.Array
    turning: jax.Array


class Errors(NamedTuple):
    """What is left to the goal.

    Attributes:
      position: the goal's place in the robot's frame, forwards and to the left `[2]` [m].
      angle: the goal's heading from the robot's, in [-pi, pi) [rad].
    """

    position: jax.Array
    angle: jax.Array

    @property
    def distance(self) -> jax.Array:
        """D = |(x_g, y_g) - (x, y)| [m]; its gradient is 0 at the goal itself."""
        return find_length(self.position)


class Drive(RobotEnv):
    """A robot that drives to a pose; see the module's docstring for its equations."""

    def __init__(self, config: DriveConfig = DriveConfig()):
        self.config = config
        spec = load_robot(config.robot, SHIPPED)
        num_substeps = divide_step(spec, config.dt)
        self.control = make_wheel_control(spec, config.control, config.torque, config.speed, config.collision)
        self.robot = robot = self.control.robot
        log_guesses(robot.name, robot.guesses)
        add_camera(spec, config.goal_max)
        super().__init__(spec, robot.model, num_substeps, config.physics, config.collision)
        self.wheel_dofs = np.array([wheel.dof for wheel in robot.wheels])
        self.hold_steps = count_hold_steps(config.hold_time, config.dt)

    @property
    def action_size(self) -> int:
        return 2

    @property
    def interface(self) -> Interface:
        return Interface(self._name_observations(), self.control.names, tuple(self.control.limits.tolist()))

    @property
    def scene(self) -> Scene:
        return super().scene._replace(
            goal=lambda state: state.pipeline_state.goal.at[2].set(0.0), goal_radius=self.config.success_radius
        )

    @property
    def references(self) -> dict[str, float]:
        """The mean return of the textbook's pose controller, known only for the default options."""
        is_default = dataclasses.replace(self.config, physics="scalar") == DriveConfig()
        return {"textbook controller": TEXTBOOK_RETURN} if is_default else {}

    def reset(self, rng: jax.Array) -> State:
        """At rest at the origin with any heading; the goal uniform over the ring's area, with any heading."""
        key_start, key_place, key_heading = jax.random.split(rng, 3)
        config, robot = self.config, self.robot
        heading, goal = (jax.random.uniform(key, minval=-jnp.pi, maxval=jnp.pi) for key in (key_start, key_heading))
        state = DriveState(
            qpos=turn_base(jnp.asarray(robot.qpos, float), robot.base[0], heading),
            qvel=jnp.zeros(robot.model.nv),
            qacc_warmstart=jnp.zeros(robot.model.nv),
            act=jnp.asarray(robot.act, float) if robot.model.na else None,
            goal=jnp.append(sample_ring(key_place, config.goal_min, config.goal_max), goal),
            action=jnp.zeros(2),
            held=jnp.zeros(()),
        )
        motion = self.find_motion(state)
        errors = find_errors(motion, state.goal)
        return initial_state(state, self.observe(state, motion, errors), tuple(self._find_metrics(state, errors)))

    def step(self, state: State, action: jax.Array) -> State:
        """One step of `dt` under the command of the action, clipped to [-1, 1]."""
        before, action = state.pipeline_state, jnp.clip(action, -1.0, 1.0)
        after, force = self.advance(before.replace(action=action), self.control.command(action))
        motion = self.find_motion(after)
        errors = find_errors(motion, after.goal)
        after = after.replace(held=jnp.where(self._is_there(errors), before.held + 1.0, 0.0))
        fallen = (motion.lean[2] < math.cos(self.config.fall_angle)).astype(motion.lean.dtype)
        reward = self._find_reward(before, action, force[self.wheel_dofs]) - self.config.lambda_fall * fallen
        return state.replace(
            pipeline_state=after,
            obs=self.observe(after, motion, errors),
            reward=reward,
            done=fallen,
            metrics=self._find_metrics(after, errors),
        )

    def baseline(self, state: State) -> jax.Array:
        """The action of the textbook's pose controller, which knows wheels and track (`steer_to_pose`), `[2]`.

        With torque control a proportional controller keeps the wheel speeds, of `SPEED` at most.
        """
        motion, robot, limits = state.pipeline_state, self.robot, jnp.asarray(self.control.limits, float)
        errors = find_errors(self.find_motion(motion), motion.goal)
        twist = steer_to_pose(errors.position, errors.angle)
        wanted = find_wheel_speeds(*twist, robot.radius, robot.track)
        if self.config.control == "velocity":
            return limit_speeds(wanted, limits) / limits
        wanted = limit_speeds(wanted, jnp.full(2, SPEED / robot.radius))
        torque = find_rolling_inertia(robot) / TIME_CONSTANT * (wanted - self._find_wheel_speeds(motion))
        return jnp.clip(torque / limits, -1.0, 1.0)

    def find_motion(self, state: DriveState) -> Motion:
        """Where the robot is and how it moves."""
        free, dof = self.robot.base
        frame, axle = jnp.asarray(self.robot.frame, float), jnp.asarray(self.robot.axle, float)
        base = to_matrix(state.qpos[free + 3 : free + 7])
        axes = base @ frame.T  # the robot's, as columns
        spin = state.qvel[dof + 3 : dof + 6]  # in the base's frame
        velocity = state.qvel[dof : dof + 3] + base @ jnp.cross(spin, axle)
        place = state.qpos[free : free + 3] + base @ axle
        return Motion(place[:2], jnp.arctan2(axes[1, 0], axes[0, 0]), axes[2], axes.T @ velocity, frame @ spin)

    def observe(self, state: DriveState, motion: Motion, errors: Errors) -> jax.Array:
        """What the policy sees, `[observation_size]`, in the order of the interface's names.

            (d, e, e / (d + 20 cm), e / (d + 5 cm), e / (d + 1 cm), cos(theta), sin(theta), v, w, wheels' speeds,
            lean, its rates, q and q' of other joints, a_before)     with the goal's place e in the robot's frame

        e / (d + 1 cm) is (cos, sin) of the bearing but for the last centimetres, where it goes to 0. Smaller scales let
        a network with smooth activations be exact near the goal. The last action is seen if its change costs.
        """
        model, others = self.robot.model, list(self.robot.others)
        position, distance = errors.position, errors.distance
        angles, dofs = model.jnt_qposadr[others], model.jnt_dofadr[others]
        parts = [distance[None], position, *(position / (distance + scale) for scale in SCALES)]
        parts += [jnp.stack([jnp.cos(errors.angle), jnp.sin(errors.angle), motion.velocity[0], motion.turning[2]])]
        parts += [self._find_wheel_speeds(state), motion.lean[:2], motion.turning[:2]]
        parts += [jnp.cos(state.qpos[angles]), jnp.sin(state.qpos[angles]), state.qvel[dofs]] if others else []
        parts += [state.action] if self.config.lambda_rate else []
        return jnp.concatenate(parts)

    def _name_observations(self) -> tuple[str, ...]:
        """The names in the order of `observe`."""
        others = [self.robot.model.joint(i).name for i in self.robot.others]
        sides = ("left", "right")
        names = ["distance [m]", "goal ahead [m]", "goal to the left [m]"]
        names += [f"goal {way} / (distance + {100 * x:g} cm)" for x in SCALES for way in ("ahead", "to the left")]
        names += ["cos(angle)", "sin(angle)", "forward speed [m/s]", "turn speed [rad/s]"]
        names += [f"{side} wheel's speed [rad/s]" for side in sides]
        names += ["lean forwards", "lean to the left", "roll speed [rad/s]", "pitch speed [rad/s]"]
        names += [f"{function}({name})" for function in ("cos", "sin") for name in others]
        names += [f"{name}' [rad/s]" for name in others]
        names += [f"last {side} wheel's command / limit" for side in sides] if self.config.lambda_rate else []
        return tuple(names)

    def _find_wheel_speeds(self, state: DriveState) -> jax.Array:
        """(left, right) `[2]` [rad/s], positive forwards."""
        return jnp.asarray([wheel.sign for wheel in self.robot.wheels]) * state.qvel[self.wheel_dofs]

    def _find_reward(self, state: DriveState, action: jax.Array, torque: jax.Array) -> jax.Array:
        """R of the state and action before the step, without falls; see the module."""
        config, errors = self.config, find_errors(self.find_motion(state), state.goal)
        if config.reward == "lesson":
            cost = find_square(errors, config.lambda_angle)
        else:
            way = find_way(errors, config.lambda_angle)
            cost = way + PULL * jnp.log1p(way / PRECISION)
        penalty = config.lambda_torque * jnp.sum(torque**2)
        penalty += config.lambda_velocity * jnp.sum(self._find_wheel_speeds(state) ** 2)
        penalty += config.lambda_rate * jnp.sum((action - state.action) ** 2)
        return -config.lambda_pos * cost - penalty

    def _is_there(self, errors: Errors) -> jax.Array:
        config = self.config
        return (errors.distance < config.success_radius) & (jnp.abs(errors.angle) < config.success_angle)

    def _find_metrics(self, state: DriveState, errors: Errors) -> dict[str, jax.Array]:
        return {
            "success": (state.held >= self.hold_steps).astype(state.held.dtype),
            "distance": errors.distance,
            "angle": jnp.abs(errors.angle),
            "held": state.held * self.config.dt,
        }


def find_errors(motion: Motion, goal: jax.Array) -> Errors:
    """Where the goal (x_g, y_g, heading_g) `[3]` is in the robot's frame, which is level: only the heading turns it."""
    cosine, sine = jnp.cos(motion.heading), jnp.sin(motion.heading)
    x, y = goal[:2] - motion.place
    return Errors(jnp.stack([cosine * x + sine * y, cosine * y - sine * x]), wrap(goal[2] - motion.heading))


def find_way(errors: Errors, lambda_angle: float) -> jax.Array:
    """The way D [m] that is left for a robot that turns, drives and turns; see the module.

    >>> beside = Errors(jnp.array([0.0, 1.0]), jnp.array(0.0))
    >>> round(float(find_way(beside, lambda_angle=0.1)), 3)  # 1 m and two quarter turns
    1.314
    """
    bearing = jnp.arctan2(errors.position[1], errors.position[0])
    forwards = jnp.abs(bearing) + jnp.abs(wrap(errors.angle - bearing))
    turns = jnp.minimum(forwards, 2 * jnp.pi - forwards)
    far = errors.distance**2 / (errors.distance**2 + NEAR**2)
    return errors.distance + lambda_angle * (far * turns + (1 - far) * jnp.abs(errors.angle))


def find_square(errors: Errors, lambda_angle: float) -> jax.Array:
    """D^2 + lambda_angle theta^2 FAR^2 / (d^2 + FAR^2) [m^2]: the heading counts near the goal."""
    squared = errors.distance**2
    return squared + lambda_angle * errors.angle**2 * FAR**2 / (squared + FAR**2)


def add_camera(spec: mujoco.MjSpec, reach: float) -> None:
    """Adds a camera that sees all within `reach` [m] of the origin from above, unless the world has a camera."""
    if not list(spec.worldbody.cameras):
        height = 1.15 * reach / math.tan(math.radians(FIELD / 2))
        spec.worldbody.add_camera(name="from above", pos=[0, 0, height], fovy=FIELD)


def turn_base(qpos: jax.Array, free: int, heading: jax.Array) -> jax.Array:
    """The positions after the base, whose free joint begins at `free`, has turned about the vertical at the origin."""
    upright = jnp.array([1.0, 0.0, 0.0, 0.0], qpos.dtype)
    place = to_matrix(turn_about_z(heading, upright)) @ qpos[free : free + 3]
    turned = turn_about_z(heading, qpos[free + 3 : free + 7])
    return qpos.at[free : free + 7].set(jnp.concatenate([place, turned]))
