"""Programs as a jax primitive, whose batch a CPU computes in tiles of environments.

Under `vmap` every stored value of a program (`envs.physics.stages`) is a loop over the batch, and XLA's CPU runtime
calls the loops one by one. Large programs have hundreds of loops. With 1,024 environments they overflow the caches,
arrays at equal page offsets evict each other, and the calls themselves take time. In tiles of about a hundred
environments, with all loops of a tile in one kernel, the stored values never leave the cache.

The primitive, `mujoco_step`, knows its batch: one or several `vmap`s of it are again one `mujoco_step`, so that tiles
can be chosen when it is lowered. Until then it is a single equation, which is cheap to transform.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from envs.physics.interpreter import Program
from envs.physics.stages import Stage, make_kernel

# Environments per tile. In smaller tiles the loops are too short; from 256 on XLA splits large loops between threads,
# which is impossible inside a kernel.
TILE = 128
LANES = 16  # the size of a tile is a multiple of this, so that loops are fully vectorised
# Programs with so few loops gain nothing: the pendulum's 4 are slower in tiles, a cart-pole's 10 faster.
FEW_LOOPS = 8
# Size of the largest array of one environment; XLA splits larger loops between threads too.
LARGEST_ARRAY = 256


def make_tiled(program: Program, make_function: Callable[[list[Stage]], Callable[..., tuple]]) -> Callable[..., tuple]:
    """Makes a function into a `mujoco_step`, whose batch a CPU computes in tiles, if it gains from that.

    Args:
      program: the program that the function computes.
      make_function: makes the function of arrays from the program's stages, or from others that compute the same.

    Returns:
      A function that can be jitted, batched and differentiated; its derivatives are those of the plain function.
    """
    function = make_function(program.stages)
    num_loops = sum(len(stage.outputs) for stage in program.stages)
    if num_loops <= FEW_LOOPS or max(array.size for array in program.inputs + program.outputs) > LARGEST_ARRAY:
        return function
    kernels = program.kernels()
    tile_function = make_kernel(function) if len(kernels) == 1 else make_function(kernels)
    functions = {"function": function, "tile_function": tile_function, "results": tuple(program.results)}
    return lambda *arrays: tuple(mujoco_step.bind(*arrays, **functions, is_batched=False))


mujoco_step = Primitive("mujoco_step")
mujoco_step.multiple_results = True


def _run_plain(*arrays, function, is_batched, **_):
    return (jax.vmap(function) if is_batched else function)(*arrays)


def _run_tiled(*arrays, function, tile_function, is_batched, **_):
    """Runs tile by tile; the last tile is padded with copies of the last environment."""
    if not is_batched:
        return function(*arrays)
    tile = jax.vmap(tile_function)
    size = len(arrays[0])
    num_tiles = -(-size // TILE)
    if num_tiles == 1:
        return tile(*arrays)
    length = -(-size // (num_tiles * LANES)) * LANES
    padding = num_tiles * length - size

    def cut(x):
        if padding:
            x = jnp.concatenate([x, jnp.broadcast_to(x[-1], (padding, *x.shape[1:]))])
        return x.reshape(num_tiles, length, *x.shape[1:])

    results = lax.map(lambda part: tile(*part), tuple(map(cut, arrays)))
    return tuple(x.reshape(-1, *x.shape[2:])[:size] for x in results)


def _infer_shapes(*arrays, results, is_batched, **_):
    batch = arrays[0].shape[:1] if is_batched else ()
    return [ShapedArray((*batch, *x.shape), x.dtype) for x in results]


def _batch(arrays, axes, *, is_batched, **params):
    """Adds a batch axis, merged with the existing one if there is one."""
    (size,) = {x.shape[axis] for x, axis in zip(arrays, axes, strict=True) if axis is not None}
    arrays = [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(arrays, axes, strict=True)
    ]
    if not is_batched:
        results = mujoco_step.bind(*arrays, is_batched=True, **params)
    else:
        inner = arrays[0].shape[1]
        results = mujoco_step.bind(*(x.reshape(-1, *x.shape[2:]) for x in arrays), is_batched=True, **params)
        results = [x.reshape(size, inner, *x.shape[1:]) for x in results]
    return results, [0] * len(results)


def _differentiate(primals, tangents, **params):
    tangents = tuple(map(ad.instantiate_zeros, tangents))
    return jax.jvp(lambda *arrays: list(_run_plain(*arrays, **params)), tuple(primals), tangents)


mujoco_step.def_impl(jax.jit(mujoco_step.bind, static_argnames=("function", "tile_function", "results", "is_batched")))
mujoco_step.def_abstract_eval(_infer_shapes)
mlir.register_lowering(mujoco_step, mlir.lower_fun(_run_plain, multiple_results=True))
mlir.register_lowering(mujoco_step, mlir.lower_fun(_run_tiled, multiple_results=True), platform="cpu")
batching.primitive_batchers[mujoco_step] = _batch
ad.primitive_jvps[mujoco_step] = _differentiate
