"""Physics that diverges: when that is, and which steps of a rollout are then not learned from.

A stiff model at a long time step passes through 1e3, 1e10 and 1e38 before its numbers are NaN. As MuJoCo does, a number
beyond `BOUND` counts as diverged already. Training, evaluation, recordings and exports all ask `diverged`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

BOUND = 1e10  # mjMAXVAL, MuJoCo's own for positions, velocities and accelerations
FAR = 30.0  # deviations from the mean of the observations, beyond which nothing is learned from
PHYSICS = ("qpos", "qvel", "qacc", "q", "qd")  # what MuJoCo looks at, and brax's names of the same


def diverged(before: Any, after: Any) -> jax.Array:
    """Whether a step of one environment ended in numbers that are not finite or beyond `BOUND`, scalar bool.

        any |x'| > 1e10 or NaN,    x' of the observation, the reward and the physics after the step

    or `done` is not finite. The physics is all that is called qpos, qvel or qacc in `pipeline_state`, or without such
    names every floating-point number in it; there a number counts only if it was within the bound before the step, as
    models hold constants that are infinite. An observation that was beyond it before the step, after a reset, counts.
    Metrics are only looked at, and do not count.

    Args:
      before, after: brax's State before and after the step.

    Source: mj_checkPos, mj_checkVel and mj_checkAcc of MuJoCo.
    """
    left = [inside(old) & ~inside(new) for old, new in zip(physics(before), physics(after), strict=True)]
    outside = [jnp.any(x) for x in left]
    outside += [~jnp.all(inside(x)) for x in (before.obs, after.obs, after.reward)]
    return jnp.any(jnp.stack([*outside, ~jnp.all(jnp.isfinite(after.done))]))


def inside(x: jax.Array) -> jax.Array:
    """Element by element, whether a number is finite and within `BOUND`.

    >>> inside(jnp.array([-1e10, 2e10, jnp.nan])).tolist()
    [True, False, False]
    """
    return jnp.isfinite(x) & (jnp.abs(x) <= BOUND)  # the bound is infinite itself in float16


def physics(state: Any) -> list[jax.Array]:
    """The numbers of `pipeline_state` that `diverged` looks at; counters and random keys are none of them."""
    leaves = jax.tree_util.tree_leaves_with_path(state.pipeline_state)
    floats = [(path, leaf) for path, leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]
    named = [leaf for path, leaf in floats if path and _name(path[-1]) in PHYSICS]
    return named or [leaf for _, leaf in floats]


def _name(entry: Any) -> Any:
    return getattr(entry, "name", getattr(entry, "key", None))


def lasting(bad: jax.Array, ended: jax.Array) -> jax.Array:
    """Whether nothing bad happens from a step on to the end of its episode, or of the rollout, `[T, ...]` of bool.

        l_t = not bad_t and (ended_t or l_{t+1}),    l_T = true

    Args:
      bad: of each step, `[T, ...]` of bool.
      ended: whether the episode ended with the step, `[T, ...]` of bool.

    >>> lasting(jnp.array([False, False, False, True]), jnp.array([False, True, False, True])).tolist()
    [True, True, False, False]
    """

    def back(after, step):
        bad, ended = step
        here = ~bad & (ended | after)
        return here, here

    return jax.lax.scan(back, jnp.ones_like(bad[0]), (bad, ended), reverse=True)[1]
