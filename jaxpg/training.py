"""The training: one `lax.scan` over the updates."""

from __future__ import annotations

import jax

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


def initial_state(algorithm: Algorithm, key: jax.Array) -> TrainState:
    """The state before the first update of the run with this key."""
    return algorithm.init(jax.random.fold_in(key, 0))
