"""Sums along the tree of bodies, level by level."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.dynamics.kinematics import find_carriers


class BodySums:
    """The tree of a model's bodies, whose root is the world.

    Attributes:
      levels: the bodies at each distance from the world, as arrays of their numbers.
      moves: whether a degree of freedom moves a body, `[nbody, nv]` of 0 and 1.
      has: whether a degree of freedom is of a joint of the body itself, `[nbody, nv]` of 0 and 1.
    """

    def __init__(self, model: mujoco.MjModel):
        self.parent = np.array(model.body_parentid)
        depth = np.zeros(model.nbody, int)
        self.has = np.zeros((model.nbody, model.nv))
        self.has[model.dof_bodyid, np.arange(model.nv)] = 1.0
        self.moves = find_carriers(model).astype(float)
        for body in range(1, model.nbody):
            depth[body] = depth[self.parent[body]] + 1
        self.levels = [np.flatnonzero(depth == level) for level in range(depth.max() + 1)]

    @functools.cached_property
    def _order(self) -> np.ndarray:
        """The place of each body if the levels are put one after the other."""
        return np.argsort(np.concatenate(self.levels))

    def sum_paths(self, values: jax.Array) -> jax.Array:
        """For each body, the sum of the values of the bodies on its path to the world: `[nbody, ...]` -> the same."""
        sums = [values[self.levels[0]]]
        for above, level in zip(self.levels, self.levels[1:], strict=False):
            sums.append(values[level] + sums[-1][np.searchsorted(above, self.parent[level])])
        return jnp.concatenate(sums)[self._order]

    def sum_subtrees(self, values: jax.Array) -> jax.Array:
        """For each body, the sum of the values of itself and the bodies that it carries: `[nbody, ...]` -> the same."""
        sums = [values[self.levels[-1]]]
        for level, below in zip(self.levels[-2::-1], self.levels[:0:-1], strict=True):
            carries = (self.parent[below] == level[:, None]).astype(float)
            sums.append(values[level] + jnp.tensordot(carries, sums[-1], 1))
        return jnp.concatenate(sums[::-1])[self._order]
