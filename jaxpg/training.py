"""The training: one loop over the updates, inside the compiled program."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxpg.types import Algorithm, Metrics, TrainState


def train_scan(
    algorithm: Algorithm, key: jax.Array, num_updates: int, state: TrainState | None = None
) -> tuple[TrainState, Metrics]:
    """`num_updates` updates, from the beginning or from a given state.

        state_0 = init(fold_in(key, 0)),    state_{i+1}, metrics_i = step(state_i, fold_in(key, i + 1))

    The key is an argument and i is counted in the state: training in pieces with the same key is training in one
    piece. Several seeds are `jax.vmap` of this function over the key (and the state).

    Args:
      algorithm: what to train.
      key: the run's random key, the same for all its pieces.
      num_updates: how many updates to make now, at least 1.
      state: where to go on; by default `algorithm.init`.

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
    """The first `num_updates` of `length` updates: `train_scan` with a number that is known only when it runs.

    One compiled program makes all parts of a run, the last of which may be shorter.

    Args:
      algorithm, key: as in `train_scan`.
      length: room for the metrics of as many updates.
      num_updates: how many updates to make, from 0 to `length`; the same for all that are mapped over, so that
        `jax.vmap` branches instead of selecting.
      state: where to go on.

    Returns:
      The state after these updates, and their metrics, `[length]` by name; those of updates not made are 0.
    """

    def update(state):
        return algorithm.step(state, jax.random.fold_in(key, state.update + 1))

    def one(i, carry):
        state, rows = carry
        state, metrics = update(state)
        rows = jax.tree.map(lambda row, x: jax.lax.dynamic_update_index_in_dim(row, x, i, 0), rows, metrics)
        return state, rows

    of_one = jax.eval_shape(update, state)[1]
    rows = jax.tree.map(lambda x: jnp.zeros((length, *x.shape), x.dtype), of_one)
    return jax.lax.fori_loop(0, num_updates, one, (state, rows))


def initial_state(algorithm: Algorithm, key: jax.Array) -> TrainState:
    """The state before the first update of the run with this key."""
    return algorithm.init(jax.random.fold_in(key, 0))
