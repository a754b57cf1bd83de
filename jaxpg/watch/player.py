"""Episodes as plain values for the page: the player, the phase portrait and the workspace."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from envs.scenes import PhasePlane, Scene
from jaxpg.store.policies import StoredPolicy
from jaxpg.watch import drawing
from jaxpg.watch.attempts import NotDrawn, attempt
from jaxpg.watch.clips import Clip, clip, command_names, limits_of
from jaxpg.watch.curves import numbers
from jaxpg.watch.recording import Recording, value_map
from jaxpg.watch.seen import Seen

Json = dict[str, Any]
SHOWN = 6  # episodes of each policy
FRAMES = 300  # of an episode
GRID = 81  # points of each axis of the value's map
MARGIN = 0.1  # around what is drawn, of its size
INT16 = 2**15 - 1


def episodes(
    view: Seen, stages: Mapping[str, StoredPolicy], recordings: Sequence[Recording], say: Callable[[str], None]
) -> Json:
    """`player`, `portrait` and `workspace` of the page; None where the environment has no such thing.

    Args:
      view: what can be seen of the environment.
      stages: policies of one agent by what they are called.
      recordings: of each, from the same starts.
      say: takes a line for each thing that there is, but that cannot be drawn.
    """
    scene, plane = view
    metrics = recordings[0].metrics
    has_workspace = scene and scene.goal and "success" in metrics
    return {
        "player": attempt("episodes", lambda: _player(view, stages, recordings, say), say) if scene else None,
        "portrait": attempt("phase portrait", lambda: _portrait(plane, stages), say) if plane else None,
        "workspace": attempt("workspace", lambda: _workspace(scene, recordings), say) if has_workspace else None,
    }


def _player(
    view: Seen, stages: Mapping[str, StoredPolicy], recordings: Sequence[Recording], say: Callable[[str], None]
) -> Json:
    stored = next(iter(stages.values()))
    stage_clips = [
        [clip(stage, recording, i, FRAMES) for i in range(min(SHOWN, len(recording.length)))]
        for stage, recording in zip(stages.values(), recordings, strict=True)
    ]
    picture = drawing.picture(view.scene.model)
    drawn = [[drawing.draw(picture, one.look.qpos, one.look.goal) for one in clips] for clips in stage_clips]
    motors = attempt("motors", lambda: _motors(stored, picture), say) or []
    return {
        "dt": stage_clips[0][0].dt,
        "view": drawing.extent(picture, [frames for several in drawn for frames in several], MARGIN),
        "parts": [
            {"points": numbers(part.points), "radius": part.radius, "color": part.color} for part in picture.parts
        ],
        "motors": motors,
        "limits": _limits(stored),
        "goal_radius": view.scene.goal_radius and float(view.scene.goal_radius),
        "series": list(stage_clips[0][0].series),
        "policies": [
            {
                "label": label,
                "note": f"{stage.update:,} updates",
                "episodes": [
                    _episode(one, frames, view.plane, bool(motors)) for one, frames in zip(clips, several, strict=True)
                ],
            }
            for (label, stage), clips, several in zip(stages.items(), stage_clips, drawn, strict=True)
        ],
    }


def _motors(stored: StoredPolicy, picture: drawing.Picture) -> list[Json]:
    """The driven hinges with their commands, where each command is that of the actuator with its number."""
    names, number = command_names(stored), picture.model.nu
    if len(names) != number:
        commands = "command" if len(names) == 1 else "commands"
        raise NotDrawn(f"the policy has {len(names)} {commands}, the model {number} actuators: which drives which?")
    limits = _limits(stored)
    return [
        {"name": names[motor.command], "limit": limits.get(names[motor.command]), "sign": motor.sign}
        for motor in picture.motors
    ]


def _limits(stored: StoredPolicy) -> dict[str, float]:
    """The limit of each command; empty where they have none."""
    if stored.interface.limits is None:
        return {}
    return dict(zip(command_names(stored), limits_of(stored).tolist(), strict=True))


def _episode(one: Clip, frames: drawing.Frames, plane: PhasePlane | None, has_motors: bool) -> Json:
    parts = np.concatenate([frames.place, frames.turn.reshape(*frames.turn.shape[:2], 6)], axis=2)
    motors = frames.motors if has_motors else frames.motors[:, :0]
    scale = max(float(np.abs(x).max()) for x in (parts, motors) if x.size) / INT16
    return {
        "return": one.episode_return,
        "success": one.success,
        "so_far": numbers(one.so_far),
        "frames": len(parts),
        "scale": scale,
        "parts": packed(parts / scale),
        "motors": packed(motors / scale),
        "goal": None if frames.goal is None else numbers(frames.goal),
        "series": {name: numbers(values) for name, values in one.series.items()},
        "path": numbers(in_plane(plane, one.look.plane).T) if plane else None,
    }


def _portrait(plane: PhasePlane, stages: Mapping[str, StoredPolicy]) -> Json:
    stored = next(iter(stages.values()))
    maps = value_map(stored, [stage.policy for stage in stages.values()], GRID, GRID)
    if not np.isfinite(maps).all():
        raise NotDrawn("the critic's values are not finite everywhere")
    axes = [
        {"label": label, "range": list(ends), "wraps": wraps}
        for label, ends, wraps in zip(plane.labels, plane.ranges, plane.wraps, strict=True)
    ]
    grids = []
    for values in maps:
        low, high = float(values.min()), float(values.max())
        grids.append({"low": low, "high": high, "data": packed((values - low) / max(high - low, 1e-9) * INT16)})
    return {
        "title": "value and phase portrait",
        **{"x": axes[0], "y": axes[1], "columns": GRID, "rows": GRID, "values": grids},
    }


def in_plane(plane: PhasePlane, coordinates: np.ndarray) -> np.ndarray:
    """Coordinates `[..., 2]`, those that wrap within their range."""
    found = np.array(coordinates, float)
    for i, ((low, high), wraps) in enumerate(zip(plane.ranges, plane.wraps, strict=True)):
        if wraps:
            found[..., i] = (found[..., i] - low) % (high - low) + low
    return found


def _workspace(view: Scene, recordings: Sequence[Recording]) -> Json:
    """Where the goals lay, how far from them the episodes ended if the environment says so, and which were reached."""
    axes = drawing.camera(view.model)
    points = [_goals(recording, axes[:2]) for recording in recordings]
    reach = max(float(np.hypot(*found[:, :2].T).max(initial=0.0)) for found in points)
    x, y = drawing.axis_labels(axes)
    radius = view.goal_radius and float(view.goal_radius)
    return {
        "title": "success over the workspace",
        **{"x": x, "y": y, "radius": max(reach, 2 * (radius or 0.0)) or 1.0, "success_radius": radius},
        "points": [numbers(found) for found in points],
    }


def _goals(recording: Recording, plane: np.ndarray) -> np.ndarray:
    """A row for each episode whose goal is a place: its two coordinates, the last distance, and success; `[K, 4]`."""
    last, every = recording.length - 1, np.arange(len(recording.length))
    goals = recording.look.goal[0] @ plane.T
    success = np.nan_to_num(recording.metrics["success"][last, every].astype(float))
    distance = recording.metrics.get("distance")
    distance = np.full(len(every), np.nan) if distance is None else distance[last, every]
    return np.column_stack([goals, distance, success])[np.isfinite(goals).all(axis=1)]


def packed(values: np.ndarray) -> str:
    """Numbers within +-32767 as base64 of little-endian int16."""
    return base64.b64encode(np.rint(values).astype("<i2").tobytes()).decode("ascii")
