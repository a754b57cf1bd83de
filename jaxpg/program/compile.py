"""From a configuration to the compiled functions of a training run."""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import numpy as np

from envs.base import Env
from jaxpg import shards
from jaxpg.config.configuration import Config
from jaxpg.evaluation import Episodes, evaluate
from jaxpg.nonfinite import skip_nonfinite, stop_at_nonfinite
from jaxpg.policy import deterministic_policy
from jaxpg.program.agents import Agents, agents_of, with_values
from jaxpg.program.algorithms import make_algorithm
from jaxpg.program.allocator import trimming
from jaxpg.program.backend import OPTIMIZED, RUN_ONCE
from jaxpg.program.mapping import groups_at_once, in_groups, over_agents
from jaxpg.program.networks import make_networks
from jaxpg.program.state import Policy, RunState, current_policy, initial_run
from jaxpg.training import train_chunk
from jaxpg.types import TrainState

# Evaluations during training play the same starts in every run; `jaxpg.evaluate` draws others.
SELECTION_SEED = 2**31


class Program(NamedTuple):
    """The compiled functions of a run; every state and result has the agents as its leading axis `[S, ...]`.

    Attributes:
      init: `init() -> RunState`; None in the program of a run that is resumed.
      advance: `advance(TrainState, number=chunk) -> (TrainState, metrics)`, up to a chunk; metrics are `[S, number]`.
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
    """Traces and compiles up to `chunk` updates, the evaluation and the beginning of a run.

    What is compiled is for `vmap_seeds` agents; all agents are groups of as many, which share the cores. On a CPU that
    is faster than one program for all of them, and each agent has the bits that it has alone. Seeds and swept values
    are arguments; an agent has the bits of a run of its own with the same options swept, and but for rounding those of
    one where they are constants of the program.

    Args:
      config, env: of the run.
      chunk: updates of one call, at most.
      agents: by default those of the configuration.
      resumed: the state comes from a checkpoint; `init` is not compiled.
      meanwhile: called once while XLA compiles in other threads.
    """
    size, agents = config.run.vmap_seeds, agents or agents_of(config)
    init, advance, play = (over_agents(fn, size) for fn in _of_one_agent(config, env, chunk))
    of_group = jax.tree.map(lambda x: x[:size], agents)
    traced = jax.jit(init).trace(of_group)
    shape = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), traced.out_info)
    with trimming(), _compilers() as pool:
        # Tracing holds Python's lock and compiling does not: one trace after the other, that of the longest compilation
        # first, so that no compilation waits for another one's trace.
        advancing = pool.submit(jax.jit(advance).lower(of_group, shape.train, number=chunk).compile, OPTIMIZED)
        starting = None if resumed else pool.submit(traced.lower().compile, RUN_ONCE)
        playing = pool.submit(jax.jit(play).lower(current_policy(shape.train)).compile, OPTIMIZED)
        meanwhile()
        start_group, advance_group, play_group = starting and starting.result(), advancing.result(), playing.result()
    of_all = functools.partial(in_groups, size=size, at_once=groups_at_once(config))
    advance_all = of_all(advance_group)

    def advance_by(train, number=chunk):
        train, metrics = advance_all(agents, train, number=number)
        return train, {name: np.asarray(x)[:, :number] for name, x in metrics.items()}

    return Program(
        functools.partial(of_all(start_group), agents) if start_group else None,
        advance_by,
        of_all(play_group),
        jax.tree.map(lambda x: jax.ShapeDtypeStruct((len(agents.seed), *x.shape[1:]), x.dtype), shape),
    )


def _of_one_agent(config: Config, env: Env, chunk: int) -> tuple[Callable, Callable, Callable]:
    """`init(agent)`, `advance(agent, train, number)` and `play(policy)`, to be traced."""
    run, networks = config.run, make_networks(config, env)

    def algorithm(agent):
        return NAN_POLICIES[run.nan_policy](make_algorithm(with_values(config, agent.values), env))

    def init(agent):
        return initial_run(algorithm(agent), agent.seed)

    def advance(agent, train, number):
        return train_chunk(algorithm(agent), jax.random.key(agent.seed), chunk, number, train)

    def play_from(policy, starts):
        act = deterministic_policy(networks, policy.params, policy.normalizer)
        return evaluate(env, act, starts, config.env.episode_length)

    def play(policy):
        starts = jax.random.split(jax.random.key(SELECTION_SEED), run.eval_episodes)
        parts = math.gcd(run.eval_episodes, config.num_shards)
        return shards.map_in_parts(play_from, parts, jax.devices())(policy, starts)

    return init, advance, play


@contextlib.contextmanager
def _compilers() -> Iterator[ThreadPoolExecutor]:
    """Threads to compile in, for which an exception does not wait: XLA cannot be interrupted."""
    pool = ThreadPoolExecutor()
    try:
        yield pool
    finally:
        pool.shutdown(wait=False)
