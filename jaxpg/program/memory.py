"""Whether a run fits into the machine's memory, before anything is written or compiled.

Linux kills a process that takes more than there is, without a word: the only defence is to ask for less.
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
from jaxpg.program.mapping import groups_at_once
from jaxpg.program.networks import make_networks
from jaxpg.program.schedule import plan
from jaxpg.types import PyTree

NUMBER = 4  # bytes
# Of a step of an environment, beside observations and actions: reward, ends, returns, values, advantages, ...
SCALARS = 5
METRICS = 16  # numbers that an update reports
# Where a container's limit, its use and what of that it can give back are told, by cgroups in version 2 and 1.
CGROUPS = (
    ("memory.max", "memory.current", "memory.stat", "inactive_file"),
    ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat", "total_inactive_file"),
)


def check(config: Config, env: Env) -> None:
    """Raises UserError where the run needs more memory than is available; it names the option that takes the most."""
    need, have = needed(config, env), available()
    if have is None or need <= have:
        return
    least = {name: needed(smallest, env) for name, smallest in _smallest(config).items()}
    name = min(least, key=least.__getitem__)
    value, advice = flatten(config)[name], ""
    if name == "num_envs" and have > least[name]:
        share = (have - least[name]) / (need - least[name])  # what is needed is linear in num_envs
        advice = f"; num_envs={int((value - 1) * share) + 1} would fit"
    raise UserError(
        f"{name}={value}: such a training needs {need / 1e9:,.1f} GB of memory or more, "
        f"{have / 1e9:,.1f} GB are available{advice}"
    )


def _smallest(config: Config) -> dict[str, Config]:
    """The configuration with one of its sizes as small as it can be, by the size's name."""
    runs = {name: {name: 1} for name in ("num_envs", "num_steps", "num_seeds", "eval_episodes", "log_interval")}
    found = {
        name: dataclasses.replace(config, run=dataclasses.replace(config.run, **size)) for name, size in runs.items()
    }
    if config.network.widths:
        network = dataclasses.replace(config.network, widths=[1 for _ in config.network.widths])
        found["network.widths"] = dataclasses.replace(config, network=network)
    return found


def needed(config: Config, env: Env) -> int:
    """Bytes of what a run holds at once: the agents' states, the rollouts that are learned from, a chunk's metrics.

    It is an estimate from below: XLA may keep more.
    """
    run, algo, networks = config.run, config.algo, make_networks(config, env)
    state, params = (jax.eval_shape(fn, jax.random.key(0)) for fn in (env.reset, networks.init))
    of_env, of_params, observation_size = num_bytes(state), num_bytes(params), state.obs.shape[-1]
    # Of Adam there are two further numbers for each parameter; of traces one in each environment.
    agent = of_params * (3 if algo.keeps_rollouts else run.num_envs) + of_env * run.num_envs
    # A rollout as it was played, and the batch that is made of it, with what its gradients pass through.
    hidden = num_activations(networks, params, state.obs) // algo.minibatches
    step = 2 * observation_size + 2 * env.action_size + SCALARS + hidden
    rollout = NUMBER * step * run.num_steps * run.num_envs if algo.keeps_rollouts else 0
    episodes = of_env * run.eval_episodes
    chunk = NUMBER * METRICS * plan(config).chunk
    at_once = min(config.num_agents, run.vmap_seeds * groups_at_once(config))
    return (agent + chunk) * (config.num_agents + at_once) + max(rollout, episodes) * at_once


def num_activations(networks: Networks, params: PyTree, obs: PyTree) -> int:
    """How many numbers the matrix products of actor and critic give for one observation, which backpropagation keeps.

    Args:
      networks: actor and critic.
      params, obs: arrays, or their shapes and types.
    """

    def both(params, obs):
        return networks.policy(params["actor"], obs), networks.value(params["critic"], obs)

    return sum(_products(jax.make_jaxpr(both)(params, obs).jaxpr))


def _products(jaxpr: Any) -> Iterator[int]:
    """The sizes of the results of all matrix products, also of inner functions."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation.outvars[0].aval.size
        for inner in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns")):
            if hasattr(inner, "eqns"):
                yield from _products(inner)


def num_bytes(tree: PyTree) -> int:
    """Of the arrays in a tree, or of their shapes and types."""
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def available() -> int | None:
    """Bytes that the process can still have, of the machine, its control group and its limits; None if nobody says."""
    return min(_limits(), default=None)


def _limits() -> Iterator[int]:
    with contextlib.suppress(OSError, ValueError):
        fields = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        yield 1024 * int(fields["MemAvailable"].split()[0])
    for *paths, name in CGROUPS:
        with contextlib.suppress(OSError, ValueError, KeyError):  # "max" is no number, and no limit
            limit, usage, details = (Path("/sys/fs/cgroup", path).read_text() for path in paths)
            cached = int(dict(line.split() for line in details.splitlines())[name])
            yield max(int(limit) - int(usage) + cached, 0)
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    if soft != resource.RLIM_INFINITY:
        yield soft
