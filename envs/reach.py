"""Reach a goal with the end effector of an arm: any arm, from a file or by name.

The end effector x, R (position, rotation) shall reach the goal x_g, with `goal=pose` also its orientation R_g, and stay
there. With d = |x - x_g| and the angle theta of R_g R^T, the reward of the state and action before the step is

    lesson:   r = -lambda_pos d^2           - lambda_angle theta^2          - P        (the lesson's section 5.2)
    precise:  r = -lambda_pos (d^2 + f(d))  - lambda_angle f(theta)         - P
    f(x) = x + 0.1 log(1 + x / 0.01)
    P = lambda_torque |tau|^2 + lambda_velocity |q'|^2 + lambda_rate |a - a_before|^2 + lambda_limit sum_i e_i^2

where e_i is how far joint i is within `limit_margin` of the ends of its range, and tau are the joint torques of the
actuators. The square is flat near the goal. The slope of f, in `precise`, the default, is 1 far from the goal and 11 at
the goal itself. Never terminates; the time limit is a truncation. `success` is 1 once the end effector has stayed
within `success_radius` (and `success_angle`) for `hold_time`, for as long as it stays; that of the last step counts for
the episode.

Goals are where random poses of the joints lead (`envs.robots.goals`), or uniform in a box. With `goals=3` each third of
the episode has a goal of its own, and success needs all three held at the end of their time. With `motion=line` a goal
moves to and fro, x_g + A sin(w t) e, and with `motion=circle` on x_g + A (e sin(w t) + f (1 - cos(w t))), with random
perpendicular directions e and f, and w A = `motion_speed`.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs.base import Interface, State, initial_state
from envs.options import OptionError, option
from envs.physics import COLLISION, PHYSICS, compile_forward
from envs.robots import CONTROLS, load_robot, make_control
from envs.robots.controls import ControlOptions
from envs.robots.goals import draw_poses
from envs.robots.resolved_rate import Controller, make_resolved_rate
from envs.robots.tasks import (
    SCALES,
    Record,
    RobotEnv,
    count_hold_steps,
    divide_step,
    extend_record,
    find_length,
    find_penalty,
    find_record_metrics,
    log_guesses,
    name_actions,
    name_joints,
    observe_joints,
    pull,
    start_record,
)
from envs.scenes import Scene

ANGLE_SCALES = (0.25, 0.05)  # at which angles are observed besides [rad]
POSE_NOISE = 0.05  # around the poses that lead to goals [rad or m], so that goals are everywhere between them
MOTIONS = ("none", "line", "circle")


@dataclass(frozen=True)
class ReachConfig:
    """Options of the reaching arm."""

    robot: str = option("panda", "panda, ur5e, so100, path/to/robot.xml, or menagerie:NAME")
    site: str = option("", "site or body that is the end effector [default: found by its name]")
    control: str = option("velocity", "what an action commands", choices=CONTROLS)
    torque: float = option(0.5, "share of the torque limits, control=torque", above=0, at_most=1)
    speed: float | None = option(None, "largest joint speed [rad/s or m/s] [default: the robot's, or 2]", above=0)
    step: float = option(0.2, "largest step of a position, control=position [rad or m]", above=0)
    goal: str = option("position", "what is to be reached", choices=("position", "pose"))
    goal_box: list[float] = option([], "corners x,y,z,x,y,z of a box of goals [m] [default: where poses lead]")
    goals: int = option(1, "goals in an episode, one after the other", at_least=1)
    motion: str = option("none", "how goals move", choices=MOTIONS)
    motion_speed: float = option(0.1, "largest speed of moving goals [m/s]", above=0)
    motion_size: float = option(0.1, "amplitude or radius of their motion [m]", above=0)
    start_spread: float = option(0.2, "around the pose at rest, of random starts [rad or m]", at_least=0)
    reward: str = option(
        "precise", "squared distance, or one that also pulls over the last centimetres", choices=("lesson", "precise")
    )
    lambda_pos: float = option(1.0, "weight of the position error [1/m^2]", at_least=0)
    lambda_angle: float = option(0.2, "weight of the angle, goal=pose [1/rad]", at_least=0)
    lambda_torque: float = option(0.0, "weight of the squared torques [1/(N m)^2]", at_least=0)
    lambda_velocity: float = option(0.0, "weight of the squared joint velocities [s^2/rad^2]", at_least=0)
    lambda_rate: float = option(0.01, "weight of the squared change of the action", at_least=0)
    lambda_limit: float = option(0.0, "weight of the squared nearness to joint limits [1/rad^2]", at_least=0)
    limit_margin: float = option(0.1, "distance from a limit that counts as near [rad or m]", above=0)
    success_radius: float = option(0.05, "distance that counts as reached [m]", above=0)
    success_angle: float = option(0.1, "angle that counts as reached, goal=pose [rad]", above=0)
    hold_time: float = option(0.2, "how long the goal must be held [s]", at_least=0)
    dt: float = option(0.02, "time between two actions [s]", above=0, at_most=1)
    physics: str = option("scalar", "MuJoCo's step as scalar equations, MJX, or C MuJoCo", choices=tuple(PHYSICS))
    collision: str = option("primitives", "which geoms collide", choices=COLLISION)
    episode_length: int = option(150, "steps until the time limit", at_least=1)

    def __post_init__(self):
        box = np.asarray(self.goal_box)
        if box.size not in (0, 6) or (box.size == 6 and not (box[:3] < box[3:]).all()):
            raise OptionError(
                [f"env.goal_box={self.goal_box}: expected the lower and the upper corner, [x,y,z,x,y,z] in metres"]
            )
        if box.size and self.goal == "pose":
            raise OptionError(
                ["env.goal_box: poses are drawn where joint angles lead; leave out goal_box or goal=pose"]
            )


TRAINING = {
    "ppo": {
        "num_envs": 256,
        "num_steps": 50,
        "total_steps": 6_000_000,
        "log_interval": 100_000,
        "eval_interval": 500_000,
        "algo.epochs": 4,
        "algo.num_shards": 2,
        "algo.minibatches": 8,
        "algo.actor_lr": 0.002,
        "algo.critic_lr": 0.004,
        "algo.final_lr": 0.05,
        "algo.gamma": 0.95,
        "algo.lambda_": 0.9,
        "algo.reward_scale": 5.0,
        "algo.normalize_advantages": False,  # they shrink with the distance, and so do the steps
        "network.widths": [64, 64],
        "network.activation": "elu",
    }
}


@struct.dataclass
class ReachState:
    """The robot's motion, its goals, and the record of the episode.

    Attributes:
      qpos, qvel: positions `[nq]` and velocities `[nv]` of all joints.
      qacc_warmstart: where the solver of constraints starts, `[nv]`.
      act: activations of actuators `[na]`; None without them.
      target: set-points of the joints `[n]`; None if the control has none.
      goals: positions `[K, 3]` [m] of the episode's goals, at time 0 if they move.
      rotations: the goals' rotation matrices `[K, 3, 3]`; None without orientations.
      directions: the two perpendicular directions `[2, 3]` of a motion; None if goals rest.
      reached: how many goals were held at the end of their time.
      record: for metrics.
    """

    qpos: jax.Array
    qvel: jax.Array
    qacc_warmstart: jax.Array
    act: jax.Array | None
    target: jax.Array | None
    goals: jax.Array
    rotations: jax.Array | None
    directions: jax.Array | None
    reached: jax.Array
    record: Record


class Errors(NamedTuple):
    """What is left to the goal.

    Attributes:
      position: x_g - x `[3]` [m].
      turn: sin(theta) times the axis of the rotation R_g R^T `[3]`; None without orientation.
      cosine: cos(theta); None without orientation.
    """

    position: jax.Array
    turn: jax.Array | None
    cosine: jax.Array | None

    @property
    def distance(self) -> jax.Array:
        """D = |x_g - x| [m]; its gradient is 0 at the goal itself."""
        return find_length(self.position)

    @property
    def angle(self) -> jax.Array:
        """Theta in [0, pi] [rad]; 0 without orientation."""
        if self.turn is None or self.cosine is None:
            return jnp.zeros_like(self.distance)
        return jnp.arctan2(find_length(self.turn), self.cosine)


class Reach(RobotEnv):
    """An arm that reaches; see the module's docstring for its equations."""

    def __init__(self, config: ReachConfig = ReachConfig()):
        self.config = config
        spec = load_robot(config.robot)
        num_substeps = divide_step(spec, config.dt)
        told = ControlOptions(config.control, config.torque, config.speed, config.step, config.dt)
        self.control = make_control(spec, config.site, told)
        self.arm = arm = self.control.arm
        log_guesses(arm.name, arm.guesses)
        super().__init__(spec, arm.model, num_substeps, config.physics, config.collision)
        self.place = compile_forward(arm.model, outputs=(f"site_xpos[{arm.site}]", f"site_xmat[{arm.site}]"))
        self.poses = None if config.goal_box else jnp.asarray(draw_poses(arm), float)
        self.hold_steps = count_hold_steps(config.hold_time, config.dt)

    @property
    def action_size(self) -> int:
        return len(self.control.limits)

    @property
    def interface(self) -> Interface:
        return Interface(self._name_observations(), self.control.names, tuple(self.control.limits.tolist()))

    @property
    def scene(self) -> Scene:
        return super().scene._replace(
            goal=lambda state: self.find_goal(state.pipeline_state),
            goal_radius=self.config.success_radius,
            goal_rotation=(lambda state: self.find_rotation(state.pipeline_state))
            if self.config.goal == "pose"
            else None,
            site=self.model.site(self.arm.site).id,
        )

    def reset(self, rng: jax.Array) -> State:
        """q ~ rest + U(-start_spread, start_spread)^n within the ranges, without velocity; random goals."""
        key_start, key_goals, key_motion = jax.random.split(rng, 3)
        (low, high), spread, model = self.arm.ranges, self.config.start_spread, self.arm.model
        shift = jax.random.uniform(key_start, low.shape, minval=-spread, maxval=spread)
        angles = jnp.clip(self.arm.angles + shift, low, high)
        goals, rotations = self._draw_goals(key_goals)
        state = ReachState(
            qpos=jnp.asarray(self.arm.qpos, float).at[self.arm.qpos_of].set(angles),
            qvel=jnp.zeros(model.nv),
            qacc_warmstart=jnp.zeros(model.nv),
            act=self.control.start(angles) if model.na else None,
            target=angles if self.control.has_target else None,
            goals=goals,
            rotations=rotations if self.config.goal == "pose" else None,
            directions=draw_directions(key_motion) if self.config.motion != "none" else None,
            reached=jnp.zeros(()),
            record=start_record(self.action_size),
        )
        errors = self.find_errors(state)
        return initial_state(state, self.observe(state, errors), tuple(self._find_metrics(state, errors)))

    def step(self, state: State, action: jax.Array) -> State:
        """One step of `dt` under the command of the action, clipped to [-1, 1]."""
        before, action = state.pipeline_state, jnp.clip(action, -1.0, 1.0)
        ctrl, target = self.control.command(action, before.qpos, before.target)
        after, force = self.advance(before, ctrl)
        after = after.replace(target=target, record=before.record.replace(steps=before.record.steps + 1))
        errors = self.find_errors(after)
        after = self._remember(after, errors, action)
        return state.replace(
            pipeline_state=after,
            obs=self.observe(after, errors),
            reward=self._find_reward(before, action, force[self.arm.dof_of]),
            metrics=self._find_metrics(after, errors),
        )

    @functools.cached_property
    def _resolved_rate(self) -> Controller:
        config = self.config
        return make_resolved_rate(self.control, self.control.speeds, config.control, config.dt)

    def baseline(self, state: State) -> jax.Array:
        """The action of a textbook controller that knows the model (`envs.robots.resolved_rate`), `[m]`."""
        motion, errors = state.pipeline_state, self.find_errors(state.pipeline_state)
        turn = None if errors.turn is None else errors.angle * errors.turn / find_length(errors.turn)
        return self._resolved_rate(motion.qpos, motion.qvel, errors.position, turn)

    def find_errors(self, state: ReachState) -> Errors:
        """How far the end effector is from the present goal."""
        position, rotation = self.place(state.qpos)
        error = self.find_goal(state) - position
        if state.rotations is None:
            return Errors(error, None, None)
        return Errors(error, *find_turn(self.find_rotation(state), rotation.reshape(3, 3)))

    def find_goal(self, state: ReachState) -> jax.Array:
        """Where the present goal is `[3]` [m]."""
        return state.goals[self._find_part(state.record.steps)] + move_goal(state, self.config)[0]

    def find_rotation(self, state: ReachState) -> jax.Array:
        """How the present goal is turned `[3, 3]`; only with `goal=pose`."""
        assert state.rotations is not None
        return state.rotations[self._find_part(state.record.steps)]

    def observe(self, state: ReachState, errors: Errors) -> jax.Array:
        """What the policy sees, `[observation_size]`, in the order of the interface's names.

            (cos q, sin q, or q of slides, q', q* - q, x_g, e, e / (d + 5 cm), e / (d + 1 cm), x_g', s, cos(theta),
            s / (theta + 0.25), s / (theta + 0.05), a_before)

        with e = x_g - x and s = sin(theta) axis; what the options leave out is not there. The errors at smaller scales
        let a network with smooth activations be exact near the goal.
        """
        config, goal, (_, velocity) = self.config, self.find_goal(state), move_goal(state, self.config)
        parts = observe_joints(self.arm, state)
        parts += [goal, errors.position, *(errors.position / (errors.distance + scale) for scale in SCALES)]
        parts += [] if config.motion == "none" else [velocity]
        if errors.turn is not None and errors.cosine is not None:
            parts += [
                errors.turn,
                errors.cosine[None],
                *(errors.turn / (errors.angle + scale) for scale in ANGLE_SCALES),
            ]
        parts += [state.record.actions[0]] if config.lambda_rate else []
        return jnp.concatenate(parts)

    def _name_observations(self) -> tuple[str, ...]:
        """The names in the order of `observe`."""
        config, names = self.config, name_joints(self.arm, self.control.has_target)
        names += [f"{what} {axis} [m]" for what in ("goal", "error") for axis in "xyz"]
        names += [f"error {axis} / (distance + {100 * scale:g} cm)" for scale in SCALES for axis in "xyz"]
        names += [] if config.motion == "none" else [f"goal {axis}' [m/s]" for axis in "xyz"]
        if config.goal == "pose":
            names += [*(f"sin(angle) axis {axis}" for axis in "xyz"), "cos(angle)"]
            names += [f"sin(angle) axis {axis} / (angle + {scale:g} rad)" for scale in ANGLE_SCALES for axis in "xyz"]
        names += name_actions(self.control.names) if config.lambda_rate else []
        return tuple(names)

    def _draw_goals(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Positions `[K, 3]` and rotations `[K, 3, 3]` of an episode's goals."""
        number = self.config.goals
        if self.poses is None:
            box = jnp.asarray(self.config.goal_box, float)
            goals = jax.random.uniform(key, (number, 3), minval=box[:3], maxval=box[3:])
            return goals, jnp.broadcast_to(jnp.eye(3), (number, 3, 3))
        key_pose, key_noise = jax.random.split(key)
        poses = self.poses[jax.random.randint(key_pose, (number,), 0, len(self.poses))]
        poses += jax.random.uniform(key_noise, poses.shape, minval=-POSE_NOISE, maxval=POSE_NOISE)
        qpos = jnp.broadcast_to(jnp.asarray(self.arm.qpos, float), (number, self.arm.model.nq))
        positions, rotations = jax.vmap(self.place)(qpos.at[:, self.arm.qpos_of].set(poses))
        return positions, rotations.reshape(number, 3, 3)

    def _find_reward(self, state: ReachState, action: jax.Array, torque: jax.Array) -> jax.Array:
        """R of the state and action before the step; see the module."""
        config, errors = self.config, self.find_errors(state)
        distance, angle = errors.distance, errors.angle
        if config.reward == "lesson":
            cost = config.lambda_pos * distance**2 + config.lambda_angle * angle**2
        else:
            cost = config.lambda_pos * (distance**2 + pull(distance)) + config.lambda_angle * pull(angle)
        return -cost - find_penalty(config, self.arm, state, torque, action, state.record.actions[0])

    def _remember(self, state: ReachState, errors: Errors, action: jax.Array) -> ReachState:
        """The state with the record of a step, whose number of steps it has already, under an action."""
        config, record = self.config, state.record
        is_there = (errors.distance < config.success_radius) & (errors.angle < config.success_angle)
        is_new = self._find_part(record.steps) != self._find_part(record.steps - 1)
        held = jnp.where(is_there, jnp.where(is_new, 0.0, record.held) + 1.0, 0.0)
        return dataclasses.replace(
            state,
            reached=state.reached + jnp.where(is_new & self._is_held(record.held), 1.0, 0.0),
            record=extend_record(record, self.arm, state.qpos[self.arm.qpos_of], held, action),
        )

    def _find_part(self, steps: jax.Array) -> jax.Array:
        """The number of the present goal: floor(steps / (episode_length / K)), and the last one from then on."""
        config = self.config
        return jnp.minimum(steps * config.goals // config.episode_length, config.goals - 1).astype(int)

    def _is_held(self, held: jax.Array) -> jax.Array:
        return held >= self.hold_steps

    def _find_metrics(self, state: ReachState, errors: Errors) -> dict[str, jax.Array]:
        """Distances of now, and means or extremes of the episode so far."""
        reached = state.reached + self._is_held(state.record.held)
        success = (reached >= self.config.goals).astype(errors.distance.dtype)
        metrics = {"success": success, "distance": errors.distance}
        metrics |= find_record_metrics(state.record, self.config.dt)
        metrics |= {} if errors.turn is None else {"angle": errors.angle}
        return metrics | ({"reached": reached} if self.config.goals > 1 else {})


def move_goal(state: ReachState, config: ReachConfig) -> tuple[jax.Array, jax.Array]:
    """How far a moving goal is from where it began `[3]` [m], and its velocity `[3]` [m/s].

        line    A sin(w t) e                             circle    A (e sin(w t) + f (1 - cos(w t)))

    with w = motion_speed / A, and 0 for a goal that rests.
    """
    if state.directions is None:
        return jnp.zeros(3), jnp.zeros(3)
    along, across = state.directions
    size, speed = config.motion_size, config.motion_speed
    phase = speed / size * config.dt * state.record.steps
    shift, velocity = size * jnp.sin(phase) * along, speed * jnp.cos(phase) * along
    if config.motion == "circle":
        shift += size * (1 - jnp.cos(phase)) * across
        velocity += speed * jnp.sin(phase) * across
    return shift, velocity


def find_turn(goal: jax.Array, rotation: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(sin(theta) axis `[3]`, cos(theta)) of the rotation E = R_g R^T that is left to the goal.

        sin(theta) axis = (E_32 - E_23, E_13 - E_31, E_21 - E_12) / 2,        cos(theta) = (tr E - 1) / 2

    Smooth everywhere. At theta = pi the axis is lost, as its sign is there anyway.

    Args:
      goal, rotation: R_g and R `[3, 3]`.
    """
    left = goal @ rotation.T
    skew = jnp.stack([left[2, 1] - left[1, 2], left[0, 2] - left[2, 0], left[1, 0] - left[0, 1]]) / 2
    return skew, (jnp.trace(left) - 1) / 2


def draw_directions(key: jax.Array) -> jax.Array:
    """Two perpendicular unit vectors `[2, 3]`, the first uniform over the sphere, the second over the circle to it."""
    along, other = jax.random.normal(key, (2, 3))
    along /= jnp.linalg.norm(along)
    across = other - along * jnp.dot(along, other)
    return jnp.stack([along, across / jnp.linalg.norm(across)])
