"""Programs as a jax primitive, whose batch a CPU computes in tiles of environments.

Under `vmap` every stored value of a program (`envs.physics.stages`) is a loop over the batch, and XLA's CPU runtime
calls the loops one by one. Large programs have hundreds of loops. With 1,024 environments they overflow the caches,
arrays at equal page offsets evict each other, and the calls themselves take time. In tiles of about a hundred
environments, with all loops of a tile in one kernel, the stored values never leave the cache.

The primitive, `mujoco_step`, knows its batch: one or several `vmap`s of it are again one `mujoco_step`, so that tiles
can be chosen when it is lowered. Until then it is a single equation, which is cheap to transform.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from envs.batches import LANES
from envs.physics.interpreter import Program
from envs.physics.kernels import is_large_loop, make_kernel
from envs.physics.stages import Stage

# Environments per tile. In smaller tiles the loops are too short; from 256 on XLA splits large loops between threads,
# which is impossible inside a kernel.
TILE = 128
# Programs with so few loops gain nothing: the pendulum's 4 are slower in tiles, a cart-pole's 10 faster.
FEW_LOOPS = 8
# Size of the largest array of one environment; XLA splits larger loops between threads too.
LARGEST_ARRAY = 256


def make_tiled(
    program: Program,
    make_function: Callable[[list[Stage]], Callable[..., tuple]],
    differentiable: Callable[..., tuple] | None = None,
    replace: Callable[..., tuple] | None = None,
) -> Callable[..., tuple]:
    """Makes a function into a `mujoco_step`, whose batch a CPU computes in tiles, if it gains from that.

    Args:
      program: the program that the function computes.
      make_function: makes the function of arrays from the program's stages, or from others that compute the same.
      differentiable: the function that is differentiated instead, if the program has loops, which have no derivative.
      replace: gives the results of environments in which the function's last result, a flag, is not 0: a function of
        the arguments and the flag. Without it there is no flag.

    Returns:
      A function that can be jitted, batched and differentiated; its derivatives are those of the plain function.
    """
    function = make_function(program.stages)
    num_loops = sum(stage.num_stored for stage in program.stages)
    is_tiled = num_loops > FEW_LOOPS and max(array.size for array in program.inputs + program.outputs) <= LARGEST_ARRAY
    has_loop = any(stage.body for stage in program.stages)
    if not is_tiled and not has_loop and replace is None:
        return function
    functions = {
        "function": function,
        "tile_function": _make_tile_function(program, make_function, function) if is_tiled else None,
        "differentiable": differentiable if has_loop and differentiable is not None else function,
        "replace": replace,
        "results": tuple(program.results) if replace is None else tuple(program.results[:-1]),
    }
    return lambda *arrays: tuple(mujoco_step.bind(*arrays, **functions, is_batched=False))


def _make_tile_function(program: Program, make_function: Callable, function: Callable) -> Callable[..., tuple]:
    kernels = program.kernels()
    return make_function(kernels) if len(kernels) > 1 or is_large_loop(kernels[0]) else make_kernel(function)


mujoco_step = Primitive("mujoco_step")
mujoco_step.multiple_results = True


def _run_plain(*arrays, function, replace, is_batched, **_):
    compute = jax.vmap(function) if is_batched else function
    return _replace_flagged(arrays, compute(*arrays), replace, is_batched)


def _run_tiled(*arrays, function, tile_function, replace, is_batched, **_):
    if tile_function is None or not is_batched:
        return _run_plain(*arrays, function=function, replace=replace, is_batched=is_batched)
    return _replace_flagged(arrays, _run_tiles(tile_function, arrays), replace, is_batched)


def _run_tiles(tile: Callable, arrays: tuple) -> tuple:
    """Runs tile by tile; the last tile is padded with copies of the last environment."""
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


def _replace_flagged(arrays: tuple, results: tuple, replace: Callable | None, is_batched: bool) -> tuple:
    """The results without the flag; those of flagged environments are replaced, if there are any."""
    if replace is None:
        return results
    kept, flag = results[:-1], results[-1]
    compute = jax.vmap(replace) if is_batched else replace

    return lax.cond(jnp.any(flag != 0), lambda: _where_flagged(flag, compute(*arrays, flag), kept), lambda: kept)


def _where_flagged(flag: jax.Array, others: Sequence[jax.Array], results: Sequence[jax.Array]) -> tuple:
    """The other results of environments whose flag is not 0."""
    return tuple(
        jnp.where(flag.reshape(flag.shape + (1,) * (result.ndim - flag.ndim)) != 0, other, result)
        for other, result in zip(others, results, strict=True)
    )


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


def _differentiate(primals, tangents, *, differentiable, replace, is_batched, **_):
    """The derivative; flagged environments, whose results another function gives, have none: they are NaN."""
    tangents = tuple(map(ad.instantiate_zeros, tangents))
    compute = jax.vmap(differentiable) if is_batched else differentiable

    def function(*arrays):
        results = compute(*arrays)
        if replace is None:
            return list(results)
        return list(_where_flagged(results[-1], [jnp.full_like(x, jnp.nan) for x in results[:-1]], results[:-1]))

    return jax.jvp(function, tuple(primals), tangents)


mujoco_step.def_impl(
    jax.jit(
        mujoco_step.bind,
        static_argnames=("function", "tile_function", "differentiable", "replace", "results", "is_batched"),
    )
)
mujoco_step.def_abstract_eval(_infer_shapes)
mlir.register_lowering(mujoco_step, mlir.lower_fun(_run_plain, multiple_results=True))
mlir.register_lowering(mujoco_step, mlir.lower_fun(_run_tiled, multiple_results=True), platform="cpu")
batching.primitive_batchers[mujoco_step] = _batch
ad.primitive_jvps[mujoco_step] = _differentiate
