"""Maps a function of one agent over several: in one program, or in groups that share the cores."""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.stages import Compiled

from jaxpg.config.configuration import Config
from jaxpg.program.backend import count_threads
from jaxpg.program.state import is_key


def count_parallel_groups(config: Config) -> int:
    """Number of groups of agents that run at the same time; 1 with shards, which synchronize and could deadlock."""
    return count_threads() if config.num_shards == 1 else 1


def map_over_agents(fn: Callable, number: int) -> Callable:
    """Maps `fn` over agents; a single one without `vmap`, so that its program branches instead of selecting.

    Keyword arguments are the same for all agents.
    """

    @functools.wraps(fn)
    def call_one(*arguments, **shared):
        result = fn(*jax.tree.map(lambda x: x[0], arguments), **shared)
        return jax.tree.map(lambda x: x[None], result)

    @functools.wraps(fn)
    def call_several(*arguments, **shared):
        return jax.vmap(functools.partial(fn, **shared))(*arguments)

    return call_several if number > 1 else call_one


def map_in_groups(compiled: Compiled, size: int, at_once: int) -> Callable:
    """Applies a program for `size` agents to any multiple of `size`: `[S, ...]` to `[S, ...]`.

    Keyword arguments are the same for all agents. Results of a single group are returned as they are, those of several
    as numpy arrays.

    Args:
      compiled: compiled function of trees whose leaves have a leading axis of agents.
      size: number of agents in a group.
      at_once: number of groups that run at the same time, in threads, as XLA computes without Python's lock.
    """
    where, where_shared = compiled.input_shardings

    def fn(*arguments, **shared):  # shards may have to move to other devices
        return compiled(*jax.device_put(arguments, where), **jax.device_put(shared, where_shared))

    def run(*arguments, **shared):
        number = len(jax.tree.leaves(arguments)[0])
        if number == size:
            return fn(*arguments, **shared)
        arguments = jax.tree.map(_to_host, arguments)
        groups = [jax.tree.map(lambda x, i=i: x[i : i + size], arguments) for i in range(0, number, size)]
        with ThreadPoolExecutor(at_once) as pool:
            results = list(pool.map(lambda group: jax.tree.map(_to_host, fn(*group, **shared)), groups))
        return jax.tree.map(lambda *parts: (jnp if is_key(parts[0]) else np).concatenate(parts), *results)

    return run


def _to_host(x: Any) -> Any:
    """Converts to numpy, where slicing needs no compilation; random keys stay as they are."""
    return x if is_key(x) else np.asarray(x)
