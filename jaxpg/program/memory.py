"""Checks that a run fits into memory, before anything is written or compiled.

Linux silently kills a process that takes too much memory, so the run must not start.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax

from envs.base import Env
from jaxpg.config.configuration import Config, flatten
from jaxpg.errors import UserError
from jaxpg.networks import Networks
from jaxpg.posix import resource
from jaxpg.program.mapping import count_parallel_groups
from jaxpg.program.networks import make_networks
from jaxpg.program.schedule import plan
from jaxpg.types import PyTree

NUMBER = 4  # bytes
# Per environment step, besides observations and actions: reward, ends, returns, values, advantages, ...
SCALARS = 5
METRICS = 16  # numbers reported per update
# Files with a container's limit, its usage, and the reclaimable part of that; for cgroups of version 2 and 1.
CGROUPS = (
    ("memory.max", "memory.current", "memory.stat", "inactive_file"),
    ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat", "total_inactive_file"),
)


def check(config: Config, env: Env) -> None:
    """Raises UserError if the run needs more memory than is available; it names the option that needs the most."""
    need, have = estimate_memory(config, env), find_available_memory()
    if have is None or need <= have:
        return
    least = {name: estimate_memory(smaller, env) for name, smaller in _minimize_options(config).items()}
    name = min(least, key=least.__getitem__)
    value, advice = flatten(config)[name], ""
    if name == "num_envs" and have > least[name]:
        share = (have - least[name]) / (need - least[name])  # the need is linear in num_envs
        advice = f"; num_envs={int((value - 1) * share) + 1} would fit"
    raise UserError(
        f"{name}={value}: this training needs at least {need / 1e9:,.1f} GB of memory; "
        f"{have / 1e9:,.1f} GB are available{advice}"
    )


def _minimize_options(config: Config) -> dict[str, Config]:
    """For each option that sets a size, the configuration with its smallest value."""
    sizes = {name: {name: 1} for name in ("num_envs", "num_steps", "num_seeds", "eval_episodes", "log_interval")}
    configs = {
        name: dataclasses.replace(config, run=dataclasses.replace(config.run, **size)) for name, size in sizes.items()
    }
    if config.network.widths:
        network = dataclasses.replace(config.network, widths=[1 for _ in config.network.widths])
        configs["network.widths"] = dataclasses.replace(config, network=network)
    return configs


def estimate_memory(config: Config, env: Env) -> int:
    """Bytes that a run holds at once: the agents' states, their rollouts, and the metrics of a chunk.

    This is a lower bound: XLA may use more.
    """
    run, algo, networks = config.run, config.algo, make_networks(config, env)
    state, params = (jax.eval_shape(fn, jax.random.key(0)) for fn in (env.reset, networks.init))
    env_bytes, param_bytes, observation_size = count_bytes(state), count_bytes(params), state.obs.shape[-1]
    # Adam has two more numbers per parameter; traces have one per parameter and environment.
    agent = param_bytes * (3 if algo.keeps_rollouts else run.num_envs) + env_bytes * run.num_envs
    # The rollout, and the batch made from it with the activations that gradients need.
    hidden = count_activations(networks, params, state.obs) // algo.minibatches
    step = 2 * observation_size + 2 * env.action_size + SCALARS + hidden
    rollout = NUMBER * step * run.num_steps * run.num_envs if algo.keeps_rollouts else 0
    episodes = env_bytes * run.eval_episodes
    chunk = NUMBER * METRICS * plan(config).chunk
    at_once = min(config.num_agents, run.vmap_seeds * count_parallel_groups(config))
    return (agent + chunk) * (config.num_agents + at_once) + max(rollout, episodes) * at_once


def count_activations(networks: Networks, params: PyTree, obs: PyTree) -> int:
    """Number of results of the matrix products of actor and critic per observation, which backpropagation stores.

    Args:
      networks: actor and critic.
      params, obs: arrays, or their shapes and types.
    """

    def both(params, obs):
        return networks.policy(params["actor"], obs), networks.value(params["critic"], obs)

    return sum(_find_product_sizes(jax.make_jaxpr(both)(params, obs).jaxpr))


def _find_product_sizes(jaxpr: Any) -> Iterator[int]:
    """The sizes of the results of all matrix products, including those in inner functions."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation.outvars[0].aval.size
        for inner in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns")):
            if hasattr(inner, "eqns"):
                yield from _find_product_sizes(inner)


def count_bytes(tree: PyTree) -> int:
    """Bytes of the arrays in a tree, which may be shapes and types only."""
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def find_available_memory() -> int | None:
    """Bytes that the process can still get from the machine, its cgroup and its limits; None if unknown."""
    return min(_read_limits(), default=None)


def _read_limits() -> Iterator[int]:
    with contextlib.suppress(OSError, ValueError):
        fields = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        yield 1024 * int(fields["MemAvailable"].split()[0])
    for *paths, name in CGROUPS:
        with contextlib.suppress(OSError, ValueError, KeyError):  # "max" means no limit
            limit, usage, details = (Path("/sys/fs/cgroup", path).read_text() for path in paths)
            cached = int(dict(line.split() for line in details.splitlines())[name])
            yield max(int(limit) - int(usage) + cached, 0)
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    if soft != resource.RLIM_INFINITY:
        yield soft
