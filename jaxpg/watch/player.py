"""Data of episodes for the page: the player, the phase portrait and the workspace."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from envs.scenes import PhasePlane, Scene
from jaxpg.store.policies import StoredPolicy
from jaxpg.watch import stage_in_plane, stage_in_space
from jaxpg.watch.attempts import DrawingError, attempt
from jaxpg.watch.clips import Clip, list_limits, make_clip
from jaxpg.watch.curves import round_numbers
from jaxpg.watch.drawing import is_planar
from jaxpg.watch.packing import INT16, pack
from jaxpg.watch.recording import Recording, compute_value_map
from jaxpg.watch.view import View
from jaxpg.watch.workspace import make_workspace

Json = dict[str, Any]
MAX_EPISODES = 6  # episodes of each policy
MAX_FRAMES = 300  # of an episode
GRID = 81  # points on each axis of the value map


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
        made["workspace"] = attempt("workspace", lambda: make_workspace(scene, recordings, MAX_EPISODES), say)
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
    if is_planar(scene.model):
        common, drawn = stage_in_plane.make_stage(scene, stored, stage_clips, say)
    else:
        common, drawn = stage_in_space.make_stage(scene, stage_clips)
    return {
        "dt": stage_clips[0][0].dt,
        "limits": list_limits(stored),
        "goal_radius": scene.goal_radius and float(scene.goal_radius),
        "series": list(stage_clips[0][0].series),
        **common,
        "policies": [
            {
                "label": label,
                "note": f"{stage.update:,} updates",
                "episodes": [_make_episode(one, plane) | picture for one, picture in zip(clips, pictures, strict=True)],
            }
            for (label, stage), clips, pictures in zip(stages.items(), stage_clips, drawn, strict=True)
        ],
    }


def _make_episode(one: Clip, plane: PhasePlane | None) -> Json:
    return {
        "return": one.episode_return,
        "success": one.success,
        "so_far": round_numbers(one.so_far),
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
