"""One agent's environments in several parts, each on a device of its own.

XLA runs small operations on one core, whatever the number of cores. Devices are independent: where a CPU is told to be
several (`jax_num_cpu_devices`), each part's rollout and gradients are computed on a core of its own, and the parts meet
once for every gradient step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.sharding import AxisType, Mesh, PartitionSpec

from jaxpg.types import Algorithm, PyTree, TrainState

AXIS = "shards"
Device = Any  # jax.Device, a class of a compiled module without types


def sharded(algorithm: Algorithm, num_shards: int, devices: Sequence[Device]) -> Algorithm:
    """The algorithm of `num_shards` parts together: N environments in all, and one state of everything else.

        gradient = 1/D sum_i gradient_i,    of the D parts' environments

    Args:
      algorithm: of one part, N / num_shards environments; made with `axis_name=AXIS`, so that its gradients, statistics
        and metrics are those of all parts.
      num_shards: D, at least 1.
      devices: the parts are computed on the first of these; if there are fewer, one after another on the default one.
        The numbers are the same but for rounding.
    """
    if len(devices) >= num_shards:
        mesh = _mesh(devices[:num_shards])
        state = _state(PartitionSpec(), PartitionSpec(AXIS))
        init = jax.shard_map(algorithm.init, mesh=mesh, in_specs=PartitionSpec(), out_specs=state, check_vma=False)
        step = jax.shard_map(
            algorithm.step,
            mesh=mesh,
            in_specs=(state, PartitionSpec()),
            out_specs=(state, PartitionSpec()),
            check_vma=False,
        )
        return Algorithm(init, step)
    state = _state(None, 0)
    mapped = {"axis_name": AXIS, "axis_size": num_shards}
    init = jax.vmap(algorithm.init, in_axes=None, out_axes=state, **mapped)
    step = jax.vmap(algorithm.step, in_axes=(state, None), out_axes=(state, None), **mapped)
    return Algorithm(_joined_init(init), _joined_step(step, num_shards))


def in_parts(fn: Callable[[PyTree, PyTree], PyTree], number: int, devices: Sequence[Device]) -> Callable:
    """`fn(shared, divided)`, which maps over the leading axis of `divided`, on several devices at once.

    Args:
      fn: its result has that axis too, and each row depends on its own row alone.
      number: of parts, a divisor of the rows.
      devices: the parts are computed on the first of these; if there are fewer, all of them together.
    """
    if number == 1 or len(devices) < number:
        return fn
    mesh = _mesh(devices[:number])
    divided = PartitionSpec(AXIS)
    return jax.shard_map(fn, mesh=mesh, in_specs=(PartitionSpec(), divided), out_specs=divided, check_vma=False)


def _mesh(devices: Sequence[Device]) -> Mesh:
    return jax.make_mesh((len(devices),), (AXIS,), axis_types=(AxisType.Auto,), devices=devices)


def _state(shared: PyTree, divided: PyTree) -> TrainState:
    """How each field of a state is divided: the environments are, and nothing else."""
    return TrainState(params=shared, opt_state=shared, normalizer=shared, env_state=divided, update=shared)


def _joined_init(init: Callable) -> Callable:
    return lambda key: _join(init(key))


def _joined_step(step: Callable, num_shards: int) -> Callable:
    def joined(state, key):
        state, metrics = step(_divide(state, num_shards), key)
        return _join(state), metrics

    return joined


def _divide(state: TrainState, number: int) -> TrainState:
    """Environments `[N, ...]` as `[D, N / D, ...]`."""
    divide = lambda x: x.reshape(number, -1, *x.shape[1:])  # noqa: E731
    return state._replace(env_state=jax.tree.map(divide, state.env_state))


def _join(state: TrainState) -> TrainState:
    """Environments `[D, N / D, ...]` as `[N, ...]`."""
    return state._replace(env_state=jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), state.env_state))
