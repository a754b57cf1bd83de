"""Robots on two driven wheels with a common axle: what is read from a model, what an action commands, how to park.

With the wheels' radius r, their distance b (the track) and their speeds w_left, w_right, without slip

    v = r (w_right + w_left) / 2          w = r (w_right - w_left) / b

are the speed of the middle of the axle, forwards, and that of turning. The robot's frame has its origin there, x
forwards, y to the left and z upwards as the robot stands at rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.options import OptionError
from envs.physics import change_collision, compile_model
from envs.physics.models import model_name
from envs.physics.pairs import colliding_pairs
from envs.robots.drives import Drive, check_torque, make_writer, read_drive

if TYPE_CHECKING:
    import mujoco

WHEEL_CONTROLS = ("velocity", "torque")
TIME_CONSTANT = 0.03  # of the velocity servos that motors become [s]
SPEED = 0.5  # of a robot whose servos have no largest speed [m/s]
SETTLING = 2.0  # how long a robot stands before its pose is that at rest [s]
PARALLEL = 0.99  # cosine from which on two directions are the same
SLOPE = 0.1  # of an axle that still counts as horizontal
LEAN = 0.2  # of a robot that does not stand [rad]
FLOOR = "floor of drive"  # of the plane that is added where a model has none


@dataclass(frozen=True)
class Wheel:
    """A driven wheel.

    Attributes:
      name: its joint's.
      body: its body's number.
      qpos, dof: its places in qpos and qvel.
      radius: [m].
      sign: 1 if the robot rolls forwards when the joint turns positively, else -1.
      drive: its actuator.
    """

    name: str
    body: int
    qpos: int
    dof: int
    radius: float
    sign: float
    drive: Drive


@dataclass(frozen=True)
class WheeledRobot:
    """What is read from the model of a robot on two driven wheels.

    Attributes:
      name: the model's.
      model: the compiled model.
      wheels: (left, right).
      track: distance of the wheels [m].
      base: places of the base's free joint in qpos and qvel.
      axle: the middle of the axle in the base's frame `[3]` [m].
      frame: the robot's axes, forwards, left and up, as rows in the base's frame `[3, 3]`.
      qpos, act, ctrl: at rest, with the middle of the axle over the origin and forwards along x.
      others: its hinges and slides that are no wheels, such as those of casters, by number.
      guesses: one phrase for each thing that the model does not say.
    """

    name: str
    model: mujoco.MjModel
    wheels: tuple[Wheel, Wheel]
    track: float
    base: tuple[int, int]
    axle: np.ndarray
    frame: np.ndarray
    qpos: np.ndarray
    act: np.ndarray
    ctrl: np.ndarray
    others: tuple[int, ...]
    guesses: tuple[str, ...]

    @property
    def radius(self) -> float:
        """Of the wheels, on average [m]."""
        return (self.wheels[0].radius + self.wheels[1].radius) / 2


class WheelControl(NamedTuple):
    """How actions command the wheels.

    Attributes:
      robot: the robot, whose actuators fit.
      names: name and unit of each commanded number.
      limits: the commands at action 1, forwards `[2]`.
      command: `command(action [2]) -> ctrl [nu]`.
    """

    robot: WheeledRobot
    names: tuple[str, ...]
    limits: np.ndarray
    command: Callable[[jax.Array], jax.Array]


# --- equations --------------------------------------------------------------------------------------------------------


def find_twist(wheels: jax.Array, radius: float, track: float) -> tuple[jax.Array, jax.Array]:
    """(v, w) [m/s, rad/s] of the wheels' speeds (left, right) `[2]` [rad/s]; see the module.

    >>> v, w = find_twist(jnp.array([1.0, 3.0]), radius=0.1, track=0.4)
    >>> round(float(v), 6), round(float(w), 6)
    (0.2, 0.5)
    """
    left, right = wheels
    return radius * (right + left) / 2, radius * (right - left) / track


def find_wheel_speeds(forward: jax.Array, turn: jax.Array, radius: float, track: float) -> jax.Array:
    """The wheels' speeds (left, right) `[2]` [rad/s] of (v, w) [m/s, rad/s]: the inverse of `find_twist`."""
    return jnp.stack([forward - turn * track / 2, forward + turn * track / 2]) / radius


def limit_speeds(wheels: jax.Array, limits: jax.Array) -> jax.Array:
    """The wheels' speeds `[2]`, both shrunk by one factor until none is over its limit, which keeps the curve.

    >>> limit_speeds(jnp.array([1.0, 4.0]), jnp.array([2.0, 2.0])).tolist()
    [0.5, 2.0]
    """
    return wheels / jnp.maximum(1.0, jnp.max(jnp.abs(wheels) / limits))


def wrap(angle: jax.Array) -> jax.Array:
    """The same direction in [-pi, pi) [rad]."""
    return jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi


def steer_to_pose(
    error: jax.Array, angle: jax.Array, gains: tuple[float, float, float] = (3.0, 8.0, -1.5), near: float = 0.01
) -> tuple[jax.Array, jax.Array]:
    """The textbook's (v, w) [m/s, rad/s] that drive to a pose, forwards or backwards.

        v = k_rho rho           w = k_alpha alpha + k_beta beta

    where rho is the distance of the goal, alpha its bearing and beta = angle - alpha what is left to turn when it is
    reached straight on. With exact v and w, the pose is exponentially stable in a neighbourhood if

        k_rho > 0,      k_beta < 0,      k_alpha > k_rho,

    and the robot never changes between forwards and backwards if also k_alpha + 5/3 k_beta - 2/pi k_rho > 0. A goal
    behind the robot (|alpha| > pi/2) is approached backwards: v is negative, and alpha is the bearing from its rear.

    The law has no limit at rho = 0, where a bearing means nothing: within `near` the robot only turns, with
    w = k_alpha angle.

    Args:
      error: the goal's place in the robot's frame `[2]` [m].
      angle: the goal's heading from the robot's [rad].
      gains: (k_rho, k_alpha, k_beta) [1/s]; the default are those of the book.
      near: [m].

    Source: Astolfi, "Exponential stabilization of a wheeled mobile robot via discontinuous control" (1999); Siegwart,
    Nourbakhsh and Scaramuzza, "Introduction to Autonomous Mobile Robots", 2nd edition, section 3.6.2.
    """
    along, aim, align = gains
    direction = jnp.where(error[0] < 0, -1.0, 1.0)
    bearing = jnp.arctan2(direction * error[1], direction * error[0])
    distance = jnp.sqrt(jnp.sum(error**2))
    turn = aim * bearing + align * wrap(angle - bearing)
    is_far = distance > near
    return jnp.where(is_far, direction * along * distance, 0.0), jnp.where(is_far, turn, aim * angle)


# --- commands ---------------------------------------------------------------------------------------------------------


def make_wheel_control(
    spec: mujoco.MjSpec, control: str, torque: float, speed: float | None, collision: str
) -> WheelControl:
    """The control of the wheels in a specification, whose actuators are changed if they do not fit.

    Motors become velocity servos for `control="velocity"`, velocity servos motors for "torque"; both keep their torque
    limits. The gain of a new servo is the wheel's rolling inertia divided by `TIME_CONSTANT`.

    Args:
      spec: the robot's specification, with names (`load_robot`).
      control: "velocity" or "torque".
      torque: share of the torque limits that an action commands.
      speed: largest speed of the wheels [rad/s]; None takes that of the servos, or of `SPEED`.
      collision: which geoms collide (`envs.physics.compile_step`).

    Raises:
      OptionError: the robot has no two driven wheels (`read_wheels`), or no torque limits where they are needed.
    """
    robot = read_wheels(spec, collision)
    kind = {"velocity": "velocity", "torque": "motor"}[control]
    wrong = [wheel for wheel in robot.wheels if wheel.drive.kind != kind]
    for wheel in wrong:
        _change_actuator(spec, robot, wheel, control)
    if wrong:
        robot = replace(read_wheels(spec, collision), guesses=robot.guesses)
    if control == "torque":
        limits = torque * np.array([_find_torque(wheel) for wheel in robot.wheels])
    else:
        limits = np.array([_find_speed(wheel, speed) for wheel in robot.wheels])
    unit = {"velocity": "rad/s", "torque": "N m"}[control]
    names = tuple(f"{side} wheel's {control} [{unit}]" for side in ("left", "right"))
    return WheelControl(robot, names, limits, _make_command(robot, limits))


def _make_command(robot: WheeledRobot, limits: np.ndarray) -> Callable[[jax.Array], jax.Array]:
    """Turns actions `[2]` into the controls of all actuators `[nu]`; those of no wheel keep theirs."""
    scale = limits * np.array([wheel.sign for wheel in robot.wheels])
    write = make_writer([wheel.drive for wheel in robot.wheels], robot.ctrl)
    return lambda action: write(jnp.asarray(scale) * action)


def _change_actuator(spec, robot: WheeledRobot, wheel: Wheel, control: str) -> None:
    """Makes a servo of a motor, or a motor of a servo."""
    actuator = spec.actuator(robot.model.actuator(wheel.drive.actuator).name)
    gear, torque = abs(wheel.drive.gear), _find_torque(wheel)
    if control == "torque":
        actuator.set_to_motor()
        actuator.ctrlrange = [-torque / gear, torque / gear]
    else:
        actuator.set_to_velocity(kv=find_rolling_inertia(robot)[robot.wheels.index(wheel)] / TIME_CONSTANT / gear**2)
        actuator.ctrllimited = False
    actuator.forcelimited, actuator.forcerange = True, [-torque / gear, torque / gear]


def find_rolling_inertia(robot: WheeledRobot) -> np.ndarray:
    """M_ii + m r^2 / 2 of the wheels `[2]` [kg m^2], with the robot's mass m: what torques that drive it feel."""
    model = robot.model
    mass = model.body_mass[model.body_rootid == model.body_rootid[robot.wheels[0].body]].sum()
    return np.array([model.dof_M0[wheel.dof] + mass * wheel.radius**2 / 2 for wheel in robot.wheels])


def _find_torque(wheel: Wheel) -> float:
    advice = 'give its actuator a range, such as forcerange="-1 1"'
    low, high = check_torque(wheel.drive, f"wheel '{wheel.name}'", advice)
    return min(-low, high)


def _find_speed(wheel: Wheel, speed: float | None) -> float:
    """The wanted speed, or that of `SPEED`, and no more than the servo takes; without a wanted one the servo's."""
    low, high = wheel.drive.quantity_range()
    servo = min(-low, high)
    if speed is not None:
        return min(speed, servo)
    return servo if np.isfinite(servo) else SPEED / wheel.radius


# --- models -----------------------------------------------------------------------------------------------------------


def read_wheels(spec: mujoco.MjSpec, collision: str = "primitives") -> WheeledRobot:
    """Finds the two driven wheels in a specification, to which a floor is added if it has none.

    The wheels are the hinges without limits that have a motor or a velocity servo. Forwards is across the axle, on the
    side of the base's x axis; left and right follow from this.

    Args:
      spec: the robot's specification, with names (`load_robot`).
      collision: which geoms collide (`envs.physics.compile_step`).

    Raises:
      OptionError: there are no two such wheels on one axle, the base is not free, or the robot does not stand.
      MujocoModelError: the specification cannot be compiled.
    """
    guesses: list[str] = []
    model = compile_model(spec)
    joints = _find_wheel_joints(model)
    base = _find_base(model, joints)
    if not _find_floor(model):
        _add_floor(spec)
        guesses.append("it gets a floor, as it has none")
        model = compile_model(spec)
    model = change_collision(model, collision)
    radii = [_find_radius(model, joint) for joint in joints]
    data = _stand(model, base, joints, radii)
    return _describe(model, data, base, joints, radii, guesses)


def _add_floor(spec) -> None:
    """Adds a plane without friction: contacts have the larger friction of both geoms, here always the robot's."""
    import mujoco

    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(
        name=FLOOR, type=plane, size=[0, 0, 1], condim=1, friction=[0, 0, 0], contype=1, conaffinity=1
    )


def _find_wheel_joints(model) -> list[int]:
    """The two hinges without limits that have a motor or a velocity servo."""
    import mujoco

    hinges = [i for i in range(model.njnt) if model.jnt_type[i] == int(mujoco.mjtJoint.mjJNT_HINGE)]
    drives = {i: read_drive(model, i) for i in hinges if not model.jnt_limited[i]}
    found = [i for i, drive in drives.items() if drive and drive.kind in ("motor", "velocity")]
    if len(found) != 2:
        names = ", ".join(model.joint(i).name for i in found) or "none"
        line = "expected two driven wheels, which are hinges without limits that have a motor or a velocity servo"
        raise OptionError([f"env.robot: {line}; found {names}"])
    return found


def _find_base(model, joints: list[int]) -> int:
    """The free joint of the body that carries both wheels."""
    import mujoco

    roots = [int(model.body_rootid[model.jnt_bodyid[joint]]) for joint in joints]
    first = int(model.body_jntadr[roots[0]])
    free = first >= 0 and model.jnt_type[first] == int(mujoco.mjtJoint.mjJNT_FREE)
    if roots[0] != roots[1] or not free:
        name = model.body(roots[0]).name
        line = f"body '{name}' does not carry both wheels and move freely"
        raise OptionError([f"env.robot: {line}; env=drive needs a base with <freejoint/> that stands on the floor"])
    parents = [int(model.body_parentid[model.jnt_bodyid[joint]]) for joint in joints]
    if any(model.body_weldid[parent] != roots[0] for parent in parents):
        raise OptionError(["env.robot: the wheels are not fixed to the base but to a part that moves"])
    return first


def _find_floor(model) -> list[int]:
    """The planes and height fields of the world that collide."""
    import mujoco

    kinds = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    is_floor = collides & (model.body_weldid[model.geom_bodyid] == 0) & np.isin(model.geom_type, kinds)
    return np.flatnonzero(is_floor).tolist()


def _find_radius(model, joint: int) -> float:
    """Half the extent across the axis of what a wheel touches the floor with [m]."""
    body, floor = int(model.jnt_bodyid[joint]), _find_floor(model)
    pairs = [{pair.geom1, pair.geom2} for pair in colliding_pairs(model)]
    geoms = [i for pair in pairs for i in pair if model.geom_bodyid[i] == body and pair & set(floor)]
    if not geoms:
        line = f"wheel '{model.joint(joint).name}' has no geom that collides with the floor"
        raise OptionError([f"env.robot: {line}; a wheel that is a mesh needs env.collision=hull"])
    return max(_find_extent(model, geom, model.jnt_axis[joint]) for geom in geoms)


def _find_extent(model, geom: int, axis: np.ndarray) -> float:
    """Half the extent of a geom's box across the axis of its body, which is one of the box's own [m]."""
    import mujoco

    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    along = int(np.abs(rotation.reshape(3, 3).T @ axis).argmax())
    return float(np.delete(model.geom_aabb[geom, 3:], along).max())


def _stand(model, base: int, joints: list[int], radii: list[float]):
    """C MuJoCo's data after the robot has stood on its wheels for `SETTLING`.

    Raises:
      OptionError: it has leant over or moved away.
    """
    import mujoco

    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    elif model.nu:
        data.ctrl[:] = np.where(model.actuator_ctrllimited.astype(bool), model.actuator_ctrlrange.mean(1), 0.0)
    for joint in joints:
        drive = read_drive(model, joint)
        assert drive is not None
        data.ctrl[drive.actuator] = drive.control_of(0.0)
    mujoco.mj_kinematics(model, data)
    place, body = model.jnt_qposadr[base], model.jnt_bodyid[base]
    height = min(data.xanchor[joint, 2] - radius for joint, radius in zip(joints, radii, strict=True))
    data.qpos[place + 2] -= height - data.geom_xpos[_find_floor(model)[0], 2]
    mujoco.mj_kinematics(model, data)
    before, up = data.xpos[body].copy(), data.xmat[body].reshape(3, 3)[:, 2].copy()
    for _ in range(round(SETTLING / model.opt.timestep)):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    is_upright = data.xmat[body].reshape(3, 3)[:, 2] @ up > np.cos(LEAN)
    if not (is_upright and np.linalg.norm(data.xpos[body] - before) < max(radii)):
        line = "the robot does not stand still on its wheels without commands"
        raise OptionError([f"env.robot: {line}; it needs a caster, or a keyframe in which it stands"])
    return data


def _describe(model, data, base: int, joints: list[int], radii: list[float], guesses: list[str]) -> WheeledRobot:
    """The robot whose pose at rest is that of the data."""
    import mujoco

    body = int(model.jnt_bodyid[base])
    rotation, place = data.xmat[body].reshape(3, 3), data.xpos[body]
    up = np.array([0.0, 0.0, 1.0])
    forward = _find_forward(model, data, joints, rotation[:, 0], guesses)
    left = np.cross(up, forward)
    first, second = (_read_wheel(model, data, *wheel, forward) for wheel in zip(joints, radii, strict=True))
    is_first_left = left @ np.subtract(*data.xanchor[joints]) > 0
    middle = data.xanchor[joints].mean(0)
    frame = np.stack([forward, left, up])
    qpos, free = data.qpos.copy(), int(model.jnt_qposadr[base])
    qpos[free : free + 2] = (frame @ (place - middle))[:2]
    mujoco.mju_mat2Quat(qpos[free + 3 : free + 7], (frame @ rotation).ravel())
    simple = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    own = [i for i in range(model.njnt) if model.body_rootid[model.jnt_bodyid[i]] == body]
    others = [i for i in own if model.jnt_type[i] in simple and i not in joints]
    return WheeledRobot(
        model_name(model),
        model,
        (first, second) if is_first_left else (second, first),
        float(np.linalg.norm(np.subtract(*data.xanchor[joints]))),
        (free, int(model.jnt_dofadr[base])),
        rotation.T @ (middle - place),
        frame @ rotation,
        qpos,
        data.act.copy(),
        data.ctrl.copy(),
        tuple(others),
        tuple(guesses),
    )


def _find_forward(model, data, joints: list[int], ahead: np.ndarray, guesses: list[str]) -> np.ndarray:
    """The horizontal direction across the axle `[3]`, on the side of the base's x axis.

    Raises:
      OptionError: the wheels do not turn about one horizontal axle.
    """
    axes = data.xaxis[joints]
    across = np.subtract(*data.xanchor[joints])
    along = np.abs(axes @ across) / max(float(np.linalg.norm(across)), 1e-9)
    if along.min() < PARALLEL or abs(across[2]) > SLOPE * np.linalg.norm(across):
        names = " and ".join(f"'{model.joint(joint).name}'" for joint in joints)
        raise OptionError([f"env.robot: the wheels {names} do not turn about one horizontal axle"])
    forward = np.cross(axes[0], [0.0, 0.0, 1.0])
    forward /= np.linalg.norm(forward)
    side = forward @ ahead
    if abs(side) < 0.5:
        guesses.append("forwards is where it rolls when its first wheel turns positively, as its x axis is no help")
    return -forward if side < -0.5 else forward


def _read_wheel(model, data, joint: int, radius: float, forward: np.ndarray) -> Wheel:
    drive = read_drive(model, joint)
    assert drive is not None
    sign = float(np.sign(np.cross(data.xaxis[joint], [0.0, 0.0, 1.0]) @ forward))
    places = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    return Wheel(model.joint(joint).name, int(model.jnt_bodyid[joint]), *places, radius, sign, drive)
