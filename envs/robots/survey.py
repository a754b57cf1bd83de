"""What a robot is, and whether a task takes it as it is: all that can be found out before a training.

Nothing is compiled by XLA, but by `measure_step`. What is to be changed in the model is in `envs.robots.advice`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from envs.options import OptionError
from envs.physics import (
    Description,
    candidate_pairs,
    change_collision,
    check_model,
    compile_model,
    compile_step,
    describe,
    unsupported_features,
)
from envs.robots.advice import list_changes
from envs.robots.arms import (
    GRIPPER_NAMES,
    Arm,
    NoArmError,
    check_numbers,
    find_free_joint,
    find_path,
    find_rest,
    read_arm,
)
from envs.robots.controls import CONTROLS, ControlOptions, make_control
from envs.robots.drives import Drive, read_drive
from envs.robots.goals import measure_free_share
from envs.robots.sources import load_robot

KINDS = ("free", "ball", "slide", "hinge")  # of joints, as mjtJoint
NUM_STEPS = 200  # that are compared with C MuJoCo's
TOLERANCE = 1e-3  # of the comparison, relative
DIVERGES = "the timestep is too long for it"  # of `check_model`
NUM_ENVS = 256  # that are stepped at once when time is measured
LENGTH = 20  # steps in one call when time is measured
SECONDS = 1.0  # for which they are measured


@dataclass(frozen=True)
class JointEntry:
    """One joint: `part` is "arm", "gripper" or "other"; `rest` and the range are in rad or m.

    `drive` is the joint's own actuator, called `actuator`; without one, `moved_by` is what else moves the joint.
    """

    name: str
    kind: str
    part: str
    low: float
    high: float
    rest: float | None
    actuator: str
    drive: Drive | None
    moved_by: str


@dataclass(frozen=True)
class OtherActuator:
    """An actuator of no joint, or of one beyond the arm: what it acts on, its range, and the control that it keeps.

    An actuator keeps its control where actions command an arm without it; without an arm, `kept` is None.
    """

    name: str
    target: str
    low: float
    high: float
    kept: float | None


@dataclass(frozen=True)
class Command:
    """What `env.control` commands: the limit and unit of each number; or the reason why it cannot."""

    control: str
    limits: tuple[float, ...]
    units: tuple[str, ...]
    reason: str


@dataclass(frozen=True)
class Survey:
    """What is found out about a robot.

    Attributes:
      source: where its model comes from, as the user wrote it.
      description: numbers of its parts, and how it is stepped.
      timestep: of its physics [s].
      base: the body that moves freely; "" on a fixed base.
      task: the environment that takes it; "" if none of the shipped ones does.
      joints, others: joints, and actuators that are none of the arm's; without an arm, of none of the joints.
      sites: names of the model's sites.
      site: the site that is the end effector; "" without an arm.
      guesses: what the model does not say of its arm.
      pairs: names of two bodies, and how many of their geoms can meet.
      features: what only C MuJoCo simulates.
      differences: lines about differences from C MuJoCo's motion.
      commands: what actions can command in `reach`; empty without an arm.
      free_share: share of random poses that are possible; None without an arm or if it cannot be said.
      changes: what to change in the model, one line each.
      problems: why it cannot be trained as it is, one line each; empty if it can.
    """

    source: str
    description: Description
    timestep: float
    base: str
    task: str
    joints: tuple[JointEntry, ...]
    others: tuple[OtherActuator, ...]
    sites: tuple[str, ...]
    site: str
    guesses: tuple[str, ...]
    pairs: tuple[tuple[str, str, int], ...]
    features: tuple[str, ...]
    differences: tuple[str, ...]
    commands: tuple[Command, ...]
    free_share: float | None
    changes: tuple[str, ...]
    problems: tuple[str, ...]


@dataclass(frozen=True)
class Measurement:
    """Seconds to make the equations (`trace`) and machine code (`compile`), and physics steps per second (`rate`)."""

    trace: float
    compile: float
    rate: float


def survey_robot(source: str, site: str, options: ControlOptions, collision: str = "primitives") -> Survey:
    """Finds out what a robot is, and what can be trained with it.

    A robot without an arm on a fixed base has no problems if physics steps it as C MuJoCo does.

    Args:
      source: where the model comes from (`load_robot`).
      site: the end effector; "" finds it (`read_arm`).
      options: what actions command.
      collision: which geoms collide (`compile_step`).

    Raises:
      OptionError, MujocoModelError: there is no such robot, or it cannot be compiled.
    """
    spec = load_robot(source)
    model = compile_model(spec)
    if collision != "primitives":  # of which all below say what it leaves out
        model = change_collision(model, collision)
    check_numbers(model)
    if not model.nv:
        raise OptionError([f"env.robot={source}: nothing can move, as no body of the model has a joint"])
    arm, problems = _try_arm(spec, site)
    commands = tuple(_try_control(spec, site, options, control) for control in CONTROLS) if arm else ()
    problems += [command.reason for command in commands if command.control == options.control and command.reason]
    share, problem = _try_poses(arm) if arm else (None, [])
    description, differences = describe(model), _compare(model)
    base = _find_base(model)
    return Survey(
        source=source,
        description=description,
        timestep=float(model.opt.timestep),
        base=base,
        task="reach" if arm else _suggest_task(model) if base else "",
        joints=tuple(_read_joint(model, joint, arm) for joint in range(model.njnt)),
        others=tuple(_read_other(model, i, arm) for i in range(model.nu) if i not in _list_known(model, arm)),
        sites=tuple(model.site(i).name for i in range(model.nsite)),
        site=arm.site if arm else "",
        guesses=arm.guesses if arm else (),
        pairs=_list_pairs(model),
        features=tuple(unsupported_features(change_collision(model, "primitives"))),
        differences=differences,
        commands=commands,
        free_share=share,
        changes=tuple(list_changes(spec, model, arm)),
        problems=(*problems, *problem, *(f"{description.name}: {line}" for line in differences)),
    )


def measure_step(source: str, collision: str = "primitives") -> Measurement:
    """Measures the step of a robot's model, `NUM_ENVS` environments at once, from the pose at rest with its controls.

    Args:
      source, collision: as in `survey_robot`.
    """
    model, begin = compile_model(load_robot(source)), time.perf_counter()
    names = ("qpos", "qvel", *(("act",) if model.na else ()))
    step = compile_step(model, inputs=(*names, "ctrl"), outputs=names, collision=collision)
    qpos, act, ctrl = find_rest(model)
    values = [qpos, np.zeros(model.nv), *([act] if model.na else []), ctrl]
    *start, ctrl = (jnp.tile(jnp.asarray(x, float), (NUM_ENVS, 1)) for x in values)

    def play(state):
        return jax.lax.scan(lambda x, _: (list(jax.vmap(step)(*x, ctrl)), None), state, length=LENGTH)[0]

    lowered = jax.jit(play).lower(start)
    traced = time.perf_counter()
    compiled = lowered.compile()
    ready = time.perf_counter()
    return Measurement(traced - begin, ready - traced, _measure_rate(compiled, start))


def _measure_rate(play, start) -> float:
    """Physics steps per second, of all environments together."""
    jax.block_until_ready(play(start))
    begin, calls = time.perf_counter(), 0
    while (passed := time.perf_counter() - begin) < SECONDS or calls == 0:
        jax.block_until_ready(play(start))
        calls += 1
    return NUM_ENVS * LENGTH * calls / passed


def _try_arm(spec, site: str) -> tuple[Arm | None, list[str]]:
    """The arm, or why there is none although there should be one."""
    try:
        return read_arm(spec.copy(), site), []
    except NoArmError:
        return None, []
    except OptionError as error:
        return None, error.problems


def _try_control(spec, site: str, options: ControlOptions, control: str) -> Command:
    try:
        made = make_control(spec.copy(), site, options._replace(control=control))
    except OptionError as error:
        return Command(control, (), (), "; ".join(error.problems))
    units = tuple(name.rpartition("[")[2].removesuffix("]") for name in made.names)
    return Command(control, tuple(made.limits.tolist()), units, "")


def _try_poses(arm: Arm) -> tuple[float | None, list[str]]:
    try:
        return measure_free_share(arm), []
    except OptionError as error:
        return None, error.problems


def _compare(model) -> tuple[str, ...]:
    """The differences from C MuJoCo, without the line about meshes that do not collide."""
    lines = check_model(change_collision(model, "primitives"), NUM_STEPS, TOLERANCE)
    advice = f'{DIVERGES}; try <option integrator="implicitfast"/>, a shorter timestep, or more <joint armature="..."/>'
    return tuple(line.replace(DIVERGES, advice) for line in lines)


def _find_base(model) -> str:
    joints = [find_free_joint(model, int(body)) for body in model.jnt_bodyid]
    free = [joint for joint in joints if joint is not None]
    return model.body(model.jnt_bodyid[free[0]]).name if free else ""


def _suggest_task(model) -> str:
    """The environment for a moving base: "drive" with wheels, "walk" with legs, "" with neither."""
    driven = [x for x in range(model.njnt) if find_free_joint(model, int(model.jnt_bodyid[x])) is not None]
    limited = [bool(model.jnt_limited[x]) for x in driven if read_drive(model, x)]
    if not limited:
        return ""
    return "walk" if any(limited) else "drive"


def _list_known(model, arm: Arm | None) -> set[int]:
    """The actuators of the arm, or without one of any joint."""
    if arm:
        return {joint.drive.actuator for joint in arm.joints}
    return {drive.actuator for joint in range(model.njnt) if (drive := read_drive(model, joint))}


def _read_joint(model, joint: int, arm: Arm | None) -> JointEntry:
    name, kind, drive = model.joint(joint).name, KINDS[model.jnt_type[joint]], read_drive(model, joint)
    low, high = model.jnt_range[joint].tolist() if model.jnt_limited[joint] else (-np.inf, np.inf)
    qpos = arm.qpos if arm else find_rest(model)[0]
    return JointEntry(
        name=name,
        kind=kind,
        part=_find_part(model, joint, arm),
        low=low,
        high=high,
        rest=float(qpos[model.jnt_qposadr[joint]]) if kind in ("slide", "hinge") else None,
        actuator=model.actuator(drive.actuator).name if drive else "",
        drive=drive,
        moved_by="" if drive else _find_mover(model, joint),
    )


def _find_part(model, joint: int, arm: Arm | None) -> str:
    """The joints of the arm carry the end effector; a gripper's is called like one, or is carried by the arm's last."""
    name = model.joint(joint).name
    if arm is None:
        return "gripper" if GRIPPER_NAMES.search(name) else "other"
    carrying = find_path(arm.model, int(arm.model.site_bodyid[arm.model.site(arm.site).id]))
    if joint in carrying:
        return "arm"
    is_carried = carrying[-1] in find_path(model, int(model.jnt_bodyid[joint]))
    return "gripper" if is_carried or GRIPPER_NAMES.search(name) else "other"


def _find_mover(model, joint: int) -> str:
    """What moves a joint without an actuator of its own: a tendon that an actuator pulls, or an equality."""
    import mujoco

    kind = int(mujoco.mjtTrn.mjTRN_TENDON)
    for tendon in model.actuator_trnid[model.actuator_trntype == kind, 0]:
        wraps = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
        joints = model.wrap_objid[wraps][model.wrap_type[wraps] == int(mujoco.mjtWrap.mjWRAP_JOINT)]
        if joint in joints:
            return f"tendon '{model.tendon(int(tendon)).name}'"
    for i in np.flatnonzero(model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)):
        pair = [int(model.eq_obj1id[i]), int(model.eq_obj2id[i])]
        other = pair[1 - pair.index(joint)] if joint in pair else -1
        if other >= 0:
            return f"equality with '{model.joint(other).name}'"
    return ""


def _read_other(model, actuator: int, arm: Arm | None) -> OtherActuator:
    low, high = model.actuator_ctrlrange[actuator].tolist()
    if not model.actuator_ctrllimited[actuator]:
        low, high = -np.inf, np.inf
    kept = float(arm.ctrl[actuator]) if arm else None
    return OtherActuator(model.actuator(actuator).name, _describe_target(model, actuator), low, high, kept)


def _describe_target(model, actuator: int) -> str:
    """What an actuator acts on, such as `tendon 'split'`."""
    import mujoco

    kind = mujoco.mjtTrn(int(model.actuator_trntype[actuator])).name.removeprefix("mjTRN_").lower()
    kinds = {"jointinparent": "joint", "slidercrank": "site"}
    kind, number = str(kinds.get(kind, kind)), int(model.actuator_trnid[actuator, 0])
    return f"{kind} '{getattr(model, kind)(number).name}'"


def _list_pairs(model) -> tuple[tuple[str, str, int], ...]:
    """The bodies whose geoms can meet, and how many pairs of geoms, most first."""
    counts: dict[tuple[str, str], int] = {}
    for pair in candidate_pairs(change_collision(model, "primitives")):
        one, other = sorted(int(model.geom_bodyid[geom]) for geom in (pair.geom1, pair.geom2))
        names = model.body(one).name, model.body(other).name
        counts[names] = counts.get(names, 0) + 1
    return tuple((*names, count) for names, count in sorted(counts.items(), key=lambda item: -item[1]))
