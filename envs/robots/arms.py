"""Reads from a model what a task with an arm must know: its joints, its end effector, its pose at rest.

What the model does not say is guessed, and `Arm.guesses` has one phrase for each guess.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, NoReturn

import jax
import jax.numpy as jnp
import numpy as np

from envs.options import OptionError, describe_unknown
from envs.physics import compile_model
from envs.physics.models import model_name
from envs.robots.drives import Drive, read_drive

if TYPE_CHECKING:
    import mujoco

# Names by which modellers call the place of a tool, the most telling first.
SITE_NAMES = ("end_effector", "tcp", "attachment", "flange", "tip", "pinch", "grasp", "tool", "ee", "gripper", "hand")
GRIPPER_NAMES = re.compile("finger|grip|jaw|claw|knuckle", re.IGNORECASE)
REST_NAMES = ("home", "rest", "ready")
OWN_SITE = "end effector"  # of the site that is added where the model has none
# Fields of mjModel that users write, with their element and attribute in MJCF.
NUMBERS = {
    "jnt_range": ("joint", "range"),
    "actuator_ctrlrange": ("actuator", "ctrlrange"),
    "actuator_forcerange": ("actuator", "forcerange"),
    "key_qpos": ("key", "qpos"),
}


class NoArmError(OptionError):
    """The robot has no arm on a fixed base; it may be another kind of robot."""


@dataclass(frozen=True)
class ArmJoint:
    """One joint of the arm.

    Attributes:
      name: its name in the model.
      qpos, dof: its places in qpos and qvel.
      is_slide: positions are in m, not in rad.
      low, high: its range [rad or m]; infinite if it is not limited.
      drive: its actuator.
    """

    name: str
    qpos: int
    dof: int
    is_slide: bool
    low: float
    high: float
    drive: Drive

    @property
    def unit(self) -> str:
        """The unit of its position."""
        return "m" if self.is_slide else "rad"


class Jointed:
    """What follows from a robot's `joints`."""

    joints: tuple[ArmJoint, ...]

    @property
    def qpos_of(self) -> np.ndarray:
        """Where the joints' positions are in qpos [n]."""
        return np.array([joint.qpos for joint in self.joints])

    @property
    def dof_of(self) -> np.ndarray:
        """Where the joints' velocities are in qvel [n]."""
        return np.array([joint.dof for joint in self.joints])

    @property
    def ranges(self) -> tuple[np.ndarray, np.ndarray]:
        """(lowest, highest) positions of the joints [n]."""
        return np.array([joint.low for joint in self.joints]), np.array([joint.high for joint in self.joints])

    def find_nearness(self, angles: jax.Array, margin: float) -> jax.Array:
        """How far each joint is within a margin of the ends of its range `[n]`, for positions `[n]` [rad or m]."""
        low, high = self.ranges
        return jnp.maximum(0.0, jnp.maximum(low + margin - angles, angles - high + margin))


@dataclass(frozen=True)
class Arm(Jointed):
    """What is read from the model of an arm.

    Attributes:
      name: the model's.
      model: the compiled model.
      joints: those that carry the end effector and have an actuator, from the base on.
      site: the site that is the end effector.
      qpos, act, ctrl: the pose at rest [nq], activations [na] and controls [nu], which other actuators keep.
      guesses: one phrase for each thing that the model does not say.
    """

    name: str
    model: mujoco.MjModel
    joints: tuple[ArmJoint, ...]
    site: str
    qpos: np.ndarray
    act: np.ndarray
    ctrl: np.ndarray
    guesses: tuple[str, ...]

    @property
    def angles(self) -> np.ndarray:
        """The joints' positions at rest [n]."""
        return self.qpos[self.qpos_of]


def read_arm(spec: mujoco.MjSpec, site: str = "") -> Arm:
    """Finds the arm in a specification, to which a site is added if it has none for the end effector.

    The joints of the arm are those hinges and slides between the base and the end effector that have an actuator of
    their own. Joints beyond it, and those that are called like fingers, are the gripper's.

    Args:
      spec: the robot's specification, with names (`load_robot`).
      site: the site or body that is the end effector; "" finds one by its name or place.

    Raises:
      NoArmError: there is no arm, or none on a fixed base.
      OptionError: there are several, or no such site; or its actuators or numbers are not an arm's.
      MujocoModelError: the specification cannot be compiled.
    """
    model = compile_model(spec)
    check_numbers(model)
    _check_actuators(model)
    guesses: list[str] = []
    name = _find_site(model, site, guesses)
    if not name or name not in _list_names(model, "site"):
        name = _add_site(spec, model, name, guesses)
        model = compile_model(spec)
    joints = _find_joints(model, model.site_bodyid[model.site(name).id])
    guesses += _describe_loose_joints(model, model.site_bodyid[model.site(name).id])
    rest = _find_arm_rest(model, joints, guesses)
    return Arm(model_name(model), model, joints, name, *rest, tuple(guesses))


def find_path(model: mujoco.MjModel, body: int) -> list[int]:
    """The joints between the world and a body, from the base on."""
    joints: list[int] = []
    while body:
        first = int(model.body_jntadr[body])
        joints = [*range(first, first + int(model.body_jntnum[body])), *joints]
        body = int(model.body_parentid[body])
    return joints


def _check_actuators(model) -> None:
    if not model.nu:
        advice = """<motor joint="..." ctrlrange="-10 10"/> or <position joint="..." kp="100"/>"""
        raise OptionError([f"env.robot: the model has no actuators; add one for each joint of the arm: {advice}"])


def check_numbers(model: mujoco.MjModel) -> None:
    """Raises OptionError for ranges and keyframes that are not numbers, with which MuJoCo compiles a model."""
    for field, (kind, attribute) in NUMBERS.items():
        wrong = np.argwhere(np.isnan(getattr(model, field)))
        if wrong.size:
            name = getattr(model, kind)(int(wrong[0, 0])).name
            raise OptionError([f"env.robot: {attribute} of {kind} '{name}' is not a number (NaN)"])


def _list_names(model, kind: str) -> list[str]:
    access, count = getattr(model, kind), {"site": model.nsite, "body": model.nbody}[kind]
    return [access(i).name for i in range(count)]


def _find_site(model, site: str, guesses: list[str]) -> str:
    """The name of the site, or of a body whose origin it shall be; "" if there is neither."""
    sites, bodies = _list_names(model, "site"), _list_names(model, "body")
    if site:
        if site not in sites and site not in bodies[1:]:
            raise OptionError([f"{describe_unknown('site or body', site, [*sites, *bodies[1:]])} (env.site)"])
        return site
    last = _find_last_body(model)
    carried = [i for i in range(model.nsite) if last in _list_ancestors(model, model.site_bodyid[i]) and sites[i]]
    if not carried:
        return ""
    found = sites[min(carried, key=lambda i: _rank(sites[i]))]
    if len(carried) > 1 or _rank(found) == len(SITE_NAMES):
        guesses.append(f"the end effector is its site '{found}' (env.site=NAME takes another)")
    return found


def _rank(name: str) -> int:
    """How telling a site's name is, from 0."""
    lower = name.lower()
    return next((i for i, known in enumerate(SITE_NAMES) if known in lower), len(SITE_NAMES))


def _list_ancestors(model, body: int) -> list[int]:
    """The body and those that carry it, without the world."""
    bodies = []
    while body:
        bodies.append(int(body))
        body = int(model.body_parentid[body])
    return bodies


def _is_arm_joint(model, joint: int) -> bool:
    drive = read_drive(model, joint)
    if drive is None:
        return False
    return not (
        GRIPPER_NAMES.search(model.joint(joint).name) or GRIPPER_NAMES.search(model.actuator(drive.actuator).name)
    )


def _find_last_body(model) -> int:
    """The body at the end of the longest chain of driven joints that are not a gripper's.

    Raises:
      NoArmError: no joint has an actuator of its own, or all of them move with a free body.
      OptionError: several chains are the longest.
    """
    chains = {}
    for joint in range(model.njnt):
        body = int(model.jnt_bodyid[joint])
        if _is_arm_joint(model, joint) and find_free_joint(model, body) is None:
            chains[body] = sum(_is_arm_joint(model, each) for each in find_path(model, body))
    if not chains:
        _check_base(model)
        line = "no hinge or slide joint has an actuator of its own, so there is no arm to move"
        advice = """give each joint of an arm one, such as <motor joint="..." ctrlrange="-10 10"/>"""
        raise NoArmError([f"env.robot: {line}; {advice} (those of fingers, tendons and sites do not count)"])
    length = max(chains.values())
    longest = [body for body, joints in chains.items() if joints == length]
    if len(longest) > 1:
        names = ", ".join(model.body(body).name for body in longest)
        line = f"the robot has several arms of {length} joint{'s' if length > 1 else ''}, which end at {names}"
        raise OptionError([f"env.robot: {line}; choose one with env.site=NAME, a site or body at its end"])
    return longest[0]


def find_free_joint(model: mujoco.MjModel, body: int) -> int | None:
    """The free joint by which a body, or one that carries it, moves freely; None on a fixed base."""
    import mujoco

    free = int(mujoco.mjtJoint.mjJNT_FREE)
    return next((joint for joint in find_path(model, body) if model.jnt_type[joint] == free), None)


def _check_base(model) -> None:
    """Raises NoArmError if every joint moves with a free body."""
    joints = [find_free_joint(model, int(body)) for body in model.jnt_bodyid]
    free = [joint for joint in joints if joint is not None]
    if free and len(free) == len(joints):
        _refuse_free_base(model, free[0])


def _refuse_free_base(model, joint: int) -> NoReturn:
    line = f"body '{model.body(model.jnt_bodyid[joint]).name}' moves freely, so the robot has no fixed base"
    raise NoArmError([f"env.robot: {line}; reach is for arms on one (env=walk and env=drive move a base)"])


def _add_site(spec, model, body: str, guesses: list[str]) -> str:
    """Adds a site at the origin of a body; without a body, at the gripper or the last link, as a guess."""
    if body:
        spec.body(body).add_site(name=OWN_SITE)
        return OWN_SITE
    import mujoco

    last = _find_last_body(model)
    data = mujoco.MjData(model)
    _reset(model, data)
    mujoco.mj_forward(model, data)
    fingers = [
        body
        for body in range(model.nbody)
        if last in _list_ancestors(model, body) and _has_other_joints(model, body, last)
    ]
    place = np.mean([data.xipos[body] for body in fingers], 0) if fingers else data.subtree_com[last]
    local = data.xmat[last].reshape(3, 3).T @ (place - data.xpos[last])
    spec.body(model.body(last).name).add_site(name=OWN_SITE, pos=local)
    where = "the middle of its gripper" if fingers else f"the centre of mass of body '{model.body(last).name}'"
    guesses.append(f"the end effector is {where}, as it has no site (env.site=NAME takes a site or body)")
    return OWN_SITE


def _has_other_joints(model, body: int, last: int) -> bool:
    return body != last and int(model.body_jntnum[body]) > 0


def _find_joints(model, body: int) -> tuple[ArmJoint, ...]:
    """The joints that carry a body; raises OptionError if they are no arm on a fixed base."""
    import mujoco

    free, path = find_free_joint(model, int(body)), find_path(model, int(body))
    if free is not None:
        _refuse_free_base(model, free)
    balls = [joint for joint in path if model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_BALL)]
    if balls:
        line = f"ball joint '{model.joint(balls[0]).name}' carries the end effector, and arms have hinges and slides"
        raise OptionError([f"env.robot: {line}; write it as three hinges, or choose a site before it with env.site"])
    joints = [joint for joint in path if read_drive(model, joint)]
    if not joints:
        raise OptionError([f"env.site: no joint with an actuator carries body '{model.body(int(body)).name}'"])
    return tuple(_read_joint(model, joint) for joint in joints)


def _read_joint(model, joint: int) -> ArmJoint:
    drive, name = read_drive(model, joint), model.joint(joint).name
    assert drive is not None
    if drive.kind == "other":
        line = f"actuator '{model.actuator(drive.actuator).name}' of joint '{name}'"
        line += " has gear 0" if not drive.gear else " is neither a motor nor a servo"
        advice = f'a motor or a servo for position or velocity, such as <motor joint="{name}" ctrlrange="-10 10"/>'
        raise OptionError([f"env.robot: {line}; an arm needs {advice}"])
    return make_joint(model, joint, drive)


def make_joint(model: mujoco.MjModel, joint: int, drive: Drive) -> ArmJoint:
    """A hinge or slide with its actuator, as the model has it."""
    import mujoco

    low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-np.inf, np.inf)
    is_slide = bool(model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_SLIDE))
    places = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    return ArmJoint(model.joint(joint).name, *places, is_slide, float(low), float(high), drive)


def _describe_loose_joints(model, body: int) -> list[str]:
    """A phrase for each joint on the way to a body that no action moves alone."""
    import mujoco

    path = find_path(model, int(body))
    active = (model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)) & model.eq_active0.astype(bool)
    tied = [joint for joint in path if joint in model.eq_obj1id[active]]
    loose = [joint for joint in path if joint not in tied and not read_drive(model, joint)]
    names = {joint: model.joint(joint).name for joint in path}
    return [
        *(
            f"an equality ties joint '{names[joint]}' of the arm, which goals do not know (env.goal_box)"
            for joint in tied
        ),
        *(f"joint '{names[joint]}' of the arm has no actuator and moves as it will" for joint in loose),
    ]


def find_keyframe(model: mujoco.MjModel) -> int | None:
    """The keyframe of the pose at rest: one called home, rest or ready, or the first; None without any."""
    names = [model.key(i).name.lower() for i in range(model.nkey)]
    return next((names.index(name) for name in REST_NAMES if name in names), 0 if names else None)


def _reset(model, data) -> None:
    import mujoco

    key = find_keyframe(model)
    if key is None:
        mujoco.mj_resetData(model, data)
    else:
        mujoco.mj_resetDataKeyframe(model, data, key)


def find_rest(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, activations and controls of the keyframe of the pose at rest.

    Without a keyframe they are the model's initial ones, with controls in the middle of their ranges.
    """
    import mujoco

    data = mujoco.MjData(model)
    _reset(model, data)
    ctrl = data.ctrl.copy()
    if find_keyframe(model) is None:
        ctrl = np.where(model.actuator_ctrllimited.astype(bool), model.actuator_ctrlrange.mean(1), 0.0)
    return data.qpos.copy(), data.act.copy(), ctrl


def _find_arm_rest(
    model, joints: tuple[ArmJoint, ...], guesses: list[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `find_rest`; without a keyframe the joints of the arm are in the middle of their ranges.

    Controls of the arm itself are of no account.
    """
    qpos, act, ctrl = find_rest(model)
    if find_keyframe(model) is None:
        for joint in joints:
            if np.isfinite(joint.low):
                qpos[joint.qpos] = (joint.low + joint.high) / 2
        guesses.append("it rests in the middle of its joints' ranges, as it has no keyframe")
    return qpos, act, ctrl
