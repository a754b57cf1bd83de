"""Divides the environments of one agent into shards, each on its own device.

XLA runs small operations on one core, however many there are. Devices are independent: if a CPU is split into several
(`jax_num_cpu_devices`), each shard computes its rollout and gradients on its own core, and the shards synchronize once
per gradient step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.sharding import AxisType, PartitionSpec

from jaxpg.types import Algorithm, PyTree, TrainState

AXIS = "shards"
Device = Any  # jax.Device, a class of a compiled module without types


def shard(algorithm: Algorithm, num_shards: int, devices: Sequence[Device]) -> Algorithm:
    """One algorithm from `num_shards` shards, with N environments in all and a single state of everything else.

        gradient = 1/D sum_i gradient_i    over the D shards

    Args:
      algorithm: algorithm of one shard with N / num_shards environments; made with `axis_name=AXIS`, so that its
        gradients, statistics and metrics are those of all shards.
      num_shards: D, at least 1.
      devices: the shards run on the first D of these; if there are fewer, one after another on the default device. The
        numbers are the same up to rounding.
    """
    if len(devices) >= num_shards:
        mesh = jax.make_mesh((num_shards,), (AXIS,), axis_types=(AxisType.Auto,), devices=devices[:num_shards])
        state = _make_state_spec(PartitionSpec(), PartitionSpec(AXIS))
        init = jax.shard_map(algorithm.init, mesh=mesh, in_specs=PartitionSpec(), out_specs=state, check_vma=False)
        step = jax.shard_map(
            algorithm.step,
            mesh=mesh,
            in_specs=(state, PartitionSpec()),
            out_specs=(state, PartitionSpec()),
            check_vma=False,
        )
        return Algorithm(init, step)
    state = _make_state_spec(None, 0)
    axis = {"axis_name": AXIS, "axis_size": num_shards}
    init = jax.vmap(algorithm.init, in_axes=None, out_axes=state, **axis)
    step = jax.vmap(algorithm.step, in_axes=(state, None), out_axes=(state, None), **axis)
    return Algorithm(_join_init(init), _join_step(step, num_shards))


def _make_state_spec(shared: PyTree, divided: PyTree) -> TrainState:
    """The specification of each field of a state: only the environments are divided."""
    return TrainState(params=shared, opt_state=shared, normalizer=shared, env_state=divided, update=shared)


def _join_init(init: Callable) -> Callable:
    return lambda key: _join(init(key))


def _join_step(step: Callable, num_shards: int) -> Callable:
    def joined(state, key):
        state, metrics = step(_divide(state, num_shards), key)
        return _join(state), metrics

    return joined


def _divide(state: TrainState, number: int) -> TrainState:
    """Reshapes the environments from `[N, ...]` to `[D, N / D, ...]`."""
    divide = lambda x: x.reshape(number, -1, *x.shape[1:])  # noqa: E731
    return state._replace(env_state=jax.tree.map(divide, state.env_state))


def _join(state: TrainState) -> TrainState:
    """Reshapes the environments from `[D, N / D, ...]` to `[N, ...]`."""
    return state._replace(env_state=jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), state.env_state))
