"""Robots: where their models come from, and what can be read from them."""

from envs.robots.arms import Arm, ArmJoint, read_arm
from envs.robots.controls import CONTROLS, Control, make_control
from envs.robots.sources import SHIPPED_ROBOTS, load_robot
from envs.robots.wheels import WHEEL_CONTROLS, WheelControl, WheeledRobot, make_wheel_control, read_wheels

__all__ = [
    "CONTROLS",
    "SHIPPED_ROBOTS",
    "WHEEL_CONTROLS",
    "Arm",
    "ArmJoint",
    "Control",
    "WheelControl",
    "WheeledRobot",
    "load_robot",
    "make_control",
    "make_wheel_control",
    "read_arm",
    "read_wheels",
]
