"""Training: one loop over the updates, inside the compiled program."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxpg.types import Algorithm, Metrics, TrainState


def train_scan(
    algorithm: Algorithm, key: jax.Array, num_updates: int, state: TrainState | None = None
) -> tuple[TrainState, Metrics]:
    """Makes `num_updates` updates, from the initial state or a given one.

        state_0 = init(fold_in(key, 0)),    state_{i+1}, metrics_i = step(state_i, fold_in(key, i + 1))

    The state counts i, so training in pieces with the same key equals training in one piece. For several seeds, apply
    `jax.vmap` over the key (and the state).

    Args:
      algorithm: what to train.
      key: the run's random key, the same for all pieces.
      num_updates: number of updates to make, at least 1.
      state: state to continue from; by default `initial_state`.

    Returns:
      The state after the last update, and the metrics of each update, `[num_updates]` by name.
    """
    if state is None:
        state = initial_state(algorithm, key)

    def update(state, _):
        return algorithm.step(state, jax.random.fold_in(key, state.update + 1))

    return jax.lax.scan(update, state, length=num_updates)


def train_chunk(
    algorithm: Algorithm, key: jax.Array, length: int, num_updates: jax.Array | int, state: TrainState
) -> tuple[TrainState, Metrics]:
    """`train_scan` with a number of updates, at most `length`, that is known only at run time.

    So one compiled program runs all chunks of a run, although the last may be shorter.

    Args:
      algorithm, key: as in `train_scan`.
      length: number of rows in the returned metrics.
      num_updates: number of updates to make, from 0 to `length`; not to be mapped over, so that `jax.vmap` branches
        instead of selecting.
      state: state to continue from.

    Returns:
      The state after these updates, and their metrics, `[length]` by name; 0 for updates that were not made.
    """

    def update(state):
        return algorithm.step(state, jax.random.fold_in(key, state.update + 1))

    def update_once(i, carry):
        state, rows = carry
        state, metrics = update(state)
        rows = jax.tree.map(lambda row, x: jax.lax.dynamic_update_index_in_dim(row, x, i, 0), rows, metrics)
        return state, rows

    metrics_shape = jax.eval_shape(update, state)[1]
    rows = jax.tree.map(lambda x: jnp.zeros((length, *x.shape), x.dtype), metrics_shape)
    return jax.lax.fori_loop(0, num_updates, update_once, (state, rows))


def initial_state(algorithm: Algorithm, key: jax.Array) -> TrainState:
    """The state before the first update of the run with this key."""
    return algorithm.init(jax.random.fold_in(key, 0))
