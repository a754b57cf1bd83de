"""What an action commands of an arm: torques, velocities, positions, or the twist of its end effector.

Each way needs another kind of actuator:

    control     motors                           position servos                 velocity servos
    torque      the torque                       -                               -
    velocity    become velocity servos           the set-point moves with it     the velocity
    position    become position servos           the set-point                   a velocity towards it
    twist       as velocity, by damped least squares of the end effector's Jacobian

A command of a position is a step from the measured position, q* = q + step a, within the joint's range. Set-points that
move stay within that range too. Motors that become servos get gains from the arm's inertia at rest: with the effective
inertia I_i = 1 / (M^-1)_ii,

    velocity    kv = I / TIME_CONSTANT
    position    kp = I FREQUENCY^2,  kv = 2 I FREQUENCY        (critically damped)

and keep their torque limits. Gravity is compensated for motors, as robots with torque control do it themselves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.options import OptionError
from envs.physics import compile_forward, scalarize
from envs.robots.arms import Arm, ArmJoint, read_arm
from envs.robots.drives import MOTOR_ADVICE, NAMES, change_servo, check_torque, make_writer
from envs.robots.twists import damped_least_squares, limit_velocities

if TYPE_CHECKING:
    import mujoco

CONTROLS = ("torque", "velocity", "position", "twist")
TIME_CONSTANT = 0.03  # of the velocity servos that motors become [s]
FREQUENCY = 20.0  # of the position servos that motors become [rad/s]
APPROACH = 10.0  # velocity towards a position, of velocity servos [1/s]
VELOCITY_LIMIT = "velocity_limit"  # name of the <custom><numeric> with the joints' largest speeds
SPEED = 2.0  # largest speed where nothing else is known [rad/s or m/s]
TWIST = (0.5, 0.5, 0.5, 1.5, 1.5, 1.5)  # largest twist [m/s, rad/s]
TWIST_NAMES = ("velocity x", "velocity y", "velocity z", "turn x", "turn y", "turn z")


class Command(NamedTuple):
    """What the arm's actuators get.

    Attributes:
      ctrl: controls of all actuators `[nu]`.
      target: the set-points `[n]` that the next command starts from; None if there are none.
    """

    ctrl: jax.Array
    target: jax.Array | None


@dataclass(frozen=True)
class Control:
    """How actions command an arm.

    Attributes:
      arm: the arm, whose actuators fit.
      names: name and unit of each commanded number.
      limits: the commands at action 1 [m].
      speeds: largest speeds of the joints [n].
      has_target: set-points are part of the state.
      command: `command(action [m], qpos [nq], target) -> Command`; `target` are the set-points [n] or None.
    """

    arm: Arm
    names: tuple[str, ...]
    limits: np.ndarray
    speeds: np.ndarray
    has_target: bool
    command: Callable[[jax.Array, jax.Array, jax.Array | None], Command]

    def start(self, angles: jax.Array) -> jax.Array:
        """Activations `[na]` at joint positions `[n]`: those at rest, and the integrals at their positions."""
        act = jnp.asarray(self.arm.act, angles.dtype)
        for joint, angle in zip(self.arm.joints, angles, strict=True):
            if joint.drive.integral is not None:
                act = act.at[joint.drive.integral].set(joint.drive.gear * angle)
        return act


class ControlOptions(NamedTuple):
    """What `make_control` is told.

    Attributes:
      control: of `CONTROLS`.
      torque: share of the torque limits.
      speed: largest joint speed [rad/s or m/s]; None takes the model's `velocity_limit`, or 2.
      step: largest step of a position [rad or m].
      dt: seconds between two commands.
    """

    control: str
    torque: float
    speed: float | None
    step: float
    dt: float


def make_control(spec: mujoco.MjSpec, site: str, options: ControlOptions) -> Control:
    """The control of the arm in a specification, whose actuators are changed if they do not fit.

    Raises:
      OptionError: there is no arm (`read_arm`), or its actuators cannot do it.
    """
    arm = read_arm(spec, site)
    kinds = {joint.drive.kind for joint in arm.joints}
    if options.control == "torque" and kinds != {"motor"}:
        wrong = next(joint for joint in arm.joints if joint.drive.kind != "motor")
        line = f"the actuators of {arm.name} are {NAMES[wrong.drive.kind]} (joint '{wrong.name}')"
        raise OptionError([f"env.control=torque: {line}; command them by env.control=velocity, position or twist"])
    if "motor" in kinds:
        arm = _change_motors(spec, arm, options.control)
    makers = {
        "torque": _command_torque,
        "velocity": _command_velocity,
        "position": _command_position,
        "twist": _command_twist,
    }
    return makers[options.control](arm, options)


# --- actuators --------------------------------------------------------------------------------------------------------


def _change_motors(spec, arm: Arm, control: str) -> Arm:
    """Compensates gravity, and makes servos of the motors unless torques are commanded."""
    for body in spec.bodies[1:]:
        body.gravcomp = 1.0
    if control != "torque":
        inertia = find_effective_inertia(arm)
        for i, joint in enumerate(arm.joints):
            if joint.drive.kind == "motor":
                _check_torque(joint)
                actuator = spec.actuator(arm.model.actuator(joint.drive.actuator).name)
                change_servo(actuator, joint.drive, *_find_gains(control, inertia[i]))
    changed = read_arm(spec, arm.site)
    return replace(changed, guesses=arm.guesses)


def find_effective_inertia(arm: Arm) -> np.ndarray:
    """1 / (M^-1)_ii of the joints at rest [n]: what a torque on one joint feels while the others are free."""
    import mujoco

    model, data = arm.model, mujoco.MjData(arm.model)
    data.qpos[:] = arm.qpos
    mujoco.mj_forward(model, data)
    inverse = np.empty((model.nv, model.nv))
    mujoco.mj_solveM(model, data, inverse, np.eye(model.nv))
    return np.array([1 / inverse[joint.dof, joint.dof] for joint in arm.joints])


def _find_gains(control: str, inertia: float) -> tuple[float, float]:
    """(kp, kv) of the servo that a motor becomes; see the module."""
    if control == "position":
        return inertia * FREQUENCY**2, 2 * inertia * FREQUENCY
    return 0.0, inertia / TIME_CONSTANT


def _check_torque(joint: ArmJoint) -> tuple[float, float]:
    return check_torque(joint.drive, f"joint '{joint.name}'", MOTOR_ADVICE)


def _find_speeds(arm: Arm, options: ControlOptions) -> np.ndarray:
    """Largest speeds of the joints [n]: the option's, the model's or `SPEED`, and no more than their servos take."""
    speeds = _find_wanted_speeds(arm, options.speed)
    for i, joint in enumerate(arm.joints):
        if joint.drive.kind == "velocity":
            low, high = joint.drive.quantity_range()
            speeds[i] = min(speeds[i], -low, high)
    return speeds


def _find_wanted_speeds(arm: Arm, speed: float | None) -> np.ndarray:
    """The option's speed, the model's numbers, or `SPEED`; `[n]`."""
    number, model = len(arm.joints), arm.model
    names = [model.numeric(i).name for i in range(model.nnumeric)]
    if speed is not None or VELOCITY_LIMIT not in names:
        return np.full(number, SPEED if speed is None else speed)
    values = np.array(model.numeric(VELOCITY_LIMIT).data, float)
    if len(values) != number or not (values > 0).all():
        line = f"<numeric name='{VELOCITY_LIMIT}'> has the numbers {' '.join(f'{x:g}' for x in values)}"
        raise OptionError([f"env.robot: {line}; expected {number} above 0, one for each joint of the arm"])
    return values


# --- commands ---------------------------------------------------------------------------------------------------------


def _command_torque(arm: Arm, options: ControlOptions) -> Control:
    """c of the torques tau = limit a."""
    limits = options.torque * np.array([min(-low, high) for low, high in map(_check_torque, arm.joints)])
    write = _make_writer(arm)

    def command(action, qpos, target):
        return Command(write(limits * action), None)

    names = tuple(f"{joint.name} {'force [N]' if joint.is_slide else 'torque [N m]'}" for joint in arm.joints)
    return Control(arm, names, limits, _find_speeds(arm, options), False, command)


def _command_velocity(arm: Arm, options: ControlOptions) -> Control:
    """c of the velocities v = limit a."""
    limits = _find_speeds(arm, options)
    follow = _make_follower(arm, options.dt)

    def command(action, qpos, target):
        return follow(limits * action, qpos, target)

    names = tuple(f"{joint.name} velocity [{joint.unit}/s]" for joint in arm.joints)
    return Control(arm, names, limits, limits, _has_servos(arm), command)


def _command_position(arm: Arm, options: ControlOptions) -> Control:
    """c of the positions q* = q + step a, within the ranges."""
    speeds = _find_speeds(arm, options)
    low, high = _find_target_ranges(arm)
    places = arm.qpos_of
    servo = np.array([joint.drive.kind == "position" for joint in arm.joints])
    write = _make_writer(arm)

    def command(action, qpos, target):
        measured = qpos[places]
        wanted = jnp.clip(measured + options.step * action, low, high)
        velocity = jnp.clip(APPROACH * (wanted - measured), -speeds, speeds)
        return Command(write(jnp.where(servo, wanted, velocity)), None)

    names = tuple(f"{joint.name} step [{joint.unit}]" for joint in arm.joints)
    return Control(arm, names, np.full(len(arm.joints), options.step), speeds, False, command)


def _command_twist(arm: Arm, options: ControlOptions) -> Control:
    """c of the velocities that give the end effector the twist V = limit a."""
    limits, speeds = np.array(TWIST), _find_speeds(arm, options)
    low, high = arm.ranges
    places, dofs = arm.qpos_of, arm.dof_of
    jacobians = compile_forward(arm.model, outputs=(f"site_jacp[{arm.site}]", f"site_jacr[{arm.site}]"))
    follow = _make_follower(arm, options.dt)

    def find_velocity(jacp, jacr, twist, qpos):
        velocity = damped_least_squares(jnp.concatenate([jacp, jacr])[:, dofs], twist)
        return limit_velocities(velocity, qpos[places], low, high, speeds, options.dt)

    nv, nq = arm.model.nv, arm.model.nq
    scalar = scalarize(find_velocity, *(jnp.zeros(shape) for shape in ((3, nv), (3, nv), 6, nq)))

    def command(action, qpos, target):
        return follow(scalar(*jacobians(qpos), limits * action, qpos), qpos, target)

    units = ("m/s",) * 3 + ("rad/s",) * 3
    names = tuple(f"{name} [{unit}]" for name, unit in zip(TWIST_NAMES, units, strict=True))
    return Control(arm, names, limits, speeds, _has_servos(arm), command)


def _has_servos(arm: Arm) -> bool:
    """Whether a velocity moves set-points, which are then part of the state."""
    return any(joint.drive.kind == "position" for joint in arm.joints)


def _make_follower(arm: Arm, dt: float) -> Callable[[Any, Any, Any], Command]:
    """Turns velocities into controls: those of velocity servos, or set-points q* += v dt within the ranges."""
    write, servo = _make_writer(arm), np.array([joint.drive.kind == "position" for joint in arm.joints])
    low, high = _find_target_ranges(arm)

    def follow(velocity, qpos, target):
        if target is None:
            return Command(write(velocity), None)
        target = jnp.clip(target + dt * velocity, low, high)
        return Command(write(jnp.where(servo, target, velocity)), target)

    return follow


def _find_target_ranges(arm: Arm) -> tuple[np.ndarray, np.ndarray]:
    """(lowest, highest) set-points [n]: within the joints' ranges and those of the servos' controls."""
    low, high = arm.ranges
    for i, joint in enumerate(arm.joints):
        if joint.drive.kind == "position":
            ends = joint.drive.quantity_range()
            low[i], high[i] = max(low[i], ends[0]), min(high[i], ends[1])
    return low, high


def _make_writer(arm: Arm) -> Callable[[jax.Array], jax.Array]:
    return make_writer([joint.drive for joint in arm.joints], arm.ctrl)
