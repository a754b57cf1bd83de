"""Data of episodes for the page: the player, the phase portrait and the workspace."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from envs.scenes import PhasePlane, Scene
from jaxpg.store.policies import StoredPolicy
from jaxpg.watch import drawing
from jaxpg.watch.attempts import DrawingError, attempt
from jaxpg.watch.clips import Clip, find_command_names, find_limits, make_clip
from jaxpg.watch.curves import round_numbers
from jaxpg.watch.recording import Recording, compute_value_map
from jaxpg.watch.view import View

Json = dict[str, Any]
MAX_EPISODES = 6  # episodes of each policy
MAX_FRAMES = 300  # of an episode
GRID = 81  # points on each axis of the value map
MARGIN = 0.1  # around the drawing, as a fraction of its size
INT16 = 2**15 - 1


def build_player(
    view: View, stages: Mapping[str, StoredPolicy], recordings: Sequence[Recording], say: Callable[[str], None]
) -> Json:
    """`player`, `portrait` and `workspace` of the page; None for what the environment lacks.

    Args:
      view: what can be drawn of the environment.
      stages: label -> policy of one agent.
      recordings: a recording of each, from the same starts.
      say: takes a line for each thing that exists but cannot be drawn.
    """
    scene, plane = view
    metrics = recordings[0].metrics
    made: Json = {"player": None, "portrait": None, "workspace": None}
    if scene:
        made["player"] = attempt("episodes", lambda: _make_player(scene, plane, stages, recordings, say), say)
    if plane:
        made["portrait"] = attempt("phase portrait", lambda: _make_portrait(plane, stages), say)
    if scene and scene.goal and "success" in metrics:
        made["workspace"] = attempt("workspace", lambda: _make_workspace(scene, recordings), say)
    return made


def _make_player(
    scene: Scene,
    plane: PhasePlane | None,
    stages: Mapping[str, StoredPolicy],
    recordings: Sequence[Recording],
    say: Callable[[str], None],
) -> Json:
    stored = next(iter(stages.values()))
    stage_clips = [
        [make_clip(stage, recording, i, MAX_FRAMES) for i in range(min(MAX_EPISODES, len(recording.length)))]
        for stage, recording in zip(stages.values(), recordings, strict=True)
    ]
    picture = drawing.make_picture(scene.model)
    stage_frames = [[drawing.draw(picture, one.look.qpos, one.look.goal) for one in clips] for clips in stage_clips]
    motors = attempt("motors", lambda: _list_motors(stored, picture), say) or []
    return {
        "dt": stage_clips[0][0].dt,
        "view": drawing.extent(picture, [frames for several in stage_frames for frames in several], MARGIN),
        "parts": [
            {"points": round_numbers(part.points), "radius": part.radius, "color": part.color} for part in picture.parts
        ],
        "motors": motors,
        "limits": _list_limits(stored),
        "goal_radius": scene.goal_radius and float(scene.goal_radius),
        "series": list(stage_clips[0][0].series),
        "policies": [
            {
                "label": label,
                "note": f"{stage.update:,} updates",
                "episodes": [
                    _make_episode(one, frames, plane, bool(motors)) for one, frames in zip(clips, several, strict=True)
                ],
            }
            for (label, stage), clips, several in zip(stages.items(), stage_clips, stage_frames, strict=True)
        ],
    }


def _list_motors(stored: StoredPolicy, picture: drawing.Picture) -> list[Json]:
    """The driven hinges with their commands, if command i belongs to actuator i."""
    names, number = find_command_names(stored), picture.model.nu
    if len(names) != number:
        commands = "command" if len(names) == 1 else "commands"
        raise DrawingError(f"the policy has {len(names)} {commands}, the model {number} actuators: cannot match them")
    limits = _list_limits(stored)
    return [
        {"name": names[motor.command], "limit": limits.get(names[motor.command]), "sign": motor.sign}
        for motor in picture.motors
    ]


def _list_limits(stored: StoredPolicy) -> dict[str, float]:
    """The limit of each command; empty if there are none."""
    if stored.interface.limits is None:
        return {}
    return dict(zip(find_command_names(stored), find_limits(stored).tolist(), strict=True))


def _make_episode(one: Clip, frames: drawing.Frames, plane: PhasePlane | None, has_motors: bool) -> Json:
    parts = np.concatenate([frames.place, frames.turn.reshape(*frames.turn.shape[:2], 6)], axis=2)
    motors = frames.motors if has_motors else frames.motors[:, :0]
    scale = max(float(np.abs(x).max()) for x in (parts, motors) if x.size) / INT16
    return {
        "return": one.episode_return,
        "success": one.success,
        "so_far": round_numbers(one.so_far),
        "frames": len(parts),
        "scale": scale,
        "parts": pack(parts / scale),
        "motors": pack(motors / scale),
        "goal": None if frames.goal is None else round_numbers(frames.goal),
        "series": {name: round_numbers(values) for name, values in one.series.items()},
        "path": round_numbers(wrap_coordinates(plane, one.look.plane).T) if plane else None,
    }


def _make_portrait(plane: PhasePlane, stages: Mapping[str, StoredPolicy]) -> Json:
    stored = next(iter(stages.values()))
    maps = compute_value_map(stored, [stage.policy for stage in stages.values()], GRID, GRID)
    if not np.isfinite(maps).all():
        raise DrawingError("the critic's values are not finite everywhere")
    axes = [
        {"label": label, "range": list(ends), "wraps": wraps}
        for label, ends, wraps in zip(plane.labels, plane.ranges, plane.wraps, strict=True)
    ]
    grids = []
    for values in maps:
        low, high = float(values.min()), float(values.max())
        grids.append({"low": low, "high": high, "data": pack((values - low) / max(high - low, 1e-9) * INT16)})
    return {
        "title": "value and phase portrait",
        **{"x": axes[0], "y": axes[1], "columns": GRID, "rows": GRID, "values": grids},
    }


def wrap_coordinates(plane: PhasePlane, coordinates: np.ndarray) -> np.ndarray:
    """Coordinates `[..., 2]`, with those that wrap brought into their range."""
    wrapped = np.array(coordinates, float)
    for i, ((low, high), wraps) in enumerate(zip(plane.ranges, plane.wraps, strict=True)):
        if wraps:
            wrapped[..., i] = (wrapped[..., i] - low) % (high - low) + low
    return wrapped


def _make_workspace(scene: Scene, recordings: Sequence[Recording]) -> Json:
    """Positions of the goals, final distances if the environment reports them, and which goals were reached."""
    axes = drawing.camera_axes(scene.model)
    points = [_list_goals(recording, axes[:2]) for recording in recordings]
    reach = max(float(np.hypot(*goals[:, :2].T).max(initial=0.0)) for goals in points)
    x, y = drawing.axis_labels(axes)
    radius = scene.goal_radius and float(scene.goal_radius)
    return {
        "title": "success over the workspace",
        **{"x": x, "y": y, "radius": max(reach, 2 * (radius or 0.0)) or 1.0, "success_radius": radius},
        "points": [round_numbers(goals) for goals in points],
    }


def _list_goals(recording: Recording, plane: np.ndarray) -> np.ndarray:
    """A row for each episode with a finite goal: two coordinates, final distance, and success; `[K, 4]`."""
    last, episodes = recording.length - 1, np.arange(len(recording.length))
    goals = recording.look.goal[0] @ plane.T
    success = np.nan_to_num(recording.metrics["success"][last, episodes].astype(float))
    distance = recording.metrics.get("distance")
    distance = np.full(len(episodes), np.nan) if distance is None else distance[last, episodes]
    return np.column_stack([goals, distance, success])[np.isfinite(goals).all(axis=1)]


def pack(values: np.ndarray) -> str:
    """Numbers within +-32767 as base64 of little-endian int16."""
    return base64.b64encode(np.rint(values).astype("<i2").tobytes()).decode("ascii")
