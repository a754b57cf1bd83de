"""What an actuator does to its joint: a motor, a position servo or a velocity servo.

MuJoCo's actuators have one form: with the control c, the length l = gear q and its velocity, the force is

    f = g c + b0 + b1 l + b2 l'        (clipped to the force range),        and the joint's torque is gear f

A motor has b1 = b2 = 0. A position servo has b1 < 0: it rests where g c + b0 = -b1 l. A velocity servo has b1 = 0 and
b2 < 0: against the joint's damping d it keeps the speed q' at which g c + b0 = -b2 l' + d q' / gear. An actuator that
integrates its control (`intvelocity`) keeps a speed as well, which is the control itself.

Source: MuJoCo's documentation, "Computation: actuation model".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.options import OptionError

if TYPE_CHECKING:
    import mujoco

KINDS = ("motor", "position", "velocity")
MOTOR_ADVICE = 'give its motor a range, such as ctrlrange="-10 10"'
NAMES = {"motor": "motors", "position": "position servos", "velocity": "velocity servos"}


@dataclass(frozen=True)
class Drive:
    """One actuator of one joint.

    Attributes:
      actuator: its number in the model.
      kind: of `KINDS`; "other" if it is none of them, such as a muscle.
      gear: gear ratio; torque = gear f.
      gain, bias: g and (b0, b1, b2); of an integrating actuator 1 and (0, 0, -1), for which c is the speed.
      damping: d, of the joint [N m s/rad]; 0 if it integrates.
      torque: (lowest, highest) torque of the joint [N m or N]; infinite if nothing limits it.
      control: (lowest, highest) control; infinite if nothing limits it.
      integral: where its activation is, if it integrates its control to the length that it keeps; else None.
    """

    actuator: int
    kind: str
    gear: float
    gain: float
    bias: tuple[float, float, float]
    damping: float
    torque: tuple[float, float]
    control: tuple[float, float]
    integral: int | None

    def control_of(self, quantity):
        """The control c that asks for a torque [N m], an angle [rad] or a speed [rad/s], whichever the kind is.

        motor  c = (tau / gear - b0) / g    position  c = (-b1 gear q - b0) / g    velocity  c = (-b2 gear q' - b0) / g
        """
        constant, stiffness, damping = self.bias
        scale = {
            "motor": 1 / self.gear,
            "position": -stiffness * self.gear,
            "velocity": -damping * self.gear + self.damping / self.gear,
        }
        return (scale[self.kind] * quantity - constant) / self.gain

    def quantity_range(self) -> tuple[float, float]:
        """The (lowest, highest) torque, angle or speed that controls within their range ask for."""
        slope, offset = self.control_of(1.0) - self.control_of(0.0), self.control_of(0.0)
        ends = sorted((limit - offset) / slope for limit in self.control)
        return ends[0], ends[1]


def read_drive(model: mujoco.MjModel, joint: int) -> Drive | None:
    """The actuator that drives a hinge or slide joint alone, read from the compiled model; None if there is none.

    Free joints and ball joints are driven by none.
    """
    import mujoco

    if model.jnt_type[joint] not in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)):
        return None
    kinds = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    drives = [
        _read(model, actuator, joint)
        for actuator in range(model.nu)
        if model.actuator_trntype[actuator] in kinds and model.actuator_trnid[actuator, 0] == joint
    ]
    known = [drive for drive in drives if drive.kind in KINDS]
    return next(iter(known or drives), None)


def check_torque(drive: Drive, what: str, advice: str) -> tuple[float, float]:
    """The (lowest, highest) torque; raises OptionError if it is not limited on both sides of 0.

    Args:
      drive: of the joint.
      what: the joint, such as "joint 'elbow'".
      advice: what would be right.
    """
    low, high = drive.torque
    if not low < 0 < high or not np.isfinite(low + high):
        line = f"the torque of {what} is not limited on both sides ({low:g} to {high:g})"
        raise OptionError([f"env.robot: {line}; {advice}"])
    return low, high


def make_writer(drives: Sequence[Drive], rest: np.ndarray) -> Callable[[jax.Array], jax.Array]:
    """Turns torques, angles or speeds `[n]`, whichever each drive is for, into the controls of all actuators `[nu]`.

    Args:
      drives: of the joints that are commanded.
      rest: the controls `[nu]` that other actuators keep.
    """
    offset = np.array([drive.control_of(0.0) for drive in drives])
    scale = np.array([drive.control_of(1.0) for drive in drives]) - offset
    numbers, kept = np.array([drive.actuator for drive in drives]), jnp.asarray(rest, float)

    def write(quantity):
        return kept.at[numbers].set(scale * quantity + offset)

    return write


def change_servo(actuator: Any, drive: Drive, stiffness: float, damping: float) -> None:
    """Makes a servo of an actuator: for positions, or with a stiffness of 0 for velocities. It keeps its torque limits.

    Args:
      actuator: of the specification.
      drive: what it is in the compiled model.
      stiffness, damping: of the joint [N m/rad, N m s/rad].
    """
    if stiffness:
        actuator.set_to_position(kp=stiffness / drive.gear**2, kv=damping / drive.gear**2)
    else:
        actuator.set_to_velocity(kv=damping / drive.gear**2)
    actuator.ctrllimited = False
    force = np.sort(np.array(drive.torque) / drive.gear)
    if np.isfinite(force).all():
        actuator.forcelimited, actuator.forcerange = True, force


def _read(model: mujoco.MjModel, actuator: int, joint: int) -> Drive:
    import mujoco

    gear = float(model.actuator_gear[actuator, 0])
    kind, gain, bias = _classify(model, actuator)
    control = _limits(model.actuator_ctrllimited[actuator], model.actuator_ctrlrange[actuator])
    is_integral = model.actuator_dyntype[actuator] == int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
    integral = int(model.actuator_actadr[actuator]) if is_integral else None
    damping = 0.0 if is_integral else float(model.dof_damping[model.jnt_dofadr[joint]])
    drive = Drive(actuator, kind, gear, gain, bias, damping, (-np.inf, np.inf), control, integral)
    forces = _limits(model.actuator_forcelimited[actuator], model.actuator_forcerange[actuator])
    ranges = [sorted(gear * limit for limit in forces)]
    ranges += [_limits(model.jnt_actfrclimited[joint], model.jnt_actfrcrange[joint])]
    ranges += [drive.quantity_range()] if kind == "motor" else []
    torque = max(low for low, _ in ranges), min(high for _, high in ranges)
    return replace(drive, torque=torque)


def _limits(limited, values) -> tuple[float, float]:
    return (float(values[0]), float(values[1])) if limited else (-np.inf, np.inf)


def _classify(model: mujoco.MjModel, actuator: int) -> tuple[str, float, tuple[float, float, float]]:
    """The kind of an actuator, with its g and (b0, b1, b2)."""
    import mujoco

    dynamics, gains, biases = mujoco.mjtDyn, mujoco.mjtGain, mujoco.mjtBias
    gain = float(model.actuator_gainprm[actuator, 0])
    bias = (0.0, 0.0, 0.0)
    if model.actuator_biastype[actuator] == int(biases.mjBIAS_AFFINE):
        bias = tuple(model.actuator_biasprm[actuator, :3].tolist())
    kind = model.actuator_dyntype[actuator]
    fixed = model.actuator_gaintype[actuator] == int(gains.mjGAIN_FIXED)
    linear = model.actuator_biastype[actuator] in (int(biases.mjBIAS_NONE), int(biases.mjBIAS_AFFINE))
    if not (fixed and linear and gain and model.actuator_gear[actuator, 0]):
        return "other", gain, bias
    if kind == int(dynamics.mjDYN_INTEGRATOR) and bias[1] < 0:
        return "velocity", 1.0, (0.0, 0.0, -1.0)
    if kind not in (int(dynamics.mjDYN_NONE), int(dynamics.mjDYN_FILTER), int(dynamics.mjDYN_FILTEREXACT)):
        return "other", gain, bias
    if bias[1] < 0:
        return "position", gain, bias
    if bias[1] == 0 and bias[2] < 0:
        return "velocity", gain, bias
    return ("motor" if bias[1] == bias[2] == 0 else "other"), gain, bias
