"""What of a model's geoms collides: all of them, all but meshes, meshes as fitted boxes and capsules, or none."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import numpy as np

from envs.physics.pairs import colliding_pairs

if TYPE_CHECKING:
    import mujoco

COLLISION = ("all", "hull", "primitives", "none")


def change_collision(model: mujoco.MjModel, collision: str) -> mujoco.MjModel:
    """The model with other collisions; a copy, unless nothing changes.

    Args:
      model: a compiled model.
      collision: "all": as in the model; "hull": each mesh that collides becomes a box or a capsule around it
        (`fit_meshes`); "primitives": meshes do not collide; "none": no geom does.

    Raises:
      ValueError: `collision` is unknown.
    """
    import mujoco

    if collision not in COLLISION:
        raise ValueError(f"collision is {collision!r}; it must be one of {', '.join(COLLISION)}")
    if collision == "none":
        model = copy.copy(model)
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        return model
    meshes = list_colliding_meshes(model)
    if collision == "all" or not meshes:
        return model
    return fit_meshes(model, meshes) if collision == "hull" else _leave_out(model, meshes)


def list_colliding_meshes(model: mujoco.MjModel) -> list[int]:
    """The geoms that are meshes and may touch another geom by MuJoCo's rules."""
    import mujoco

    geoms = {geom for pair in colliding_pairs(model) for geom in (pair.geom1, pair.geom2)}
    return [geom for geom in sorted(geoms) if model.geom_type[geom] == int(mujoco.mjtGeom.mjGEOM_MESH)]


def describe_meshes(model: mujoco.MjModel) -> str:
    """One phrase about the colliding meshes that scalar equations leave out; empty if there are none."""
    number = len(list_colliding_meshes(model))
    if not number:
        return ""
    return (
        f"{number} mesh{'' if number == 1 else 'es'} would collide, which scalar equations leave out "
        "(collision='hull' takes boxes and capsules around them)"
    )


def fit_meshes(model: mujoco.MjModel, meshes: list[int]) -> mujoco.MjModel:
    """A copy of the model in which meshes are boxes or capsules that enclose them, whichever has less volume.

    The box is the mesh's bounding box in the axes of its inertia, with half lengths `a >= b >= c`. The capsule has the
    same longest axis; its radius `r` is the largest distance of a vertex from that axis.
    """
    import mujoco

    fitted = copy.copy(model)
    for geom in meshes:
        centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        vertices = _get_vertices(model, geom) - centre
        longest = int(half.argmax())
        others = np.delete(np.arange(3), longest)
        radius = np.linalg.norm(vertices[:, others], axis=1).max()
        reach = np.sqrt(np.maximum(radius**2 - np.sum(vertices[:, others] ** 2, 1), 0))
        length = max(0.0, float((np.abs(vertices[:, longest]) - reach).max()))  # half of the segment
        is_capsule = np.pi * radius**2 * (2 * length + 4 / 3 * radius) < 8 * half.prod()
        turn = _turn_z_to(longest) if is_capsule else np.array([1.0, 0, 0, 0])
        _place(fitted, geom, centre, turn)
        kind = mujoco.mjtGeom.mjGEOM_CAPSULE if is_capsule else mujoco.mjtGeom.mjGEOM_BOX
        size = np.array([radius, length, 0]) if is_capsule else half
        fitted.geom_type[geom], fitted.geom_size[geom], fitted.geom_dataid[geom] = int(kind), size, -1
        fitted.geom_rbound[geom] = radius + length if is_capsule else np.linalg.norm(half)
        extent = np.array([radius, radius, radius + length]) if is_capsule else half
        fitted.geom_aabb[geom] = np.concatenate([np.zeros(3), extent])
    return _set_bounds(fitted)


def measure_fit(model: mujoco.MjModel, fitted: mujoco.MjModel, geom: int) -> float:
    """How far the fitted shape of a mesh stands out over the mesh's convex hull at most, in m.

    It is the largest difference of their extents over 500 directions, which is at most that of all directions.
    """
    import mujoco

    directions = np.random.default_rng(0).normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    frames = []
    for each in (model, fitted):
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, each.geom_quat[geom])
        frames.append((directions @ matrix.reshape(3, 3), directions @ each.geom_pos[geom]))
    (inside, shift), (local, offset) = frames
    hull = (inside @ _get_vertices(model, geom).T).max(1) + shift
    size = fitted.geom_size[geom]
    if fitted.geom_type[geom] == int(mujoco.mjtGeom.mjGEOM_BOX):
        extent = np.abs(local) @ size
    else:
        extent = size[0] + size[1] * np.abs(local[:, 2])
    return float((extent + offset - hull).max())


def _leave_out(model: mujoco.MjModel, meshes: list[int]) -> mujoco.MjModel:
    """A copy of the model in which these geoms touch nothing; pairs that name them wait for an impossible distance."""
    import mujoco

    model = copy.copy(model)
    model.geom_contype[meshes] = model.geom_conaffinity[meshes] = 0
    named = np.isin(model.pair_geom1, meshes) | np.isin(model.pair_geom2, meshes)
    model.pair_margin[named] = -mujoco.mjMAXVAL
    return _set_masks(model)


def _set_masks(model: mujoco.MjModel) -> mujoco.MjModel:
    """Sets what MuJoCo derives from the masks of the geoms: those of their bodies."""
    model.body_contype[:] = model.body_conaffinity[:] = 0
    np.bitwise_or.at(model.body_contype, model.geom_bodyid, model.geom_contype)
    np.bitwise_or.at(model.body_conaffinity, model.geom_bodyid, model.geom_conaffinity)
    return model


def _set_bounds(model: mujoco.MjModel) -> mujoco.MjModel:
    """Disables the hierarchies of bounding volumes, which MuJoCo made of the old shapes."""
    import mujoco

    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
    return model


def _get_vertices(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """The vertices of a geom's mesh, `[V, 3]` in the geom's frame."""
    mesh = int(model.geom_dataid[geom])
    begin = int(model.mesh_vertadr[mesh])
    return model.mesh_vert[begin : begin + int(model.mesh_vertnum[mesh])].astype(float)


def _turn_z_to(axis: int) -> np.ndarray:
    """The quaternion of a rotation that takes the z axis to another one."""
    half = np.sqrt(0.5)
    return np.array([[half, 0, half, 0], [half, -half, 0, 0], [1, 0, 0, 0]][axis], float)


def _place(model: mujoco.MjModel, geom: int, shift: np.ndarray, turn: np.ndarray) -> None:
    """Moves and turns a geom by what is given in its own frame."""
    import mujoco

    moved, quat = np.empty(3), np.empty(4)
    mujoco.mju_rotVecQuat(moved, shift, model.geom_quat[geom])
    mujoco.mju_mulQuat(quat, model.geom_quat[geom], turn)
    model.geom_pos[geom] += moved
    model.geom_quat[geom] = quat
    model.geom_sameframe[geom] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)
