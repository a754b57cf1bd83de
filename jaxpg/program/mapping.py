"""A function of one agent for several: in one program, or in groups that share the cores."""

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
from jaxpg.program.backend import num_threads
from jaxpg.program.state import is_key


def groups_at_once(config: Config) -> int:
    """Groups of agents that compute at the same time: with shards, which meet, one could wait for another for ever."""
    return num_threads() if config.num_shards == 1 else 1


def over_agents(fn: Callable, number: int) -> Callable:
    """`fn` for some agents; a single one is not mapped, so that its program branches instead of selecting.

    Arguments by name are the same for all agents.
    """

    @functools.wraps(fn)
    def one(*arguments, **shared):
        result = fn(*jax.tree.map(lambda x: x[0], arguments), **shared)
        return jax.tree.map(lambda x: x[None], result)

    @functools.wraps(fn)
    def several(*arguments, **shared):
        return jax.vmap(functools.partial(fn, **shared))(*arguments)

    return several if number > 1 else one


def in_groups(compiled: Compiled, size: int, at_once: int) -> Callable:
    """What was compiled for `size` agents, for any multiple of as many: `[S, ...]` to `[S, ...]`.

    Arguments by name are the same for all agents. One group is handed through as it is; several come back as numpy
    arrays.

    Args:
      compiled: takes and gives trees whose leaves begin with the agents' axis.
      size: agents of a group.
      at_once: groups that run at the same time, each in a thread, as XLA computes without Python's lock.
    """
    where, where_shared = compiled.input_shardings

    def fn(*arguments, **shared):  # shards may be wanted on other devices than they came from
        return compiled(*jax.device_put(arguments, where), **jax.device_put(shared, where_shared))

    def run(*arguments, **shared):
        number = len(jax.tree.leaves(arguments)[0])
        if number == size:
            return fn(*arguments, **shared)
        arguments = jax.tree.map(_on_host, arguments)
        groups = [jax.tree.map(lambda x, i=i: x[i : i + size], arguments) for i in range(0, number, size)]
        with ThreadPoolExecutor(at_once) as pool:
            results = list(pool.map(lambda group: jax.tree.map(_on_host, fn(*group, **shared)), groups))
        return jax.tree.map(lambda *parts: (jnp if is_key(parts[0]) else np).concatenate(parts), *results)

    return run


def _on_host(x: Any) -> Any:
    """As a numpy array, which is divided without compiling anything; random keys stay what they are."""
    return x if is_key(x) else np.asarray(x)
