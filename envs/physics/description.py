"""What a model consists of, and how `compile_step` steps it."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from envs.physics.collision import change_collision, list_colliding_meshes
from envs.physics.models import model_name
from envs.physics.pairs import candidate_pairs, colliding_pairs
from envs.physics.step import count_equations, find_reason

if TYPE_CHECKING:
    import mujoco


@dataclasses.dataclass(frozen=True)
class Description:
    """Numbers of a model's parts, and how its step is computed.

    `pairs` of geoms collide by MuJoCo's rules, `candidates` of them can meet, without meshes; `meshes` collide.
    `physics` is "scalar" or "mujoco", the latter for the `reason`; a scalar step has so many `equations`.
    """

    name: str
    bodies: int
    dofs: int
    actuators: int
    sensors: int
    equalities: int
    limits: int
    pairs: int
    candidates: int
    meshes: int
    physics: str
    equations: int
    reason: str


def describe(
    model: mujoco.MjModel,
    inputs: tuple[str, ...] = ("qpos", "qvel", "ctrl"),
    outputs: tuple[str, ...] = ("qpos", "qvel"),
) -> Description:
    """Describes a model, and the step that `compile_step(model, inputs=inputs, outputs=outputs)` makes of it.

    The activations of actuators that have some are added to the inputs.
    """
    if model.na and "act" not in inputs:
        inputs = (*inputs, "act")
    scalar = change_collision(model, "primitives")
    reason = find_reason(scalar, inputs, outputs)
    return Description(
        name=model_name(model),
        bodies=model.nbody - 1,
        dofs=model.nv,
        actuators=model.nu,
        sensors=model.nsensor,
        equalities=model.neq,
        limits=int(model.jnt_limited.sum() + model.tendon_limited.sum()),
        pairs=len(colliding_pairs(model)),
        candidates=len(candidate_pairs(scalar)),
        meshes=len(list_colliding_meshes(model)),
        physics="mujoco" if reason else "scalar",
        equations=0 if reason else count_equations(scalar, inputs, outputs),
        reason=reason,
    )
