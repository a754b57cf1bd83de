"""Divides a batch of environments over devices, so that a CPU uses all its cores.

XLA computes the equations of a batch on one core, however many there are. Devices are independent: a CPU that is split
into several (`jax_num_cpu_devices`) computes a part of the batch on each of them, one core for each.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, PartitionSpec

AXIS = "parts"
# The environments of a part are a multiple of this, as many as a vector register holds. All of them are then computed
# by the same instructions, so that bits depend neither on the number of devices nor on the place in the batch.
LANES = 16


def divide_batch(
    function: Callable, in_axes: int | Sequence[int | None] | None = 0, devices: Sequence[Any] | None = None
) -> Callable:
    """A function of a batch, compiled, with the environments divided over devices.

        divide_batch(f)(x)[i] = f(x)[i]    with the same bits on any number of devices

    The batch is filled up with copies of its last environment to a multiple of 16 for each device; their results are
    dropped.

        jax.config.update("jax_num_cpu_devices", 2)  # before anything else uses jax
        step = divide_batch(jax.vmap(compile_step(model)))

    Args:
      function: its arguments and results are arrays, or trees of them, whose first axis is that of the environments,
        `[N, ...]`. Row i of the results depends only on row i of the arguments. It can be a whole simulation, such as
        `jax.lax.scan` over steps: the devices then wait for each other only at its end.
      in_axes: as of `jax.vmap`: 0 for arguments that have environments, None for those that all share; one for all
        arguments, or one for each.
      devices: by default `jax.devices()`.

    Raises:
      ValueError: when called, if the arguments or results have no such axis, or of different lengths.
    """
    devices = list(jax.devices() if devices is None else devices)
    if not devices:
        raise ValueError("divide_batch: expected at least one device")
    mesh = jax.make_mesh((len(devices),), (AXIS,), axis_types=(AxisType.Auto,), devices=devices)

    @jax.jit
    @functools.wraps(function)
    def divided(*arguments):
        axes = _list_axes(in_axes, len(arguments))
        size = _measure([x for x, axis in zip(arguments, axes, strict=True) if axis is not None], "arguments")
        filled = (x if axis is None else _fill(x, size, len(devices)) for x, axis in zip(arguments, axes, strict=True))
        results = _run(function, mesh, axes)(*filled)
        return jax.tree.map(lambda x: x[:size], results)

    return divided


def _list_axes(in_axes: int | Sequence[int | None] | None, number: int) -> list[int | None]:
    axes = [in_axes] * number if in_axes is None or isinstance(in_axes, int) else list(in_axes)
    if len(axes) != number or any(axis not in (0, None) for axis in axes):
        raise ValueError(f"divide_batch: in_axes={in_axes!r}: expected 0 or None, for each of {number} arguments")
    return axes


def _measure(trees: Any, what: str) -> int:
    """The common length N of the first axes."""
    sizes = {x.shape[0] if np.ndim(x) else 0 for x in jax.tree.leaves(trees)}
    if len(sizes) != 1 or 0 in sizes:
        shapes = ", ".join(dict.fromkeys(str(np.shape(x)) for x in jax.tree.leaves(trees))) or "none"
        raise ValueError(f"divide_batch: the {what} have the shapes {shapes}: expected [N, ...], with one N above 0")
    (size,) = sizes
    return size


def _fill(tree: Any, size: int, num_devices: int) -> Any:
    """Copies of the last environment after the others."""
    missing = -size % (LANES * num_devices)
    if not missing:
        return tree
    places = np.minimum(np.arange(size + missing), size - 1)
    return jax.tree.map(lambda x: x[places], tree)


def _run(function: Callable, mesh: Mesh, axes: Sequence[int | None]) -> Callable:
    """The function in parts."""

    def run(*arguments):
        results = function(*arguments)
        divided = [x for x, axis in zip(arguments, axes, strict=True) if axis is not None]
        _measure((results, divided), "results and arguments of a part")
        return results

    if list(mesh.devices.flat) == jax.devices()[:1]:  # on one device it is there already
        return run
    rows = PartitionSpec(AXIS)
    specs = tuple(PartitionSpec() if axis is None else rows for axis in axes)
    return jax.shard_map(run, mesh=mesh, in_specs=specs, out_specs=rows, check_vma=False)
