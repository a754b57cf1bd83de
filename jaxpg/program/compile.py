"""Compiles the functions of a training run."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import numpy as np

from envs.base import Env
from envs.batches import divide_batch
from jaxpg.config.configuration import Config
from jaxpg.evaluation import Episodes, evaluate
from jaxpg.nonfinite import skip_nonfinite, stop_at_nonfinite
from jaxpg.policy import deterministic_policy
from jaxpg.program.agents import Agents, list_agents, replace_values
from jaxpg.program.algorithms import make_algorithm
from jaxpg.program.backend import OPTIMIZED, RUN_ONCE
from jaxpg.program.mapping import count_parallel_groups, map_in_groups, map_over_agents
from jaxpg.program.networks import make_networks
from jaxpg.program.state import Policy, RunState, get_policy, make_initial_run
from jaxpg.training import train_chunk
from jaxpg.types import TrainState

# Evaluations in training use the same starts in every run; those of `jaxpg.evaluate` differ.
SELECTION_SEED = 2**31


class Program(NamedTuple):
    """The compiled functions of a run; every state and result has a leading axis of agents, `[S, ...]`.

    Attributes:
      init: `init() -> RunState`; None if the run is resumed.
      advance: `advance(TrainState, number=chunk) -> (TrainState, metrics)`, at most a chunk; metrics are `[S, number]`.
      evaluate: `evaluate(Policy) -> Episodes` `[S, eval_episodes]`.
      state_shape: shapes and types of the run's state.
    """

    init: Callable[[], RunState] | None
    advance: Callable[..., tuple[TrainState, dict[str, np.ndarray]]]
    evaluate: Callable[[Policy], Episodes]
    state_shape: RunState


NAN_POLICIES = {"stop": stop_at_nonfinite, "skip": skip_nonfinite}


def compile_program(
    config: Config,
    env: Env,
    chunk: int,
    agents: Agents | None = None,
    resumed: bool = False,
    meanwhile: Callable[[], None] = lambda: None,
) -> Program:
    """Traces and compiles up to `chunk` updates, the evaluation and the initial state of a run.

    The program is compiled for groups of `vmap_seeds` agents, which share the cores. On a CPU this is faster than one
    program for all agents, and gives each agent the same bits as alone. Seeds and swept values are arguments: an agent
    has the same bits as in a run of its own with the same options swept, and up to rounding the same numbers as in a
    run with these options as constants.

    Args:
      config, env: configuration and environment of the run.
      chunk: maximum number of updates in one call.
      agents: by default, the agents of the configuration.
      resumed: whether the state comes from a checkpoint, so that `init` is not compiled.
      meanwhile: called once, while XLA compiles in other threads.
    """
    size, agents = config.run.vmap_seeds, agents or list_agents(config)
    init, advance, play = (map_over_agents(fn, size) for fn in _make_agent_functions(config, env, chunk))
    group = jax.tree.map(lambda x: x[:size], agents)
    traced = jax.jit(init).trace(group)
    shape = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), traced.out_info)
    with _compiler_pool() as pool:
        # Tracing holds Python's lock and compiling does not. So the functions are traced one after the other, starting
        # with the one that takes longest to compile.
        advance_future = pool.submit(jax.jit(advance).lower(group, shape.train, number=chunk).compile, OPTIMIZED)
        start_future = None if resumed else pool.submit(traced.lower().compile, RUN_ONCE)
        play_future = pool.submit(jax.jit(play).lower(get_policy(shape.train)).compile, OPTIMIZED)
        meanwhile()
        start_group = start_future and start_future.result()
        advance_group, play_group = advance_future.result(), play_future.result()
    map_all = functools.partial(map_in_groups, size=size, at_once=count_parallel_groups(config))
    advance_all = map_all(advance_group)

    def advance_by(train, number=chunk):
        train, metrics = advance_all(agents, train, number=number)
        return train, {name: np.asarray(x)[:, :number] for name, x in metrics.items()}

    return Program(
        functools.partial(map_all(start_group), agents) if start_group else None,
        advance_by,
        map_all(play_group),
        jax.tree.map(lambda x: jax.ShapeDtypeStruct((len(agents.seed), *x.shape[1:]), x.dtype), shape),
    )


def _make_agent_functions(config: Config, env: Env, chunk: int) -> tuple[Callable, Callable, Callable]:
    """`init(agent)`, `advance(agent, train, number)` and `play(policy)` of one agent, to be traced."""
    run, networks = config.run, make_networks(config, env)

    def algorithm(agent):
        return NAN_POLICIES[run.nan_policy](make_algorithm(replace_values(config, agent.values), env))

    def init(agent):
        return make_initial_run(algorithm(agent), agent.seed)

    def advance(agent, train, number):
        return train_chunk(algorithm(agent), jax.random.key(agent.seed), chunk, number, train)

    def play_from(policy, starts):
        act = deterministic_policy(networks, policy.params, policy.normalizer)
        return evaluate(env, act, starts, config.env.episode_length)

    def play(policy):
        starts = jax.random.split(jax.random.key(SELECTION_SEED), run.eval_episodes)
        return divide_batch(play_from, (None, 0), jax.devices()[: config.num_shards])(policy, starts)

    return init, advance, play


@contextlib.contextmanager
def _compiler_pool() -> Iterator[ThreadPoolExecutor]:
    """Threads for compilation; exceptions do not wait for them, as XLA cannot be interrupted."""
    pool = ThreadPoolExecutor()
    try:
        yield pool
    finally:
        pool.shutdown(wait=False)
