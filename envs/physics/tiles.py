"""Programs as one jax primitive, whose batch a CPU computes a tile of environments after the other.

Under `vmap` every stored value of a program (`envs.physics.stages`) is a loop over the batch, and XLA's CPU runtime
calls its loops one by one. Large programs have hundreds: 1,024 environments then spill the caches, their arrays begin
at equal places of memory pages and evict one another, and the calls themselves take time. Cut into tiles of a hundred
environments, and with all loops of a tile in one kernel, the stored values never leave the cache.

The primitive, `mujoco_step`, knows its batch: one `vmap` or several of it are again one `mujoco_step`, so that the
tiles can be chosen when it is lowered. Until then it is a single equation, cheap to transform.
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
from envs.physics.stages import Stage, as_kernel

# Environments in a tile. Smaller, the loops are too short; from 256 on XLA splits large loops between threads, which
# cannot be done inside a kernel.
TILE = 128
LANES = 16  # a tile is a multiple of it, so that no loop has a rest that is not vectorised
# A program of fewer loops gains nothing: the pendulum's 4 are slower in tiles, a cart-pole's 10 faster.
FEW_LOOPS = 8
# The largest array of one environment, in numbers: XLA splits larger loops between threads too.
LARGEST_ARRAY = 256


def in_tiles(program: Program, function_of: Callable[[list[Stage]], Callable[..., tuple]]) -> Callable[..., tuple]:
    """The function as a `mujoco_step`, whose batch a CPU computes in tiles; as it is, if it gains nothing from it.

    Args:
      program: what the function computes.
      function_of: the function of arrays, made of the program's stages or of others that compute the same.

    Returns:
      A function that can be jitted, batched and differentiated; its derivatives are those of the plain function.
    """
    function = function_of(program.stages)
    num_loops = sum(len(stage.outputs) for stage in program.stages)
    if num_loops <= FEW_LOOPS or max(array.size for array in program.inputs + program.outputs) > LARGEST_ARRAY:
        return function
    kernels = program.kernels()
    for_tiles = as_kernel(function) if len(kernels) == 1 else function_of(kernels)
    functions = {"function": function, "for_tiles": for_tiles, "results": tuple(program.results)}
    return lambda *arrays: tuple(mujoco_step.bind(*arrays, **functions, is_batched=False))


mujoco_step = Primitive("mujoco_step")
mujoco_step.multiple_results = True


def _plain(*arrays, function, is_batched, **_):
    return (jax.vmap(function) if is_batched else function)(*arrays)


def _tiled(*arrays, function, for_tiles, is_batched, **_):
    """Tile by tile; the last tile is filled up with copies of the last environment."""
    if not is_batched:
        return function(*arrays)
    tile = jax.vmap(for_tiles)
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

    found = lax.map(lambda given: tile(*given), tuple(map(cut, arrays)))
    return tuple(x.reshape(-1, *x.shape[2:])[:size] for x in found)


def _shapes(*arrays, results, is_batched, **_):
    batch = arrays[0].shape[:1] if is_batched else ()
    return [ShapedArray((*batch, *x.shape), x.dtype) for x in results]


def _batch(arrays, axes, *, is_batched, **params):
    """One more batch axis: the first one, or merged with that which is there."""
    (size,) = {x.shape[axis] for x, axis in zip(arrays, axes, strict=True) if axis is not None}
    arrays = [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(arrays, axes, strict=True)
    ]
    if not is_batched:
        found = mujoco_step.bind(*arrays, is_batched=True, **params)
    else:
        inner = arrays[0].shape[1]
        found = mujoco_step.bind(*(x.reshape(-1, *x.shape[2:]) for x in arrays), is_batched=True, **params)
        found = [x.reshape(size, inner, *x.shape[1:]) for x in found]
    return found, [0] * len(found)


def _derivative(primals, tangents, **params):
    tangents = tuple(map(ad.instantiate_zeros, tangents))
    return jax.jvp(lambda *arrays: list(_plain(*arrays, **params)), tuple(primals), tangents)


mujoco_step.def_impl(jax.jit(mujoco_step.bind, static_argnames=("function", "for_tiles", "results", "is_batched")))
mujoco_step.def_abstract_eval(_shapes)
mlir.register_lowering(mujoco_step, mlir.lower_fun(_plain, multiple_results=True))
mlir.register_lowering(mujoco_step, mlir.lower_fun(_tiled, multiple_results=True), platform="cpu")
batching.primitive_batchers[mujoco_step] = _batch
ad.primitive_jvps[mujoco_step] = _derivative
