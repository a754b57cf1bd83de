"""Goals that an arm can reach: where joint angles lead that C MuJoCo has seen to be free of collisions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from envs.options import OptionError
from envs.robots.arms import Arm

SHARE = 0.7  # of each joint's range from which its angle is drawn
WIDEST = np.pi  # of a joint that turns further, on either side of its pose at rest [rad]
CLEARANCE = 0.05  # of the end effector above the ground, as a share of its distance from the base at rest
NUM_POSES = 2048
NUM_DRAWS = 20 * NUM_POSES


def draw_poses(arm: Arm, seed: int = 0) -> np.ndarray:
    """Random joint positions of the arm that are possible poses, `[NUM_POSES, n]`.

    Each position is uniform over the middle 70 % of the joint's range, of which no more counts than half a turn on
    either side of the pose at rest. A pose is possible if C MuJoCo finds no geoms that penetrate each other, apart from
    those that do so at rest, and no joint of the arm or its end effector is below the ground. The ground is the plane
    z = 0, for an arm that rests above it.

    Args:
      arm: the arm.
      seed: of the draws.

    Raises:
      OptionError: fewer than one in twenty draws is possible.
    """
    is_possible, poses = _make_judge(arm), []
    for draw in _draw(arm, NUM_DRAWS, seed):
        if is_possible(draw):
            poses.append(draw)
            if len(poses) == NUM_POSES:
                return np.array(poses)
    if len(poses) < NUM_DRAWS // 20:
        line = (
            f"only {len(poses)} of {NUM_DRAWS} random poses of {arm.name} are free of collisions and above the ground"
        )
        raise OptionError([f"env.robot: {line}; give env.goal_box=[x,y,z,x,y,z]"])
    return np.array(poses)


def measure_free_share(arm: Arm, number: int = 1000, seed: int = 0) -> float:
    """The share of random joint positions that are possible poses, of `number` draws as in `draw_poses`."""
    is_possible = _make_judge(arm)
    return float(np.mean([is_possible(draw) for draw in _draw(arm, number, seed)]))


def list_overlaps(arm: Arm) -> list[tuple[str, str]]:
    """The names of bodies that penetrate each other at rest."""
    import mujoco

    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.qpos
    _place(arm, data)
    bodies = {tuple(sorted(arm.model.geom_bodyid[list(pair)].tolist())) for pair in _find_overlaps(data)}
    return [(arm.model.body(one).name, arm.model.body(other).name) for one, other in sorted(bodies)]


def _draw(arm: Arm, number: int, seed: int) -> np.ndarray:
    low, high = find_goal_ranges(arm)
    return np.random.default_rng(seed).uniform(low, high, (number, len(low)))


def _make_judge(arm: Arm) -> Callable[[np.ndarray], bool]:
    """Whether joint positions `[n]` are a possible pose, see `draw_poses`."""
    import mujoco

    data, places = mujoco.MjData(arm.model), arm.qpos_of
    data.qpos[:] = arm.qpos
    lowest, touching = _place(arm, data), _find_overlaps(data)
    floor = CLEARANCE * _find_reach(arm, data) if lowest >= 0 else -np.inf

    def is_possible(angles: np.ndarray) -> bool:
        data.qpos[places] = angles
        return _place(arm, data) >= floor and _find_overlaps(data) <= touching

    return is_possible


def find_goal_ranges(arm: Arm) -> tuple[np.ndarray, np.ndarray]:
    """(lowest, highest) positions [n] from which the joints' positions are drawn."""
    low, high = arm.ranges
    widest = np.array([np.inf if joint.is_slide else WIDEST for joint in arm.joints])
    low, high = np.maximum(low, arm.angles - widest), np.minimum(high, arm.angles + widest)
    limited = np.isfinite(low) & np.isfinite(high)
    if not limited.all():
        joint = arm.joints[int(np.argmin(limited))]
        raise OptionError([f"env.robot: slide joint '{joint.name}' has no range; give it one, such as range=\"0 0.5\""])
    middle, half = (low + high) / 2, SHARE * (high - low) / 2
    return middle - half, middle + half


def _place(arm: Arm, data) -> float:
    """Places the robot; returns the height of its lowest moving joint or end effector [m]."""
    import mujoco

    model = arm.model
    mujoco.mj_fwdPosition(model, data)
    bodies = [int(model.jnt_bodyid[model.joint(joint.name).id]) for joint in arm.joints[1:]]
    return min(float(data.xpos[bodies, 2].min(initial=np.inf)), float(data.site(arm.site).xpos[2]))


def _find_reach(arm: Arm, data) -> float:
    """Distance of the end effector from the arm's first joint [m]."""
    base = int(arm.model.jnt_bodyid[arm.model.joint(arm.joints[0].name).id])
    return float(np.linalg.norm(data.site(arm.site).xpos - data.xpos[base]))


def _find_overlaps(data) -> set[tuple[int, int]]:
    """The pairs of geoms that penetrate each other."""
    contacts = data.contact
    return {tuple(pair) for pair in contacts.geom[contacts.dist < 0].tolist()}
