"""A robot in the plane: the geoms of a MuJoCo model as capsules, seen by a camera without perspective.

What the camera sees of a point p is (right . p, up . p). Every geom is drawn as the capsule that fills its bounding box
best, which for capsules, cylinders and spheres is what they are.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np

SIDE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # of models without a camera
FAR = 4.0  # a robot that travels this many times its own size is followed


class Motor(NamedTuple):
    """A hinge that is driven, and that the camera sees turn.

    Attributes:
      command: which of the model's actuators it is.
      joint: the hinge's number in the model.
      sign: 1 where a positive command turns it counter-clockwise, as the camera sees it, else -1.
    """

    command: int
    joint: int
    sign: int


class Picture(NamedTuple):
    """What is drawn of a model.

    Attributes:
      model: the model.
      axes: right, up and towards the viewer, `[3, 3]`.
      geom: the numbers of its visible geoms, `[P]`.
      middle: of each capsule's axis, in the geom's frame, `[P, 3]`.
      axis: from there to the axis's end, `[P, 3]`.
      radius: `[P]`.
      color: such as `#cc4c4c`, `[P]`.
      motors: the driven hinges.
    """

    model: Any
    axes: np.ndarray
    geom: np.ndarray
    middle: np.ndarray
    axis: np.ndarray
    radius: np.ndarray
    color: list[str]
    motors: list[Motor]


class Frames(NamedTuple):
    """F frames in the plane [m].

    Attributes:
      parts: the two ends of each capsule's axis, x and y of each, `[F, P, 4]`.
      motors: where each hinge is, `[F, M, 2]`.
      goal: `[2]`, or None.
    """

    parts: np.ndarray
    motors: np.ndarray
    goal: np.ndarray | None


def picture(model: Any) -> Picture:
    """The visible geoms of a model, without planes and height fields, and its driven hinges."""
    endless = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
    visible = (model.geom_group < 3) & ~np.isin(model.geom_type, endless)
    geom = np.array([i for i in np.flatnonzero(visible) if _rgba(model, i)[3]], int)
    half = model.geom_aabb[geom, 3:]
    _, radius, longest = np.sort(half, axis=1).T
    axis = (longest - radius)[:, None] * np.eye(3)[np.argmax(half, axis=1)]
    axes = camera(model)
    colors = ["#" + "".join(f"{round(255 * float(x)):02x}" for x in _rgba(model, i)[:3]) for i in geom]
    return Picture(model, axes, geom, model.geom_aabb[geom, :3], axis, radius, colors, _motors(model, axes))


def camera(model: Any) -> np.ndarray:
    """Right, up and towards the viewer, `[3, 3]`: the axes of the model's first camera, or a look from the side."""
    if model.ncam == 0:
        return SIDE
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)  # a camera may look at a centre of mass
    mujoco.mj_camlight(model, data)
    return data.cam_xmat[0].reshape(3, 3).T


def _rgba(model: Any, geom: int) -> np.ndarray:
    material = model.geom_matid[geom]
    return model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]


def _motors(model: Any, axes: np.ndarray) -> list[Motor]:
    """The driven hinges whose axis points to the viewer or away."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found = []
    for command, (joint, _) in enumerate(model.actuator_trnid):
        if model.actuator_trntype[command] != mujoco.mjtTrn.mjTRN_JOINT:
            continue
        towards = float(data.xaxis[joint] @ axes[2])
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE and abs(towards) > 0.9:
            found.append(Motor(command, int(joint), 1 if towards > 0 else -1))
    return found


def draw(picture: Picture, qpos: np.ndarray, goal: np.ndarray | None = None) -> Frames:
    """What the camera sees of the joint positions `[F, nq]`, and of the goal `[F, 3]`, which stays where it is.

    A robot that travels is drawn in the middle.
    """
    data, joints = mujoco.MjData(picture.model), [motor.joint for motor in picture.motors]
    ends, anchors = np.zeros((len(qpos), len(picture.geom), 2, 3)), np.zeros((len(qpos), len(joints), 3))
    for i, q in enumerate(qpos):
        data.qpos = q
        mujoco.mj_kinematics(picture.model, data)
        turned = data.geom_xmat[picture.geom].reshape(-1, 3, 3)
        middle = data.geom_xpos[picture.geom] + np.einsum("pij,pj->pi", turned, picture.middle)
        axis = np.einsum("pij,pj->pi", turned, picture.axis)
        ends[i] = np.stack([middle - axis, middle + axis], axis=1)
        anchors[i] = data.xanchor[joints]
    ends, anchors = ends @ picture.axes[:2].T, anchors @ picture.axes[:2].T
    place = _place(ends)
    return Frames(
        parts=(ends - place[:, None, None]).reshape(len(qpos), -1, 4),
        motors=anchors - place[:, None],
        goal=None if goal is None else picture.axes[:2] @ goal[0],
    )


def _place(ends: np.ndarray) -> np.ndarray:
    """Where the middle of the picture is in each frame, `[F, 2]`: with a robot that travels, else at the origin."""
    points = ends.reshape(len(ends), -1, 2)
    place = np.zeros((len(points), 2))
    if np.ptp(points[..., 0]) > FAR * np.ptp(points, axis=1).max():
        place[:, 0] = points[..., 0].mean(axis=1)
    return place


def extent(frames: list[Frames], radius: np.ndarray, margin: float) -> list[float]:
    """The rectangle that holds all that is drawn: x_min, y_min, x_max, y_max.

    Args:
      frames: to be drawn in the same rectangle.
      radius: of the capsules, `[P]`.
      margin: what is left around them, as a fraction of the larger side.
    """
    ends = [one.parts.reshape(*one.parts.shape[:2], 2, 2) for one in frames]
    corners = [sign * radius[:, None, None] + one for one in ends for sign in (-1, 1)]
    points = [one.reshape(-1, 2) for one in corners] + [one.goal[None] for one in frames if one.goal is not None]
    low, high = np.concatenate(points).min(axis=0), np.concatenate(points).max(axis=0)
    room = margin * np.max(high - low)
    return [*(low - room).tolist(), *(high + room).tolist()]
