"""What the page's player is given of a robot in the plane: outlines, and where they are in each frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from envs.scenes import Scene
from jaxpg.store.policies import StoredPolicy
from jaxpg.watch import drawing
from jaxpg.watch.attempts import DrawingError, attempt
from jaxpg.watch.clips import Clip, find_command_names, list_limits
from jaxpg.watch.curves import round_numbers
from jaxpg.watch.packing import INT16, pack

Json = dict[str, Any]
MARGIN = 0.1  # around the drawing, as a fraction of its size


def make_stage(
    scene: Scene, stored: StoredPolicy, stage_clips: Sequence[Sequence[Clip]], say: Callable[[str], None]
) -> tuple[Json, list[list[Json]]]:
    """What all episodes have in common, and what is drawn of each episode of each policy."""
    picture = drawing.make_picture(scene.model)
    stage_frames = [[drawing.draw(picture, one.look.qpos, one.look.goal) for one in clips] for clips in stage_clips]
    motors = attempt("motors", lambda: _list_motors(stored, picture), say) or []
    common = {
        "view": drawing.extent(picture, [frames for several in stage_frames for frames in several], MARGIN),
        "parts": [
            {"points": round_numbers(part.points), "radius": part.radius, "color": part.color} for part in picture.parts
        ],
        "motors": motors,
    }
    return common, [[_draw_episode(frames, bool(motors)) for frames in several] for several in stage_frames]


def _list_motors(stored: StoredPolicy, picture: drawing.Picture) -> list[Json]:
    """The driven hinges with their commands, if command i belongs to actuator i."""
    names, number = find_command_names(stored), picture.model.nu
    if len(names) != number:
        commands = "command" if len(names) == 1 else "commands"
        raise DrawingError(f"the policy has {len(names)} {commands}, the model {number} actuators: cannot match them")
    limits = list_limits(stored)
    return [
        {"name": names[motor.command], "limit": limits.get(names[motor.command]), "sign": motor.sign}
        for motor in picture.motors
    ]


def _draw_episode(frames: drawing.Frames, has_motors: bool) -> Json:
    parts = np.concatenate([frames.place, frames.turn.reshape(*frames.turn.shape[:2], 6)], axis=2)
    motors = frames.motors if has_motors else frames.motors[:, :0]
    scale = max(float(np.abs(x).max()) for x in (parts, motors) if x.size) / INT16
    return {
        "frames": len(parts),
        "scale": scale,
        "parts": pack(parts / scale),
        "motors": pack(motors / scale),
        "goal": None if frames.goal is None else round_numbers(frames.goal),
    }
