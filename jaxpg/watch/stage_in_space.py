"""What the page's player is given of a robot in space: its bodies, joints and shapes, and joint positions.

The page computes where the bodies are from the joint positions, which are far fewer numbers than the bodies' poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from envs.scenes import Scene
from jaxpg.watch import solids, space
from jaxpg.watch.clips import Clip
from jaxpg.watch.curves import round_numbers
from jaxpg.watch.packing import INT16, pack, pack_columns
from jaxpg.watch.solids import Part
from jaxpg.watch.space import Framing

Json = dict[str, Any]
KINDS = {
    mujoco.mjtJoint.mjJNT_FREE: "free",
    mujoco.mjtJoint.mjJNT_BALL: "ball",
    mujoco.mjtJoint.mjJNT_SLIDE: "slide",
    mujoco.mjtJoint.mjJNT_HINGE: "hinge",
}


def make_stage(scene: Scene, stage_clips: Sequence[Sequence[Clip]]) -> tuple[Json, list[list[Json]]]:
    """What all episodes have in common, and what is drawn of each episode of each policy."""
    model = scene.model
    parts = solids.make_parts(model)
    framing = space.make_framing(model, parts, [one.look for clips in stage_clips for one in clips])
    common = {
        "center": round_numbers(framing.center),
        "radius": framing.radius,
        "azimuth": framing.azimuth,
        "elevation": framing.elevation,
        "ground": framing.ground,
        "bodies": _list_bodies(model),
        "joints": _list_joints(model),
        "parts": [_describe_part(part) for part in parts],
        "site": None if scene.site is None else _describe_site(model, scene.site),
    }
    episodes = [[_draw_episode(model, parts, framing, one) for one in clips] for clips in stage_clips]
    return {"space": common, "motors": []}, episodes


def _list_bodies(model: Any) -> list[Json]:
    """Parent, position and quaternion of each body but the world, the parents first; the world is number 0."""
    return [
        {
            "parent": int(model.body_parentid[i]),
            "position": round_numbers(model.body_pos[i]),
            "turn": round_numbers(model.body_quat[i]),
        }
        for i in range(1, model.nbody)
    ]


def _list_joints(model: Any) -> list[Json]:
    """Kind, body, first number in the joint positions, and place, axis and reference of each joint."""
    return [
        {
            "kind": KINDS[mujoco.mjtJoint(int(model.jnt_type[i]))],
            "body": int(model.jnt_bodyid[i]),
            "first": int(model.jnt_qposadr[i]),
            "position": round_numbers(model.jnt_pos[i]),
            "axis": round_numbers(model.jnt_axis[i]),
            "reference": float(model.qpos0[model.jnt_qposadr[i]]),
        }
        for i in range(model.njnt)
    ]


def _describe_part(part: Part) -> Json:
    unit = max(float(np.abs(part.solid.vertices).max()), 1e-9) / INT16
    return {
        "body": part.body,
        "color": part.color,
        "unit": float(f"{unit:.8g}"),
        "vertices": pack(part.solid.vertices / unit),
        "triangles": pack(part.solid.triangles),
    }


def _describe_site(model: Any, site: int) -> Json:
    return {
        "body": int(model.site_bodyid[site]),
        "position": round_numbers(model.site_pos[site]),
        "turn": round_numbers(model.site_quat[site]),
    }


def _draw_episode(model: Any, parts: Sequence[Part], framing: Framing, one: Clip) -> Json:
    qpos = space.tame(model, one.look.qpos)
    packed, units = pack_columns(qpos)
    shifts = space.find_shifts(model, parts, qpos, framing)
    packed_shifts, shift_units = (None, None) if shifts is None else pack_columns(shifts[:, :2])
    return {
        "frames": len(qpos),
        "qpos": packed,
        "units": units,
        "shifts": packed_shifts,
        "shift_units": shift_units,
        "goals": _list_changes(one.look.goal),
        "turns": _list_changes(one.look.rotation),
    }


def _list_changes(values: np.ndarray | None) -> list | None:
    """One row for each frame, or a single one if all are equal; None without finite values."""
    if values is None or not np.isfinite(values).all():
        return None
    rows = np.asarray(values, float).reshape(len(values), -1)
    return round_numbers(rows if np.ptp(rows, axis=0).any() else rows[:1])
