"""Where the goals of many episodes were, and which of them were reached: from the side that a person understands.

The goals of a planar robot are shown in its plane. Those of a robot in space are shown twice, from above and from the
side. From above are x and y. From the side are the height and the distance r from the vertical line through the robot's
base: what an arm that turns about this line can reach is nearly the same in all directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from envs.scenes import Scene
from jaxpg.watch import drawing
from jaxpg.watch.curves import round_numbers
from jaxpg.watch.recording import Recording

Json = dict[str, Any]
TITLE = "success over the workspace"
ROOM = 1.08  # around the goals


def make_workspace(scene: Scene, recordings: Sequence[Recording], shown: int) -> Json:
    """Positions of the goals, final distances if the environment reports them, and which goals were reached.

    Args:
      scene: the robot, with a goal.
      recordings: episodes of each policy.
      shown: how many of the episodes are played on the page; their goals can be marked.
    """
    radius = scene.goal_radius and float(scene.goal_radius)
    look = _look_at_plane if drawing.is_planar(scene.model) else _look_at_space
    pictures = look(scene, recordings, radius)
    ends = [np.column_stack([_find_distances(one), _find_success(one)]) for one in recordings]
    masks = [np.atleast_1d(np.isfinite(find_last_goals(one)).all(axis=1)) for one in recordings]
    for picture in pictures:
        spots = picture.pop("spots")
        picture["points"] = [
            round_numbers(np.column_stack([spot, end])[np.flatnonzero(mask)])
            for spot, end, mask in zip(spots, ends, masks, strict=True)
        ]
        picture["chosen"] = [
            [spot[i].tolist() if mask[i] else None for i in range(min(shown, len(spot)))]
            for spot, mask in zip(spots, masks, strict=True)
        ]
    return {"title": TITLE, "success_radius": radius, "pictures": pictures}


def _look_at_plane(scene: Scene, recordings: Sequence[Recording], radius: float | None) -> list[Json]:
    """The plane of the picture, about its origin."""
    axes = drawing.camera_axes(scene.model)
    spots = [find_last_goals(recording) @ axes[:2].T for recording in recordings]
    x, y = drawing.axis_labels(axes)
    return [_surround(x, y, spots, np.zeros(2), radius)]


def _look_at_space(scene: Scene, recordings: Sequence[Recording], radius: float | None) -> list[Json]:
    """From above about the base, and from the side unless all goals are equally high."""
    base = find_base(scene.model)
    goals = [find_last_goals(recording) for recording in recordings]
    above = _surround("x [m]", "y [m]", [one[:, :2] for one in goals], base[:2], radius)
    sides = [np.column_stack([np.hypot(*(one[:, :2] - base[:2]).T), one[:, 2]]) for one in goals]
    if np.ptp(_keep_finite(sides)[:, 1]) < 1e-6:
        return [above]
    return [above, _make_side(sides)]


def _surround(x: str, y: str, spots: Sequence[np.ndarray], middle: np.ndarray, radius: float | None) -> Json:
    """A square about a middle, with the circle through the farthest goal."""
    reach = max(float(np.hypot(*(_keep_finite(spots) - middle).T).max(initial=0.0)), 2 * (radius or 0.0)) or 1.0
    ranges = [[float(m - ROOM * reach), float(m + ROOM * reach)] for m in middle]
    circle = [*middle.tolist(), reach]
    return {"x": x, "y": y, "x_range": ranges[0], "y_range": ranges[1], "circle": circle, "spots": list(spots)}


def _make_side(spots: Sequence[np.ndarray]) -> Json:
    """Distance from the vertical line and height; from the line itself and from the ground on."""
    (_, low), (far, high) = _keep_finite(spots).min(axis=0), _keep_finite(spots).max(axis=0)
    low, high = min(float(low), 0.0), max(float(high), 0.0)
    room = (ROOM - 1) * max(float(far), high - low)
    return {
        **{"x": "r [m], from the base's vertical", "y": "z [m]"},
        **{"x_range": [0.0, float(far) + room], "y_range": [low - room, high + room]},
        **{"circle": None, "spots": list(spots)},
    }


def _keep_finite(spots: Sequence[np.ndarray]) -> np.ndarray:
    """All finite spots `[K, 2]`; the origin if there are none."""
    together = np.concatenate(spots)
    finite = together[np.isfinite(together).all(axis=1)]
    return finite if len(finite) else np.zeros((1, 2))


def find_base(model: Any) -> np.ndarray:
    """Where a fixed robot turns first: the place of its first hinge, `[3]` [m]; the origin for other robots."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    if model.njnt and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_HINGE:
        return data.xanchor[0].copy()
    return np.zeros(3)


def find_last_goals(recording: Recording) -> np.ndarray:
    """The goal of each episode at its end, `[N, 3]` [m]."""
    return recording.look.goal[recording.length, np.arange(len(recording.length))]


def _find_success(recording: Recording) -> np.ndarray:
    """1 for success at the end, else 0, `[N]`."""
    last, episodes = recording.length - 1, np.arange(len(recording.length))
    return np.nan_to_num(recording.metrics["success"][last, episodes].astype(float))


def _find_distances(recording: Recording) -> np.ndarray:
    """Distances from the goal at the end, `[N]` [m]; NaN if the environment does not report them."""
    last, episodes = recording.length - 1, np.arange(len(recording.length))
    distance = recording.metrics.get("distance")
    return np.full(len(episodes), np.nan) if distance is None else distance[last, episodes]
