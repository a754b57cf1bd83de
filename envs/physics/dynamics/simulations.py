"""Some motions of a model by C MuJoCo, which show what touches and where bodies are."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import mujoco
import numpy as np

from envs.physics.callback import INITIAL_COUNT, has_diverged
from envs.physics.models import find_control_ranges, model_digest
from envs.physics.reach import find_ranges

SECONDS = 1.0  # of each simulation, from each keyframe, or else from the initial position
COMMANDED = 16  # simulations with random commands
NUM_POSES = 50  # of each simulation that are kept
NUM_RANDOM = 500  # positions within the ranges of the joints


class Poses(NamedTuple):
    """Poses of all bodies in T positions: `[T, nbody, 3]` and `[T, nbody, 3, 3]`."""

    xpos: np.ndarray
    xmat: np.ndarray


class Simulations(NamedTuple):
    """What the steps of some simulations had.

    Attributes:
      num_steps: of all of them.
      counts: in how many of them each pair of geoms touched.
      poses: in some of them.
    """

    num_steps: int
    counts: Counter[frozenset[int]]
    poses: Poses


_latest: dict[tuple[bytes, int], Simulations] = {}  # of the last model: all its programs need the same ones


def simulate(model: mujoco.MjModel, commanded: int) -> Simulations:
    """Simulations with random commands, each with others that stay the same, or without commands.

    Args:
      model: a compiled model.
      commanded: the number of simulations with random commands, or 0 for one from each start without commands.
    """
    name = model_digest(model), commanded
    if name not in _latest:
        for other in [other for other in _latest if other[0] != name[0]]:
            del _latest[other]
        _latest[name] = _simulate_all(model, commanded)
    return _latest[name]


def _simulate_all(model: mujoco.MjModel, commanded: int) -> Simulations:
    counts: Counter[frozenset[int]] = Counter()
    starts = list(range(model.nkey)) or [None]
    runs = list(itertools.islice(itertools.cycle(starts), commanded)) if commanded else starts
    random, num_steps, poses = np.random.default_rng(0), 0, []
    every = max(int(SECONDS / model.opt.timestep / NUM_POSES), 1)
    for key in runs:
        data = mujoco.MjData(model)
        if key is not None:
            mujoco.mj_resetDataKeyframe(model, data, key)
        if commanded:
            data.ctrl[:] = random.uniform(*find_control_ranges(model))
        for step, touching in enumerate(_simulate(model, data)):
            counts.update(touching)
            num_steps += 1
            if step % every == 0:
                poses.append(_copy_poses(data))
    return Simulations(num_steps, counts, _stack(model, poses))


def _simulate(model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[set[frozenset[int]]]:
    """The pairs of geoms that touch in each step, until the end or until the motion diverges."""
    data.warning.number[:] = INITIAL_COUNT
    for _ in range(max(int(SECONDS / model.opt.timestep), 1)):
        mujoco.mj_step(model, data)
        if has_diverged(data.warning.number):
            return
        touching = data.contact.geom[np.asarray(data.contact.efc_address) >= 0]
        yield {frozenset(geoms) for geoms in touching.tolist()}


def draw_poses(model: mujoco.MjModel) -> Poses:
    """Positions between those of the starts and random ones within the ranges of the hinges and slides."""
    random, data, poses = np.random.default_rng(0), mujoco.MjData(model), []
    joints = np.flatnonzero(model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE))
    low, high = (np.asarray(x)[joints] for x in find_ranges(model))
    starts = model.key_qpos if model.nkey else model.qpos0[None]
    addresses = model.jnt_qposadr[joints]
    for i in range(NUM_RANDOM):
        data.qpos[:] = start = starts[i % len(starts)]
        drawn = random.uniform(np.maximum(low, -1e3), np.minimum(high, 1e3))
        drawn = np.where(np.isfinite(low), drawn, start[addresses])
        data.qpos[addresses] += random.uniform() * (drawn - start[addresses])
        mujoco.mj_kinematics(model, data)
        poses.append(_copy_poses(data))
    return _stack(model, poses)


def _copy_poses(data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    return data.xpos.copy(), data.xmat.reshape(-1, 3, 3).copy()


def _stack(model: mujoco.MjModel, poses: list[tuple[np.ndarray, np.ndarray]]) -> Poses:
    shape = len(poses), model.nbody, 3
    xpos, xmat = zip(*poses, strict=True) if poses else ((), ())
    return Poses(np.array(xpos).reshape(shape), np.array(xmat).reshape(*shape, 3))
