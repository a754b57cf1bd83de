"""Detects diverged physics, and finds the steps of a rollout that training must ignore because of it.

A stiff model at a long time step passes through 1e3, 1e10 and 1e38 before its numbers are NaN. As in MuJoCo, a number
beyond `BOUND` already counts as diverged. Training, evaluation, recordings and exports all use `has_diverged`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

BOUND = 1e10  # mjMAXVAL, MuJoCo's bound for positions, velocities and accelerations
MAX_DEVIATION = 30.0  # in standard deviations from the mean observation; training ignores steps beyond it
PHYSICS = ("qpos", "qvel", "qacc", "q", "qd")  # the fields that MuJoCo checks, and brax's names for them


def has_diverged(before: Any, after: Any) -> jax.Array:
    """Whether a step of one environment gave numbers that are not finite or beyond `BOUND`, scalar bool.

        any |x'| > 1e10 or NaN,    x' of the observation, the reward and the physics after the step

    or `done` is not finite. The physics is all fields called qpos, qvel or qacc in `pipeline_state`, or if there are
    none, every floating-point number in it. A number of the physics counts only if it was within the bound before the
    step, since models may hold infinite constants. An observation beyond the bound before the step, after a reset,
    counts too. Metrics do not count.

    Args:
      before, after: brax's State before and after the step.

    Source: mj_checkPos, mj_checkVel and mj_checkAcc of MuJoCo.
    """
    pairs = zip(select_physics(before), select_physics(after), strict=True)
    outside = [jnp.any(is_within_bound(old) & ~is_within_bound(new)) for old, new in pairs]
    outside += [~jnp.all(is_within_bound(x)) for x in (before.obs, after.obs, after.reward)]
    return jnp.any(jnp.stack([*outside, ~jnp.all(jnp.isfinite(after.done))]))


def is_within_bound(x: jax.Array) -> jax.Array:
    """Whether each element is finite and within `BOUND`.

    >>> is_within_bound(jnp.array([-1e10, 2e10, jnp.nan])).tolist()
    [True, False, False]
    """
    return jnp.isfinite(x) & (jnp.abs(x) <= BOUND)  # in float16 the bound itself is infinite


def select_physics(state: Any) -> list[jax.Array]:
    """The arrays of `pipeline_state` that `has_diverged` checks; no counters and no random keys."""
    leaves = jax.tree_util.tree_leaves_with_path(state.pipeline_state)
    floats = [(path, leaf) for path, leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]
    fields = [leaf for path, leaf in floats if path and _get_name(path[-1]) in PHYSICS]
    return fields or [leaf for _, leaf in floats]


def _get_name(entry: Any) -> Any:
    return getattr(entry, "name", getattr(entry, "key", None))


def find_sound_steps(bad: jax.Array, ended: jax.Array) -> jax.Array:
    """The steps from which nothing bad happens until the end of their episode or the rollout, `[T, ...]` of bool.

        l_t = not bad_t and (ended_t or l_{t+1}),    l_T = true

    Args:
      bad: whether the step is bad, `[T, ...]` of bool.
      ended: whether the episode ended with the step, `[T, ...]` of bool.

    >>> find_sound_steps(jnp.array([False, False, False, True]), jnp.array([False, True, False, True])).tolist()
    [True, True, False, False]
    """

    def step(following, inputs):
        bad, ended = inputs
        current = ~bad & (ended | following)
        return current, current

    return jax.lax.scan(step, jnp.ones_like(bad[0]), (bad, ended), reverse=True)[1]
