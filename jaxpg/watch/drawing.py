"""Draws a robot in the plane: outlines of the geoms of a MuJoCo model, seen by an orthographic camera.

The camera maps a point p to (right . p, up . p). The outline of a geom is the convex hull of some of its points with a
rim around it: two points and a radius make a capsule, eight corners without a rim a box.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import mujoco
import numpy as np

from jaxpg.watch.attempts import DrawingError

SIDE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # for models without a camera
TRAVEL = 4.0  # a robot that travels this many times its own size is kept in the middle
MAX_REACH = 20.0  # times the model's size: anything farther away is drawn there
PARALLEL = 0.9  # cosine of the angle between an axis and the line of sight above which they count as parallel
CIRCLE_POINTS = 16
NUM_DIRECTIONS = 64  # in which the outermost points of a mesh or an ellipsoid are searched
BODY_COLOR = "#9aa5b3"  # for bodies, in models without geoms
CORNERS = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
AXES = ("x", "y", "z")


class Motor(NamedTuple):
    """A driven hinge whose turning the camera sees.

    Attributes:
      command: index of the actuator in the model.
      joint: index of the hinge in the model.
      sign: 1 if a positive command turns it counter-clockwise in the picture, else -1.
    """

    command: int
    joint: int
    sign: int


class Part(NamedTuple):
    """A geom, or a body in a model without geoms.

    Attributes:
      number: index of the geom or the body in the model.
      points: points that span its convex hull, in its own frame, `[K, 3]` [m].
      radius: width of the rim around them [m].
      color: such as `#cc4c4c`.
    """

    number: int
    points: np.ndarray
    radius: float
    color: str


class Picture(NamedTuple):
    """What is drawn of a model.

    Attributes:
      model: the model.
      axes: right, up and towards the viewer, `[3, 3]`.
      parts: farthest first.
      of_bodies: whether the parts are bodies, drawn as boxes with their inertia, instead of geoms.
      motors: the driven hinges.
    """

    model: Any
    axes: np.ndarray
    parts: list[Part]
    of_bodies: bool
    motors: list[Motor]


class Frames(NamedTuple):
    """F frames in the plane.

    Attributes:
      place: the origin of each part's frame, `[F, P, 2]` [m].
      turn: what the camera sees of the frame's axes, `[F, P, 2, 3]`.
      motors: where each hinge is, `[F, M, 2]` [m].
      goal: `[2]` [m], or None.
    """

    place: np.ndarray
    turn: np.ndarray
    motors: np.ndarray
    goal: np.ndarray | None


def make_picture(model: Any) -> Picture:
    """The geoms of a model, without planes and height fields, and its driven hinges.

    Draws the visible geoms; if none is visible, as when visual geoms were removed, all of them; and if there are none,
    the bodies.

    Raises:
      DrawingError: there are no bodies either.
    """
    axes, data = camera_axes(model), mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    geoms = find_geoms(model)
    parts = [Part(i, *make_outline(model, i), format_color(find_rgba(model, i))) for i in geoms] or make_bodies(model)
    if not parts:
        raise DrawingError("the model has no geoms and no bodies")
    depth = (data.geom_xpos if geoms else data.xipos) @ axes[2]
    parts.sort(key=lambda part: round(float(depth[part.number]), 6))
    return Picture(model, axes, parts, not geoms, _find_motors(model, axes))


def find_geoms(model: Any) -> list[int]:
    """The visible geoms, or all if none is visible; without planes and height fields."""
    unbounded = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
    geoms = [i for i in np.flatnonzero(~np.isin(model.geom_type, unbounded)).tolist() if find_rgba(model, i)[3]]
    return [i for i in geoms if model.geom_group[i] < 3] or geoms


def make_outline(model: Any, geom: int) -> tuple[np.ndarray, float]:
    """Points `[K, 3]` in the geom's frame, and the radius around them."""
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return np.zeros((1, 3)), float(size[0])
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return np.array([[0, 0, -size[1]], [0, 0, size[1]]]), float(size[0])
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        angle = np.linspace(0, 2 * np.pi, CIRCLE_POINTS, endpoint=False)
        ends = [
            np.stack([size[0] * np.cos(angle), size[0] * np.sin(angle), 0 * angle + z]) for z in (-size[1], size[1])
        ]
        return np.concatenate(ends, axis=1).T, 0.0
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return size * _make_directions(), 0.0
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return _find_outermost(model, int(model.geom_dataid[geom])), 0.0
    return model.geom_aabb[geom, :3] + CORNERS * model.geom_aabb[geom, 3:], 0.0


def _make_directions() -> np.ndarray:
    """Unit vectors spread evenly over the sphere, on a spiral, `[DIRECTIONS, 3]`."""
    height = 1 - (2 * np.arange(NUM_DIRECTIONS) + 1) / NUM_DIRECTIONS
    angle, around = np.pi * (3 - np.sqrt(5)) * np.arange(NUM_DIRECTIONS), np.sqrt(1 - height**2)
    return np.stack([around * np.cos(angle), around * np.sin(angle), height], axis=1)


def _find_outermost(model: Any, mesh: int) -> np.ndarray:
    """The vertices of a mesh that are farthest in some direction."""
    first = model.mesh_vertadr[mesh]
    vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    return vertices[np.unique(np.argmax(vertices @ _make_directions().T, axis=0))].astype(float)


def make_bodies(model: Any) -> list[Part]:
    """Boxes of uniform density with the mass and inertia of the bodies, as in MuJoCo's viewer.

    A box with half sides a, b, c has I_x = m (b^2 + c^2) / 3, so a = sqrt(3 (I_y + I_z - I_x) / (2 m))
    """
    parts = []
    for body in np.flatnonzero(model.body_mass > 0):
        inertia, mass = model.body_inertia[body], model.body_mass[body]
        half = np.sqrt(np.maximum(1.5 * (inertia.sum() - 2 * inertia) / mass, 0))
        parts.append(Part(int(body), CORNERS * half, 0.0, BODY_COLOR))
    return parts


def format_color(rgba: np.ndarray) -> str:
    """Red, green and blue in [0, 1] as text, such as `#cc4c4c`."""
    return "#" + "".join(f"{round(255 * float(np.clip(x, 0, 1))):02x}" for x in rgba[:3])


def find_camera(model: Any) -> int | None:
    """The first camera that stands in the world or follows a body, not one that a moving body carries."""
    stands = (model.cam_bodyid == 0) | (model.cam_mode != mujoco.mjtCamLight.mjCAMLIGHT_FIXED)
    return next(iter(np.flatnonzero(stands).tolist()), None)


def camera_axes(model: Any) -> np.ndarray:
    """Right, up and towards the viewer, `[3, 3]`: axes of the camera of `find_camera`, or a view from the side."""
    camera = find_camera(model)
    if camera is None:
        return SIDE
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)  # a camera may look at a centre of mass
    mujoco.mj_camlight(model, data)
    return data.cam_xmat[camera].reshape(3, 3).T


def is_planar(model: Any) -> bool:
    """Whether the robot moves in the picture's plane only: no joint turns or shifts it out of that plane.

    Joints are looked at where the model's own pose has them, so a robot counts as planar if all hinges are parallel to
    the line of sight there, and all slides perpendicular to it.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    towards = np.abs(data.xaxis @ camera_axes(model)[2])
    hinges, slides = (model.jnt_type == kind for kind in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
    return bool(np.all(np.where(hinges, towards > PARALLEL, slides & (towards < 1 - PARALLEL))))


def find_rgba(model: Any, geom: int) -> np.ndarray:
    """The geom's own colour or that of its material, `[4]`."""
    material = model.geom_matid[geom]
    return model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]


def _find_motors(model: Any, axes: np.ndarray) -> list[Motor]:
    """The driven hinges whose axis points towards the viewer or away."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    motors = []
    for command, (joint, _) in enumerate(model.actuator_trnid):
        if model.actuator_trntype[command] != mujoco.mjtTrn.mjTRN_JOINT:
            continue
        towards = float(data.xaxis[joint] @ axes[2])
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE and abs(towards) > PARALLEL:
            motors.append(Motor(command, int(joint), 1 if towards > 0 else -1))
    return motors


def axis_labels(axes: np.ndarray) -> tuple[str, str]:
    """Labels of a picture's horizontal and vertical axis: an axis of the world, or else a direction.

    >>> axis_labels(SIDE), axis_labels(-SIDE), axis_labels(np.array([[0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]))
    (('x [m]', 'z [m]'), ('\u2212x [m]', '\u2212z [m]'), ('to the right [m]', 'z [m]'))
    """
    names = []
    for direction, default in zip(axes[:2], ("to the right", "upwards"), strict=True):
        axis = int(np.argmax(np.abs(direction)))
        sign = "" if direction[axis] > 0 else "\u2212"
        names.append(f"{sign}{AXES[axis]} [m]" if abs(direction[axis]) > 1 - 1e-6 else f"{default} [m]")
    return names[0], names[1]


def draw(picture: Picture, qpos: np.ndarray, goal: np.ndarray | None = None) -> Frames:
    """What the camera sees at the joint positions `[F, nq]`, and of the goal `[F, 3]`, which does not move.

    A robot that travels is kept in the middle. Positions that are not finite are replaced by the previous ones.
    """
    model, data = picture.model, mujoco.MjData(picture.model)
    joints, numbers = [motor.joint for motor in picture.motors], [part.number for part in picture.parts]
    place, turn = np.zeros((len(qpos), len(numbers), 3)), np.zeros((len(qpos), len(numbers), 3, 3))
    anchors = np.zeros((len(qpos), len(joints), 3))
    for i, q in enumerate(fill_gaps(qpos, model.qpos0)):
        data.qpos = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)  # for the centres of the bodies
        positions, rotations = (data.xipos, data.ximat) if picture.of_bodies else (data.geom_xpos, data.geom_xmat)
        place[i], turn[i] = positions[numbers], rotations[numbers].reshape(-1, 3, 3)
        anchors[i] = data.xanchor[joints]
    plane = picture.axes[:2]
    frames = Frames(
        place @ plane.T, plane @ turn, anchors @ plane.T, None if goal is None else _project_goal(plane, goal)
    )
    return _center(picture, frames)


def fill_gaps(qpos: np.ndarray, first: np.ndarray) -> Iterator[np.ndarray]:
    """Each position, or the last finite one before it."""
    for q in qpos:
        first = q if np.isfinite(q).all() else first
        yield first


def _project_goal(plane: np.ndarray, goal: np.ndarray) -> np.ndarray | None:
    return plane @ goal[0] if np.isfinite(goal[0]).all() else None


def outline_points(picture: Picture, frames: Frames) -> np.ndarray:
    """The points of all parts, `[F, K, 2]`."""
    part_points = [
        frames.place[:, i, None] + np.einsum("fij,kj->fki", frames.turn[:, i], part.points)
        for i, part in enumerate(picture.parts)
    ]
    return np.concatenate(part_points, axis=1)


def _center(picture: Picture, frames: Frames) -> Frames:
    """Keeps a travelling robot in the middle of the picture, and everything within `MAX_REACH`."""
    middle = find_center(outline_points(picture, frames))
    reach = MAX_REACH * max(float(picture.model.stat.extent), 1.0)
    center = picture.axes[:2] @ picture.model.stat.center
    place, motors = (
        np.clip(x - middle[:, None], center - reach, center + reach) for x in (frames.place, frames.motors)
    )
    return frames._replace(place=place, motors=motors)


def find_center(points: np.ndarray) -> np.ndarray:
    """The middle of the picture in each frame, `[F, 2]`: it follows a travelling robot, else it is the origin."""
    place = np.zeros((len(points), 2))
    if np.ptp(points[..., 0]) > TRAVEL * np.ptp(points, axis=1).max():
        place[:, 0] = points[..., 0].mean(axis=1)
    return place


def extent(picture: Picture, frames: list[Frames], margin: float) -> list[float]:
    """The rectangle around everything that is drawn: x_min, y_min, x_max, y_max.

    Args:
      picture: what is drawn.
      frames: frames that share the rectangle.
      margin: margin around them, as a fraction of the larger side.
    """
    rim = np.repeat([part.radius for part in picture.parts], [len(part.points) for part in picture.parts])[:, None]
    outlines = [outline_points(picture, one) for one in frames]
    corners = [(one + sign * rim).reshape(-1, 2) for one in outlines for sign in (-1, 1)]
    corners += [one.goal[None] for one in frames if one.goal is not None]
    low, high = np.concatenate(corners).min(axis=0), np.concatenate(corners).max(axis=0)
    size = float(np.max(high - low))
    space = margin * size if size else 1.0  # around a single point
    return [*(low - space).tolist(), *(high + space).tolist()]
