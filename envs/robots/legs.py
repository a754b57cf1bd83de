"""Reads from a model what a task with a legged robot must know: its base, its legs, its feet, how it stands.

A legged robot is a body that moves freely and stands on its feet in a keyframe. Its feet are the bodies that touch the
ground there, and its legs the hinges and slides with an actuator between the base and the feet. Other joints keep their
controls of the keyframe.

Legs are moved by position servos, tau = kp (q* - q) - kv q'. Motors become such servos, with the stiffness of their
torque limit per radian and a damping of 20 ms of it, unless others are given.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import jax
import numpy as np

from envs.options import OptionError
from envs.physics import compile_model
from envs.physics.models import model_name
from envs.robots.arms import ArmJoint, Jointed, check_numbers, find_keyframe, find_path, make_joint
from envs.robots.drives import MOTOR_ADVICE, change_servo, check_torque, make_writer, read_drive

if TYPE_CHECKING:
    import mujoco

CONTACTS = ("feet", "all")
STIFFNESS = 1.0  # of the servos that motors become: shares of their torque limit for a radian
DAMPING = 0.02  # of the servos that motors become: shares of their stiffness [s]
STANDING = 0.03  # a body whose lowest point is as near to that of a robot that stands is a foot [m]
SOLE = 0.005  # geoms of a foot that are as near to its lowest point touch the ground [m]
KEYFRAME = """<keyframe><key name="home" qpos="..."/></keyframe>"""


class LegOptions(NamedTuple):
    """What `read_legs` is told.

    Attributes:
      stiffness, damping: kp [N m/rad] and kv [N m s/rad] of all servos; None keeps the model's.
      contacts: "feet": nothing but the feet touches anything; "all": as in the model.
    """

    stiffness: float | None = None
    damping: float | None = None
    contacts: str = "feet"


@dataclass(frozen=True)
class LeggedRobot(Jointed):
    """What is read from the model of a legged robot.

    Attributes:
      name: the model's.
      model: the compiled model, whose legs have position servos.
      base: its body that moves freely.
      base_qpos, base_dof: places of the base's free joint in qpos (7 numbers) and in qvel (6 numbers).
      joints: the legs' joints.
      feet: a site at each foot.
      foot_heights: heights of these sites [F] when the robot stands [m].
      floor: height of the ground [m].
      qpos, act, ctrl: the keyframe [nq], [na] and [nu], with the feet on the ground.
      set_points: what the servos of the joints are told there [n]: the keyframe's controls of servos, or its angles.
    """

    name: str
    model: mujoco.MjModel
    base: str
    base_qpos: int
    base_dof: int
    joints: tuple[ArmJoint, ...]
    feet: tuple[str, ...]
    foot_heights: np.ndarray
    floor: float
    qpos: np.ndarray
    act: np.ndarray
    ctrl: np.ndarray
    set_points: np.ndarray

    @property
    def height(self) -> float:
        """Height of the base over the ground when the robot stands [m]."""
        return float(self.qpos[self.base_qpos + 2]) - self.floor

    def find_controls(self, set_points: jax.Array) -> jax.Array:
        """Controls of all actuators `[nu]` for set-points of the joints `[n]`; other actuators keep the keyframe's."""
        return make_writer([joint.drive for joint in self.joints], self.ctrl)(set_points)


def read_legs(spec: mujoco.MjSpec, options: LegOptions = LegOptions()) -> LeggedRobot:
    """Finds the legs in a specification, which is changed: servos, sites at the feet, contacts, a floor if it has none.

    Raises:
      OptionError: the robot has no free base, keyframe, feet or legs, or its legs are not moved by servos or motors.
      MujocoModelError: the specification cannot be compiled.
    """
    model = compile_model(spec)
    check_numbers(model)
    key = _find_keyframe(model)
    base = _find_base(model)
    data = _place(model, key)
    feet = _find_feet(model, data, base)
    joints = _find_joints(model, feet)
    for joint in joints:
        _change_servo(spec, model, joint, options)
    if options.contacts == "feet":  # before anything is added, which changes the numbers of geoms
        _keep_contacts_of(spec, [geom for geoms in feet.values() for geom in geoms])
    floor = _find_floor(spec)
    for body, geoms in feet.items():
        spec.body(model.body(body).name).add_site(name=_name_site(model, body), pos=model.geom_pos[geoms].mean(0))
    robot = _describe(spec, model, base, list(feet), key, floor)
    has_servos = all(joint.drive.kind == "position" for joint in joints) and data.ctrl.any()
    return robot if has_servos else replace(robot, set_points=robot.qpos[robot.qpos_of])


def _describe(spec, before, base: int, feet: list[int], key: int, floor: float) -> LeggedRobot:
    """The robot of the changed specification, lifted so that its feet are on the ground."""
    lift = floor - _find_lowest_of_all(before, _place(before, key), base)
    model = compile_model(spec)
    joints = _find_joints(model, {body: [] for body in feet})
    free = int(model.body_jntadr[base])
    address = int(model.jnt_qposadr[free])
    data = _place(model, key, lift, address)
    sites = tuple(_name_site(before, body) for body in feet)
    return LeggedRobot(
        model_name(model),
        model,
        model.body(base).name,
        address,
        int(model.jnt_dofadr[free]),
        joints,
        sites,
        np.array([data.site(site).xpos[2] for site in sites]) - floor,
        floor,
        data.qpos.copy(),
        data.act.copy(),
        data.ctrl.copy(),
        _find_set_points(data.ctrl, joints),
    )


def _find_keyframe(model) -> int:
    """The keyframe in which the robot stands."""
    key = find_keyframe(model)
    if key is None:
        raise OptionError([f"env.robot: the model has no keyframe in which the robot stands; add {KEYFRAME}"])
    return key


def _place(model, key: int, lift: float = 0.0, address: int = 0):
    """C MuJoCo's data of the keyframe, lifted."""
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, key)
    data.qpos[address + 2] += lift
    mujoco.mj_forward(model, data)
    return data


def _find_base(model) -> int:
    """The body that moves freely and carries joints with actuators.

    Raises:
      OptionError: there is none, or there are several.
    """
    import mujoco

    free = [int(model.jnt_bodyid[i]) for i in range(model.njnt) if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_FREE]
    if not free:
        raise OptionError(["env.robot: no body moves freely; walk is for robots with a <freejoint/> (env=reach: arms)"])
    moved = {int(model.body_rootid[model.jnt_bodyid[i]]) for i in range(model.njnt) if read_drive(model, i)}
    bases = [body for body in free if int(model.body_rootid[body]) in moved]
    if len(bases) != 1:
        names = ", ".join(model.body(body).name for body in bases)
        line = f"several bodies with legs move freely ({names})" if bases else "no hinge or slide has an actuator"
        raise OptionError([f"env.robot: {line}; expected one robot whose legs have motors or position servos"])
    return bases[0]


def _list_colliding(model, base: int) -> list[int]:
    """The geoms of the robot that collide."""
    root = model.body_rootid[base]
    return [
        geom
        for geom in range(model.ngeom)
        if model.body_rootid[model.geom_bodyid[geom]] == root
        and model.geom_contype[geom] | model.geom_conaffinity[geom]
    ]


def _find_lowest(model, data, geom: int) -> float:
    """Height of the lowest point of a geom; of shapes but spheres and capsules, of the box around it."""
    import mujoco

    down = data.geom_xmat[geom].reshape(3, 3)[2]
    size, height = model.geom_size[geom], data.geom_xpos[geom, 2]
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
        return float(height - size[0])
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return float(height - size[0] - abs(down[2]) * size[1])
    centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    return float(height + down @ centre - np.abs(down) @ half)


def _find_lowest_of_all(model, data, base: int) -> float:
    return min(_find_lowest(model, data, geom) for geom in _list_colliding(model, base))


def _find_feet(model, data, base: int) -> dict[int, list[int]]:
    """The bodies with the robot's lowest geoms, and these geoms.

    Raises:
      OptionError: nothing of the robot collides, or it does not stand on legs.
    """
    colliding = _list_colliding(model, base)
    if not colliding:
        raise OptionError(["env.robot: no geom of the robot collides, so it has no feet; give them contype=1"])
    heights = {geom: _find_lowest(model, data, geom) for geom in colliding}
    lowest: dict[int, float] = {}
    for geom, height in heights.items():
        body = int(model.geom_bodyid[geom])
        lowest[body] = min(height, lowest.get(body, np.inf))
    standing = [body for body, height in lowest.items() if height < min(lowest.values()) + STANDING]
    for body in standing:
        if not any(read_drive(model, joint) for joint in find_path(model, body)):
            line = f"in the keyframe the robot lies on body '{model.body(body).name}', which no actuator moves"
            raise OptionError([f"env.robot: {line}; the keyframe must have it on its feet: {KEYFRAME}"])
    return {
        body: [geom for geom in colliding if model.geom_bodyid[geom] == body and heights[geom] < lowest[body] + SOLE]
        for body in standing
    }


def _find_joints(model, feet: dict[int, list[int]]) -> tuple[ArmJoint, ...]:
    """The joints with actuators between the base and the feet, in the order of the model."""
    joints = {joint for body in feet for joint in find_path(model, body) if read_drive(model, joint)}
    return tuple(_read_joint(model, joint) for joint in sorted(joints))


def _read_joint(model, joint: int) -> ArmJoint:
    drive = read_drive(model, joint)
    assert drive is not None
    if drive.kind not in ("motor", "position"):
        line = f"actuator '{model.actuator(drive.actuator).name}' of joint '{model.joint(joint).name}'"
        raise OptionError([f"env.robot: {line} is neither a motor nor a position servo; legs are moved by these"])
    return make_joint(model, joint, drive)


def _change_servo(spec, model, joint: ArmJoint, options: LegOptions) -> None:
    """Gives the joint a position servo with the wanted stiffness and damping."""
    import mujoco

    drive = joint.drive
    if drive.kind == "position" and options.stiffness is None and options.damping is None:
        return
    actuator = spec.actuator(model.actuator(drive.actuator).name)
    stiffness, damping = _find_gains(joint)
    stiffness = stiffness if options.stiffness is None else options.stiffness
    damping = damping if options.damping is None else options.damping
    change_servo(actuator, drive, stiffness, damping)
    if spec.option.integrator == mujoco.mjtIntegrator.mjINT_EULER:  # it is not stable with much damping of servos
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST


def _find_gains(joint: ArmJoint) -> tuple[float, float]:
    """(kp, kv) of the model's servo, or those that a motor gets from its torque limits."""
    drive = joint.drive
    if drive.kind == "position":
        return -drive.bias[1] * drive.gear**2, -drive.bias[2] * drive.gear**2
    low, high = check_torque(drive, f"joint '{joint.name}'", MOTOR_ADVICE)
    stiffness = STIFFNESS * min(-low, high)
    return stiffness, DAMPING * stiffness


def _is_floor(geom) -> bool:
    import mujoco

    return geom.type == mujoco.mjtGeom.mjGEOM_PLANE and geom.parent.name == "world"


def _find_floor(spec) -> float:
    """Height of the ground [m]; a floor at 0 is added if there is none."""
    import mujoco

    floors = [geom for geom in spec.geoms if _is_floor(geom)]
    if not floors:
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=1, conaffinity=1)
        return 0.0
    return float(floors[0].pos[2])


def _keep_contacts_of(spec, feet: list[int]) -> None:
    """Lets these geoms collide with the world, and no other with anything."""
    for geom in spec.geoms:
        if geom.parent.name == "world":
            collides = geom.contype or geom.conaffinity
            geom.contype, geom.conaffinity = 0, int(bool(collides))
        else:
            geom.contype, geom.conaffinity = int(geom.id in feet), 0


def _name_site(model, body: int) -> str:
    return f"foot of {model.body(body).name}"


def _find_set_points(ctrl: np.ndarray, joints: tuple[ArmJoint, ...]) -> np.ndarray:
    """What controls [nu] ask of the joints' servos [n]."""
    ctrl = ctrl[[joint.drive.actuator for joint in joints]]
    slopes = np.array([joint.drive.control_of(1.0) - joint.drive.control_of(0.0) for joint in joints])
    return (ctrl - np.array([joint.drive.control_of(0.0) for joint in joints])) / slopes
