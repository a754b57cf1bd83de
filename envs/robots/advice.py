"""What to change in a robot's model, so that less of it is guessed: lines with the MJCF to write."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from envs.physics.collision import describe_meshes
from envs.robots.arms import OWN_SITE, Arm
from envs.robots.controls import SPEED, VELOCITY_LIMIT
from envs.robots.goals import list_overlaps

if TYPE_CHECKING:
    import mujoco


def list_changes(spec: mujoco.MjSpec, model: mujoco.MjModel, arm: Arm | None) -> Iterator[str]:
    """One line for each thing that the model should say, or should say otherwise.

    Args:
      spec: the robot's specification.
      model: compiled from it.
      arm: what was read from it; None without an arm.
    """
    if meshes := describe_meshes(model):
        yield meshes
    if arm is None:
        return
    yield from _list_ranges(spec, arm)
    yield from _list_torques(arm)
    yield from _list_poses(model, arm)
    yield from _list_sites(model, arm)
    if VELOCITY_LIMIT not in [model.numeric(i).name for i in range(model.nnumeric)]:
        data = " ".join([f"{SPEED:g}"] * len(arm.joints))
        line = f"largest speeds are not given, and {SPEED:g} rad/s or m/s counts for each joint"
        yield f'{line}: <custom><numeric name="{VELOCITY_LIMIT}" data="{data}"/></custom>, or env.speed'


def _list_ranges(spec, arm: Arm) -> Iterator[str]:
    degrees = bool(spec.compiler.degree)
    for joint in arm.joints:
        if not np.isfinite(joint.low):
            ends = "0 0.5" if joint.is_slide else "-180 180" if degrees else "-3.1416 3.1416"
            where = "so goals cannot be drawn" if joint.is_slide else "and goals stay within half a turn of its rest"
            yield f'joint \'{joint.name}\' has no range, {where}: <joint name="{joint.name}" range="{ends}"/>'


def _list_torques(arm: Arm) -> Iterator[str]:
    for joint in arm.joints:
        if joint.drive.kind != "motor" and not np.isfinite(joint.drive.torque).all():
            name = arm.model.actuator(joint.drive.actuator).name
            what = "force, in N" if joint.is_slide else "torque, in N m"
            yield f"actuator '{name}' has no largest {what}: forcerange=\"-50 50\", for example"


def _list_poses(model, arm: Arm) -> Iterator[str]:
    """About the pose at rest."""
    if not model.nkey:
        qpos = " ".join(f"{x:.4g}" for x in np.round(arm.qpos, 4) + 0.0)
        yield f'there is no pose at rest: <keyframe><key name="home" qpos="{qpos}"/></keyframe>'
    for joint, angle in zip(arm.joints, arm.angles, strict=True):
        if not joint.low <= angle <= joint.high:
            line = f"joint '{joint.name}' rests at {angle:.4g} {joint.unit}"
            yield f"{line}, outside its range from {joint.low:.4g} to {joint.high:.4g}"
    for one, other in list_overlaps(arm):
        line = f"bodies '{one}' and '{other}' penetrate each other at rest"
        yield f'{line}: another pose, or <contact><exclude body1="{one}" body2="{other}"/></contact>'


def _list_sites(model, arm: Arm) -> Iterator[str]:
    """About the end effector, if the model has no site for it."""
    if arm.site == OWN_SITE and OWN_SITE not in [model.site(i).name for i in range(model.nsite)]:
        site = arm.model.site(OWN_SITE)
        body = arm.model.body(int(site.bodyid[0])).name
        position = " ".join(f"{x:.4g}" for x in np.round(site.pos, 4) + 0.0)  # without -0
        yield f'there is no site for the end effector: <site name="tcp" pos="{position}"/> in body \'{body}\''
