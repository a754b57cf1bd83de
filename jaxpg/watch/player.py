"""Episodes as plain values for the page: the player, the phase portrait and the workspace."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from envs.scenes import PhasePlane, Scene, scene
from jaxpg.run.policies import StoredPolicy
from jaxpg.watch import drawing
from jaxpg.watch.clips import Clip, clip
from jaxpg.watch.curves import numbers
from jaxpg.watch.recording import Recording, value_map

Json = dict[str, Any]
SHOWN = 6  # episodes of each policy
FRAMES = 300  # of an episode
GRID = 81  # points of each axis of the value's map
MARGIN = 0.1  # around what is drawn, of its size
INT16 = 2**15 - 1


def episodes(stages: Mapping[str, StoredPolicy], recordings: Sequence[Recording]) -> Json:
    """`player`, `portrait` and `workspace` of the page; None where the environment has no such thing.

    Args:
      stages: policies of one agent by what they are called.
      recordings: of each, from the same starts.
    """
    stored = next(iter(stages.values()))
    view, plane = scene(stored.env), getattr(stored.env, "phase_plane", None)
    return {
        "player": _player(view, plane, stages, recordings) if view else None,
        "portrait": _portrait(plane, stages) if plane else None,
        "workspace": _workspace(view, recordings)
        if view and view.goal and "success" in recordings[0].metrics
        else None,
    }


def _player(
    view: Scene, plane: PhasePlane | None, stages: Mapping[str, StoredPolicy], recordings: Sequence[Recording]
) -> Json:
    stored = next(iter(stages.values()))
    stage_clips = [
        [clip(stage, recording, i, FRAMES) for i in range(min(SHOWN, len(recording.length)))]
        for stage, recording in zip(stages.values(), recordings, strict=True)
    ]
    picture = drawing.picture(view.model)
    drawn = [[drawing.draw(picture, one.look.qpos, one.look.goal) for one in clips] for clips in stage_clips]
    names, limits = stored.interface.commands, stored.interface.limits
    return {
        "dt": stage_clips[0][0].dt,
        "view": drawing.extent([frames for several in drawn for frames in several], picture.radius, MARGIN),
        "parts": [{"radius": float(r), "color": c} for r, c in zip(picture.radius, picture.color, strict=True)],
        "motors": [
            {"name": names[motor.command], "limit": limits and limits[motor.command], "sign": motor.sign}
            for motor in picture.motors
        ],
        "goal_radius": view.goal_radius,
        "series": list(stage_clips[0][0].series),
        "policies": [
            {
                "label": label,
                "note": f"{stage.update:,} updates",
                "episodes": [_episode(one, frames, plane) for one, frames in zip(clips, several, strict=True)],
            }
            for (label, stage), clips, several in zip(stages.items(), stage_clips, drawn, strict=True)
        ],
    }


def _episode(one: Clip, frames: drawing.Frames, plane: PhasePlane | None) -> Json:
    points = [x for x in (frames.parts, frames.motors) if x.size]
    scale = max(float(np.abs(x).max()) for x in points) / INT16
    return {
        "return": one.episode_return,
        "success": one.success,
        "so_far": numbers(one.so_far),
        "frames": len(frames.parts),
        "scale": scale,
        "parts": packed(frames.parts / scale),
        "motors": packed(frames.motors / scale),
        "goal": None if frames.goal is None else numbers(frames.goal),
        "series": {name: numbers(values) for name, values in one.series.items()},
        "path": numbers(in_plane(plane, one.look.plane).T) if plane else None,
    }


def _portrait(plane: PhasePlane, stages: Mapping[str, StoredPolicy]) -> Json:
    stored = next(iter(stages.values()))
    maps = value_map(stored, [stage.policy for stage in stages.values()], GRID, GRID)
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
    axes = drawing.camera(view.model)
    points = []
    for recording in recordings:
        last, every = recording.length - 1, np.arange(len(recording.length))
        goals = recording.look.goal[0] @ axes[:2].T
        distance, success = (recording.metrics[name][last, every] for name in ("distance", "success"))
        points.append(numbers(np.column_stack([goals, distance, success])))
    reach = max(float(np.hypot(*np.array(found)[:, :2].T).max()) for found in points)
    return {
        "title": "success over the workspace",
        **{"x": "x [m]", "y": "y [m]", "radius": reach, "success_radius": view.goal_radius, "points": points},
    }


def packed(values: np.ndarray) -> str:
    """Numbers within +-32767 as base64 of little-endian int16."""
    return base64.b64encode(np.rint(values).astype("<i2").tobytes()).decode("ascii")
