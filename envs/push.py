"""Push an object over a table to a goal with a fist: any arm, from a file or by name.

A fist, a sphere at the end of a rod, is added to the end effector. The object, a puck or a box, lies on the table, the
plane z = 0, and shall get to the goal o_g and stay there. Places are in the robot's frame: the origin is on the table,
under the first joint, and x points to where the end effector is at rest. Let o be the object's place, e = o_g - o and
d = |e|, p the fist's place, and b = o - (r_object + r_fist) e / (d + 1 cm) the one behind the object. The reward of the
state and action before the step is

    r = -lambda_pos (d^2 + f(d)) - lambda_fist |b - p| d / (d + 5 cm) - lambda_height |z - h| - P
    f(x) = x + 0.1 log(1 + x / 0.01)
    P = lambda_torque |tau|^2 + lambda_velocity |q'|^2 + lambda_rate |a - a_before|^2 + lambda_limit sum_i e_i^2

where z is the height of the fist and h the one it shall have, e_i is how far joint i is within `limit_margin` of the
ends of its range, and tau are the joint torques of the actuators. Near the goal the fist is free. Never terminates; the
time limit is a truncation. `success` is 1 once the object has stayed within `success_radius` for `hold_time`, for as
long as it stays; that of the last step counts for the episode.

With `control=plane`, the default, an action is the velocity of the fist over the table. Its height is kept: with the
Jacobian J of the fist and the pose q_0 in the middle of the table,

    V = (speed a, GAIN (h - z)),        g = POSTURE (q_0 - q),        q'* = g + J^T (J J^T + lambda^2 I)^-1 (V - J g)

are the velocities that the joints are commanded, within their limits (`envs.robots.twists`). The other controls are
those of `envs.robots.controls`.

Only the object, the table and the fist collide with each other.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs.base import Interface, State, initial_state
from envs.options import OptionError, option
from envs.physics import PHYSICS, compile_forward, scalarize
from envs.robots import CONTROLS, Control, load_robot, make_control, read_arm
from envs.robots.arms import Arm
from envs.robots.controls import Command, ControlOptions
from envs.robots.placing import Placed, put
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
from envs.robots.twists import damped_least_squares, limit_velocities
from envs.scenes import Scene

if TYPE_CHECKING:
    import mujoco

FIST, TABLE, OBJECT = "push fist", "push table", "push object"  # of what is added to the robot
CLEARANCE = 0.01  # of the fist above the table [m]
GAIN, POSTURE = 5.0, 1.0  # of the fist's height, and of the joints that are free [1/s]
DAMPING = 0.02  # lambda [m]; small, so that the fist moves as it is told
DEPTH = 1e-4  # of an object at rest in the table, so that rounding does not say whether they touch [m]
CONTACT = 0.001  # depth of the fist in the table where it touches it, in a keyframe [m]
STEP, NEAR = 0.02, 0.005  # between the places that are tried in front of the robot, and how near counts as there [m]
NUM_POSES, NUM_DRAWS = 256, 8  # of starts, and of those of which the first is taken that is clear of the object
GAP = 0.01  # between fist and object at the start, at least [m]
PLANE = "plane"
PLANE_NAMES = ("fist velocity x [m/s]", "fist velocity y [m/s]")
WAYS = (PLANE, *CONTROLS)
WIDEST = 0.2  # radius of the area, at most [m]


@dataclass(frozen=True)
class PushConfig:
    """Options of the pushing arm."""

    robot: str = option("panda", "panda, ur5e, so100, path/to/robot.xml, or menagerie:NAME")
    site: str = option("", "site or body that is the end effector [default: found by its name]")
    control: str = option(PLANE, "what an action commands: the fist over the table, or as in reach", choices=WAYS)
    speed: float = option(0.4, "largest speed of the fist [m/s], control=plane", above=0)
    torque: float = option(0.5, "share of the torque limits, control=torque", above=0, at_most=1)
    step: float = option(0.2, "largest step of a position, control=position [rad or m]", above=0)
    fist_radius: float = option(0.025, "radius of the fist [m]", above=0)
    fist_length: float = option(0.1, "length of the rod that carries it [m]", at_least=0)
    object: str = option("puck", "what is pushed", choices=("puck", "box"))
    object_radius: float = option(0.05, "radius of the puck, or half the width of the box [m]", above=0)
    object_height: float = option(0.06, "height of the object [m]", above=0)
    object_mass: float = option(0.3, "mass of the object [kg]", above=0)
    object_friction: float = option(0.5, "coefficient of friction of the object", above=0)
    area: float | None = option(None, "radius of the area of starts and goals [m] [default: by reach]", above=0)
    nearest: float = option(0.05, "least distance of the goal [m]", above=0)
    farthest: float = option(0.25, "largest distance of the goal [m], if the area allows", above=0)
    lambda_pos: float = option(1.0, "weight of the object's error [1/m^2]", at_least=0)
    lambda_fist: float = option(0.5, "weight of the fist's way to the place behind the object [1/m]", at_least=0)
    lambda_height: float = option(1.0, "weight of the fist's distance from its height [1/m]", at_least=0)
    lambda_torque: float = option(0.0, "weight of the squared torques [1/(N m)^2]", at_least=0)
    lambda_velocity: float = option(0.0, "weight of the squared joint velocities [s^2/rad^2]", at_least=0)
    lambda_rate: float = option(0.01, "weight of the squared change of the action", at_least=0)
    lambda_limit: float = option(0.0, "weight of the squared nearness to joint limits [1/rad^2]", at_least=0)
    limit_margin: float = option(0.1, "distance from a limit that counts as near [rad or m]", above=0)
    success_radius: float = option(0.05, "distance that counts as reached [m]", above=0)
    hold_time: float = option(0.2, "how long the goal must be held [s]", at_least=0)
    dt: float = option(0.02, "time between two actions [s]", above=0, at_most=1)
    timestep: float = option(0.005, "of the physics [s], rounded to a part of dt", above=0)
    physics: str = option("scalar", "MuJoCo's step as scalar equations, MJX, or C MuJoCo", choices=tuple(PHYSICS))
    episode_length: int = option(250, "steps until the time limit", at_least=1)

    def __post_init__(self):
        if not self.nearest < self.farthest:
            line = f"env.nearest={self.nearest:g} must be below env.farthest={self.farthest:g}"
            raise OptionError([f"{line}, between which the distances of goals are"])


TRAINING = {
    "ppo": {
        "num_envs": 256,
        "num_steps": 50,
        "total_steps": 1_500_000,
        "log_interval": 100_000,
        "eval_interval": 250_000,
        "algo.epochs": 4,
        "algo.num_shards": 2,
        "algo.minibatches": 8,
        "algo.actor_lr": 0.002,
        "algo.critic_lr": 0.004,
        "algo.final_lr": 0.05,
        "algo.gamma": 0.97,
        "algo.lambda_": 0.9,
        "algo.reward_scale": 5.0,
        "algo.normalize_advantages": False,
        "network.widths": [64, 64],
        "network.activation": "elu",
    }
}


@struct.dataclass
class PushState:
    """The motion of robot and object, the goal, and the record of the episode.

    Attributes:
      qpos, qvel: positions `[nq]` and velocities `[nv]`: the robot's, then the object's 7 and 6.
      qacc_warmstart: where the solver of constraints starts, `[nv]`.
      act: activations of actuators `[na]`; None without them.
      target: set-points of the joints `[n]`; None if the control has none.
      goal: where the object shall be, `[2]` [m] in the robot's frame.
      record: for metrics.
    """

    qpos: jax.Array
    qvel: jax.Array
    qacc_warmstart: jax.Array
    act: jax.Array | None
    target: jax.Array | None
    goal: jax.Array
    record: Record


class Frame(NamedTuple):
    """The robot's frame on the table.

    Attributes:
      origin: `[2]` [m], in the world.
      axes: forwards and to the left `[2, 2]`, one a row.
    """

    origin: np.ndarray
    axes: np.ndarray

    def place(self, position):
        """A position of the world `[..., 2 or more]`, in this frame `[..., 2]`."""
        return (position[..., :2] - self.origin) @ self.axes.T

    def place_back(self, position):
        """A position in this frame `[..., 2]`, in the world `[..., 2]`."""
        return position @ self.axes + self.origin


class Area(NamedTuple):
    """The disc in which objects and goals are.

    Attributes:
      middle: of the disc, in front of the robot [m].
      radius: of the disc [m].
    """

    middle: float
    radius: float


class Places(NamedTuple):
    """Where things are on the table, in the robot's frame.

    Attributes:
      fist, object, behind: `[2]` [m]; the last is where the fist is wanted.
      error: goal - object `[2]` [m].
      height: of the fist [m].
    """

    fist: jax.Array
    object: jax.Array
    behind: jax.Array
    error: jax.Array
    height: jax.Array

    @property
    def distance(self) -> jax.Array:
        """D = |o_g - o| [m]; its gradient is 0 at the goal itself."""
        return find_length(self.error)


class Push(RobotEnv):
    """An arm that pushes; see the module's docstring for its equations."""

    def __init__(self, config: PushConfig = PushConfig()):
        self.config = config
        spec = load_robot(config.robot)
        num_substeps = divide_step(spec, config.dt, config.timestep)
        set_options(spec)
        self.frame, self.area, middle = add_fist(spec, config)
        way = "velocity" if config.control == PLANE else config.control
        told = ControlOptions(way, config.torque, None, config.step, config.dt)
        self.control = make_control(spec, FIST, told)
        self.arm = arm = self.control.arm
        self.middle = put(arm, self._lift(np.array([self.area.middle, 0.0])), middle.angles).angles
        self.command = self.control.command
        if config.control == PLANE:
            self.command = make_command(self.control, self.frame, self.height, self.middle, config)
        self._add_object(spec)
        super().__init__(spec, arm.model, num_substeps, config.physics)
        self.find_fist = compile_forward(arm.model, outputs=(f"site_xpos[{FIST}]",))
        self.starts = jnp.asarray(self._draw_starts(), float)
        self.hold_steps = count_hold_steps(config.hold_time, config.dt)

    @property
    def height(self) -> float:
        """Of the fist's middle above the table [m]."""
        return self.config.fist_radius + CLEARANCE

    @property
    def action_size(self) -> int:
        return 2 if self.config.control == PLANE else len(self.control.limits)

    @property
    def interface(self) -> Interface:
        names, limits = PLANE_NAMES, (self.config.speed,) * 2
        if self.config.control != PLANE:
            names, limits = self.control.names, tuple(self.control.limits.tolist())
        return Interface(self._name_observations(names), names, limits)

    @property
    def scene(self) -> Scene:
        return super().scene._replace(goal=self._show_goal, goal_radius=self.config.success_radius)

    def reset(self, rng: jax.Array) -> State:
        """The object at rest in the area, the goal at U(nearest, farthest) from it, the fist anywhere clear of it."""
        key_object, key_start, key_turn = jax.random.split(rng, 3)
        place, goal = self._draw_way(key_object)
        angles = self._draw_start(key_start, place)
        turn = jax.random.uniform(key_turn, minval=-jnp.pi, maxval=jnp.pi)
        model = self.model
        robot = jnp.asarray(self.arm.qpos, float).at[self.arm.qpos_of].set(angles)
        state = PushState(
            qpos=jnp.concatenate([robot, self._lay(place, turn)]),
            qvel=jnp.zeros(model.nv),
            qacc_warmstart=jnp.zeros(model.nv),
            act=self.control.start(angles) if model.na else None,
            target=angles if self.control.has_target else None,
            goal=goal,
            record=start_record(self.action_size),
        )
        places = self.find_places(state)
        return initial_state(state, self.observe(state, places), tuple(self._find_metrics(state.record, places)))

    def step(self, state: State, action: jax.Array) -> State:
        """One step of `dt` under the command of the action, clipped to [-1, 1]."""
        before, action = state.pipeline_state, jnp.clip(action, -1.0, 1.0)
        ctrl, target = self.command(action, before.qpos[: self.arm.model.nq], before.target)
        after, force = self.advance(before, ctrl)
        places = self.find_places(after)
        held = jnp.where(places.distance < self.config.success_radius, before.record.held + 1.0, 0.0)
        record = before.record.replace(steps=before.record.steps + 1)
        record = extend_record(record, self.arm, after.qpos[self.arm.qpos_of], held, action)
        after = after.replace(target=target, record=record)
        return state.replace(
            pipeline_state=after,
            obs=self.observe(after, places),
            reward=self._find_reward(before, action, force[self.arm.dof_of]),
            metrics=self._find_metrics(after.record, places),
        )

    def find_places(self, state: PushState) -> Places:
        """Where fist and object are, and where the fist is wanted."""
        (fist,) = self.find_fist(state.qpos[: self.arm.model.nq])
        place = self.frame.place(state.qpos[-7:])
        error = state.goal - place
        touching = self.config.object_radius + self.config.fist_radius
        behind = place - touching * error / (find_length(error) + SCALES[1])
        return Places(self.frame.place(fist), place, behind, error, fist[2])

    def observe(self, state: PushState, places: Places) -> jax.Array:
        """What the policy sees, `[observation_size]`, in the order of the interface's names.

            (cos q, sin q, or q of slides, q', q* - q, p, z, o, o', e, o - p and b - p at three scales, turn, a_before)

        A vector x at three scales is x, x / (|x| + 5 cm) and x / (|x| + 1 cm). The turn, (cos, sin, rate) about the
        vertical axis, is a box's.
        """
        parts = observe_joints(self.arm, state)
        parts += [places.fist, places.height[None], places.object, self.frame.axes @ state.qvel[-6:-4]]
        for vector in (places.error, places.object - places.fist, places.behind - places.fist):
            parts += [vector, *(vector / (find_length(vector) + scale) for scale in SCALES)]
        if self.config.object == "box":
            parts += [self._find_turn(state.qpos[-4:]), state.qvel[-1:]]
        parts += [state.record.actions[0]] if self.config.lambda_rate else []
        return jnp.concatenate(parts)

    def _find_turn(self, quaternion: jax.Array) -> jax.Array:
        """(cos, sin) of the angle by which the object's x axis is turned from the robot's, `[2]`."""
        w, x, y, z = quaternion
        return jnp.asarray(self.frame.axes) @ jnp.stack([w * w + x * x - y * y - z * z, 2 * (x * y + w * z)])

    def _name_observations(self, commands: tuple[str, ...]) -> tuple[str, ...]:
        """The names in the order of `observe`."""
        names = name_joints(self.arm, self.control.has_target)
        names += [*(f"fist {axis} [m]" for axis in "xyz"), *(f"object {axis} [m]" for axis in "xy")]
        names += [f"object {axis}' [m/s]" for axis in "xy"]
        for what in ("goal - object", "object - fist", "place behind - fist"):
            names += [f"{what} {axis} [m]" for axis in "xy"]
            names += [f"{what} {axis} / (distance + {100 * scale:g} cm)" for scale in SCALES for axis in "xy"]
        names += ["cos(turn)", "sin(turn)", "turn' [rad/s]"] if self.config.object == "box" else []
        names += name_actions(commands) if self.config.lambda_rate else []
        return tuple(names)

    def _show_goal(self, state: State) -> jax.Array:
        """The goal in the world `[3]` [m], at the height of the object's middle."""
        place = self.frame.place_back(state.pipeline_state.goal)
        return jnp.append(place, self.config.object_height / 2)

    def _lift(self, place: np.ndarray) -> np.ndarray:
        """The fist's place in the world `[3]` over one on the table `[2]`."""
        return np.append(self.frame.place_back(place), self.height)

    def _lay(self, place, turn) -> jax.Array:
        """The object's position and quaternion `[7]` at a place on the table, turned about the vertical axis."""
        half = turn / 2 + math.atan2(self.frame.axes[0, 1], self.frame.axes[0, 0]) / 2
        zero = jnp.zeros_like(half)
        height = jnp.full_like(half, self.config.object_height / 2 - DEPTH)
        position = self.frame.place_back(place)
        return jnp.stack([position[0], position[1], height, jnp.cos(half), zero, zero, jnp.sin(half)])

    def _add_object(self, spec: mujoco.MjSpec) -> None:
        """Adds the table, the object, and keyframes of what touches, by which contacts become equations."""
        config = self.config
        add_object(spec, config)
        touching = put(
            self.arm, self._lift(np.array([self.area.middle, 0.0])) - [0, 0, CLEARANCE + CONTACT], self.middle
        )
        aside = config.object_radius + 2 * config.fist_radius
        self._add_keyframe(spec, f"{OBJECT} beside the fist", touching.angles, aside, 0.0)
        self._add_keyframe(spec, f"{OBJECT} on the fist", self.middle, 0.0, self.height + config.fist_radius)

    def _add_keyframe(self, spec: mujoco.MjSpec, name: str, angles: np.ndarray, ahead: float, height: float) -> None:
        """Adds the arm at rest, with the object so far ahead of the middle and so high above the table [m]."""
        arm, control, robot = self.arm, self.control, self.arm.qpos.copy()
        robot[self.arm.qpos_of] = angles
        target = jnp.asarray(angles, float) if control.has_target else None
        ctrl, _ = control.command(jnp.zeros(len(control.limits)), jnp.asarray(robot, float), target)
        lying = np.array(self._lay(np.array([self.area.middle + ahead, 0.0]), jnp.zeros(())))
        lying[2] += height
        act = np.asarray(control.start(jnp.asarray(angles, float))) if arm.model.na else []
        spec.add_key(name=name, qpos=[*robot, *lying], ctrl=np.asarray(ctrl), act=act)

    def _draw_starts(self) -> np.ndarray:
        """Poses with the fist anywhere in the area and around it, `[NUM_POSES, n]`."""
        random, margin = np.random.default_rng(0), self.config.object_radius + self.config.fist_radius
        radii = (self.area.radius + margin) * np.sqrt(random.uniform(size=NUM_POSES))
        angles = random.uniform(-np.pi, np.pi, NUM_POSES)
        places = [self.area.middle, 0.0] + radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1)
        found = [put(self.arm, self._lift(place), self.middle) for place in places]
        near = [np.linalg.norm(x.position - self._lift(y)) < NEAR for x, y in zip(found, places, strict=True)]
        return np.array([x.angles for x, is_near in zip(found, near, strict=True) if is_near])

    def _draw_way(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Where object and goal are `[2]`: the ends of a line in the area, whose middle is uniform."""
        key_length, key_turn, key_middle, key_radius = jax.random.split(key, 4)
        radius = self.area.radius
        farthest = min(self.config.farthest, 2 * radius)
        length = jax.random.uniform(key_length, minval=self.config.nearest, maxval=farthest)
        turn, middle = (jax.random.uniform(k, minval=-jnp.pi, maxval=jnp.pi) for k in (key_turn, key_middle))
        away = (radius - length / 2) * jnp.sqrt(jax.random.uniform(key_radius))
        half = length / 2 * jnp.stack([jnp.cos(turn), jnp.sin(turn)])
        centre = jnp.array([self.area.middle, 0.0]) + away * jnp.stack([jnp.cos(middle), jnp.sin(middle)])
        return centre - half, centre + half

    def _draw_start(self, key: jax.Array, place: jax.Array) -> jax.Array:
        """Joint positions `[n]` of a start: the first of some draws with the fist clear of the object, or the last."""
        poses = self.starts[jax.random.randint(key, (NUM_DRAWS,), 0, len(self.starts))]
        robots = jnp.broadcast_to(jnp.asarray(self.arm.qpos, float), (NUM_DRAWS, self.arm.model.nq))
        (fists,) = jax.vmap(self.find_fist)(robots.at[:, self.arm.qpos_of].set(poses))
        width = self.config.object_radius * (math.sqrt(2.0) if self.config.object == "box" else 1.0)
        away = jnp.linalg.norm(self.frame.place(fists) - place, axis=1)
        return poses[jnp.argmax((away > width + self.config.fist_radius + GAP).at[-1].set(True))]

    def _find_reward(self, state: PushState, action: jax.Array, torque: jax.Array) -> jax.Array:
        """R of the state and action before the step; see the module."""
        config, places = self.config, self.find_places(state)
        distance = places.distance
        cost = config.lambda_pos * (distance**2 + pull(distance))
        cost += config.lambda_fist * find_length(places.behind - places.fist) * distance / (distance + SCALES[0])
        cost += config.lambda_height * jnp.abs(places.height - self.height)
        return -cost - find_penalty(config, self.arm, state, torque, action, state.record.actions[0])

    def _find_metrics(self, record: Record, places: Places) -> dict[str, jax.Array]:
        """Distances of now, and means or extremes of the episode so far."""
        success = (record.held >= self.hold_steps).astype(places.distance.dtype)
        metrics = {"success": success, "distance": places.distance, "height": places.height}
        return metrics | find_record_metrics(record, self.config.dt)


# --- the model --------------------------------------------------------------------------------------------------------


def set_options(spec: mujoco.MjSpec) -> None:
    """Sets an integrator that is stable for servos, and lets nothing of the robot collide."""
    import mujoco

    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for pair in list(spec.pairs):
        spec.delete(pair)
    for geom in spec.geoms:
        geom.contype, geom.conaffinity = 0, 0


def add_fist(spec: mujoco.MjSpec, config: PushConfig) -> tuple[Frame, Area, Placed]:
    """Adds the fist to the end effector; returns the robot's frame, its area, and the pose in the middle of it.

    The rod points downwards in that pose. Rod and fist weigh nothing.

    Raises:
      OptionError: there is no arm (`read_arm`), or it does not reach far enough over the table.
    """
    import mujoco

    arm = read_arm(spec, config.site)
    log_guesses(arm.name, arm.guesses)
    height = config.fist_radius + CLEARANCE + config.fist_length
    frame = find_frame(arm)
    area, pose = find_area(arm, frame, height, config)
    site = spec.site(arm.site)
    down = pose.rotation.T @ np.array([0.0, 0.0, -config.fist_length])
    tip, body = np.asarray(site.pos) + down, site.parent
    size = [config.fist_radius, 0, 0]
    shape = mujoco.mjtGeom
    body.add_geom(name=FIST, type=shape.mjGEOM_SPHERE, size=size, pos=tip, mass=0, contype=2, conaffinity=1, condim=1)
    if config.fist_length:
        ends, width = [*site.pos, *tip], [config.fist_radius / 3, 0, 0]
        body.add_geom(type=shape.mjGEOM_CAPSULE, size=width, fromto=ends, mass=0, contype=0, conaffinity=0)
    body.add_site(name=FIST, pos=tip)
    return frame, area, pose


def find_frame(arm: Arm) -> Frame:
    """The frame under the first joint, with x towards the end effector at rest; that of the world if it is above it."""
    import mujoco

    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.qpos
    mujoco.mj_fwdPosition(arm.model, data)
    origin = data.xanchor[arm.model.joint(arm.joints[0].name).id][:2].copy()
    ahead = data.site(arm.site).xpos[:2] - origin
    length = float(np.linalg.norm(ahead))
    x, y = ahead / length if length > NEAR else (1.0, 0.0)
    return Frame(origin, np.array([[x, y], [-y, x]]))


def find_area(arm: Arm, frame: Frame, height: float, config: PushConfig) -> tuple[Area, Placed]:
    """The area between the nearest and the farthest place that the end effector reaches straight ahead, at a height.

    Around the area there is room for the fist to get behind an object.

    Raises:
      OptionError: it is too small for the nearest goals, or for the option `area`.
    """
    far = float(np.sum(np.linalg.norm(arm.model.body_pos, axis=1))) + height
    places = np.arange(STEP, far, STEP)
    wanted = [np.append(frame.place_back(np.array([x, 0.0])), height) for x in places]
    found = [put(arm, place, arm.angles) for place in wanted]
    reached = [np.linalg.norm(x.position - place) < NEAR for x, place in zip(found, wanted, strict=True)]
    first, last = find_longest_run(reached)
    near, far = places[[first, last - 1]] if last > first else (0.0, 0.0)
    room = (far - near) / 2 - config.object_radius - 2 * config.fist_radius
    radius = min(room, WIDEST) if config.area is None else config.area
    if room < max(radius, config.nearest / 2):
        line = f"{arm.name} reaches from {near:.2f} to {far:.2f} m in front of it at a height of {height:.2f} m"
        advice = "another env.fist_length, or a smaller object, fist, env.area or env.nearest"
        raise OptionError([f"env.robot: {line}, too little for this task; choose {advice}"])
    middle = (near + far) / 2
    return Area(float(middle), float(radius)), put(
        arm, np.append(frame.place_back(np.array([middle, 0.0])), height), arm.angles
    )


def find_longest_run(values: list) -> tuple[int, int]:
    """(first, after the last) of the longest run of true values; (0, 0) without any."""
    best, first = (0, 0), 0
    for i, value in enumerate([*values, False]):
        if not value:
            best, first = max(best, (first, i), key=lambda run: run[1] - run[0]), i + 1
    return best


def add_object(spec: mujoco.MjSpec, config: PushConfig) -> None:
    """Adds the table and the object, and removes the robot's keyframes."""
    import mujoco

    for key in list(spec.keys):
        spec.delete(key)
    shape, half = mujoco.mjtGeom, config.object_height / 2
    spec.worldbody.add_geom(name=TABLE, type=shape.mjGEOM_PLANE, size=[1, 1, 0.1], contype=1, conaffinity=0, condim=1)
    body = spec.worldbody.add_body(name=OBJECT, pos=[0, 0, half])
    body.add_freejoint(name=OBJECT)
    kind = shape.mjGEOM_CYLINDER if config.object == "puck" else shape.mjGEOM_BOX
    radius = config.object_radius
    size = [radius, half, 0] if config.object == "puck" else [radius, radius, half]
    body.add_geom(
        name=OBJECT,
        type=kind,
        size=size,
        mass=config.object_mass,
        friction=[config.object_friction, 0.005, 0.0001],
        priority=1,  # its friction counts
        contype=0,
        conaffinity=3,
    )


# --- the action -------------------------------------------------------------------------------------------------------


def make_command(
    control: Control, frame: Frame, height: float, middle: np.ndarray, config: PushConfig
) -> Callable[[jax.Array, jax.Array, jax.Array | None], Command]:
    """`command(action [2], qpos [nq], target) -> Command`: the velocity of the fist at its height; see the module.

    Args:
      control: of the robot alone, by velocities.
      frame: the robot's.
      height: of the fist [m].
      middle: positions of the joints that free motions go to `[n]`.
      config: the task's options.
    """
    arm, speeds = control.arm, control.speeds
    places, dofs = arm.qpos_of, arm.dof_of
    low, high = arm.ranges
    look = compile_forward(arm.model, outputs=(f"site_xpos[{FIST}]", f"site_jacp[{FIST}]"))

    def find_velocity(position, jacobian, action, qpos):
        over = config.speed * (action @ frame.axes)
        wanted = jnp.concatenate([over, GAIN * (height - position[2:])])
        jacobian, angles = jacobian[:, dofs], qpos[places]
        posture = POSTURE * (middle - angles)
        velocity = posture + damped_least_squares(jacobian, wanted - jacobian @ posture, DAMPING)
        return limit_velocities(velocity, angles, low, high, speeds, config.dt)

    nv, nq = arm.model.nv, arm.model.nq
    scalar = scalarize(find_velocity, *(jnp.zeros(shape) for shape in (3, (3, nv), 2, nq)))

    def command(action, qpos, target):
        return control.command(scalar(*look(qpos), action, qpos) / control.limits, qpos, target)

    return command
