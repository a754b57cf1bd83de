"""From a configuration to the compiled functions of a training run."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.stages import Compiled

import envs
from envs.options import OptionError
from jaxpg import shards
from jaxpg.actor_critic import Method, actor_critic, deterministic_policy, reinforce, td
from jaxpg.distributions import GAUSSIAN, SQUASHED_GAUSSIAN
from jaxpg.evaluation import Episodes, evaluate
from jaxpg.features import num_features
from jaxpg.learning import Reuse, scale_by_progress
from jaxpg.networks import Networks, linear_networks, mlp_networks
from jaxpg.online import online_actor_critic
from jaxpg.run.agents import Agents, agents_of, with_values
from jaxpg.run.config import Config
from jaxpg.run.schedule import plan
from jaxpg.run.sigma import labels, left_alone, log_sigma, with_sigma
from jaxpg.run.state import Policy, RunState, current_policy, is_key, start
from jaxpg.run.versions import num_threads
from jaxpg.soundness import sound
from jaxpg.training import initial_state, train_chunk
from jaxpg.types import Algorithm, Metrics, TrainState
from jaxpg.vector_env import vectorize

# Evaluations during training play the same starts in every run; `jaxpg.evaluate` draws others.
SELECTION_SEED = 2**31
# Of LLVM. With 3, XLA's default, a training compiles a quarter longer and runs no faster.
OPTIMIZED, RUN_ONCE = ({"xla_backend_optimization_level": level} for level in (2, 0))
MAX_FEATURES = 10_000  # a grid over many observations is soon beyond any memory


class Program(NamedTuple):
    """The compiled functions of a run; every state and result has the agents as its leading axis `[S, ...]`.

    Attributes:
      init: `init() -> RunState`; None in the program of a run that is resumed.
      advance: `advance(TrainState, number=chunk) -> (TrainState, metrics)`, up to a chunk; metrics are `[S, number]`.
      evaluate: `evaluate(Policy) -> Episodes` `[S, eval_episodes]`.
      state_shape: shapes and types of the run's state.
    """

    init: Callable[[], RunState] | None
    advance: Callable[..., tuple[TrainState, Metrics]]
    evaluate: Callable[[Policy], Episodes]
    state_shape: RunState


def make_env(config: Config) -> Any:
    """The environment; raises OptionError where it has a mistake to report, or where the features do not fit it."""
    env = envs.of_config(config.choices["env"], config.env)
    _check_features(config.network, env.observation_size)
    return env


def _check_features(network: Any, observation_size: int) -> None:
    number = num_features(network.features, observation_size, network.order)
    if number > MAX_FEATURES:
        name = f"network.features={network.features} network.order={network.order}"
        raise OptionError([f"{name}: {number:,} features of {observation_size} observations; at most {MAX_FEATURES:,}"])


def make_networks(config: Config, env: Any) -> Networks:
    network = config.network
    sizes = env.observation_size, env.action_size
    shared = {
        "features": network.features,
        "order": network.order,
        "initial_std": network.sigma,
        "sigma": network.sigma_is,
        "distribution": SQUASHED_GAUSSIAN if network.squash else GAUSSIAN,
    }
    if config.choices["network"] == "linear":
        return linear_networks(*sizes, **shared)
    return mlp_networks(*sizes, network.widths, network.activation, **shared)


def make_algorithm(config: Config, env: Any) -> Algorithm:
    """One agent's algorithm, as pure functions."""
    algorithm = _make_algorithm(config, env)
    return with_sigma(algorithm, log_sigma(config)) if config.network.sigma_is == "scheduled" else algorithm


def _make_algorithm(config: Config, env: Any) -> Algorithm:
    algo, run, number = config.algo, config.run, config.num_shards
    batch = vectorize(env, run.num_envs // number, training_length(config))
    networks = make_networks(config, env)
    if config.choices["algo"] == "online":
        return online_actor_critic(batch, networks, num_steps=run.num_steps, **dataclasses.asdict(algo))
    algorithm = actor_critic(
        batch,
        networks,
        make_optimizer(config),
        make_method(config),
        reuse=make_reuse(config),
        reward_scale=algo.reward_scale,
        entropy_coef=algo.entropy_coef,
        normalize_observations=algo.normalize_observations,
        normalize_advantages=algo.normalize_advantages,
        axis_name=shards.AXIS if number > 1 else None,
    )
    return shards.sharded(algorithm, number, jax.devices()) if number > 1 else algorithm


def groups_at_once(config: Config) -> int:
    """Groups of agents that compute at the same time: with shards, which meet, one could wait for another for ever."""
    return num_threads() if config.num_shards == 1 else 1


def training_length(config: Config) -> int:
    """Steps of a training episode; TD may cut it before the time limit, where it bootstraps all the same."""
    limit = config.env.episode_length
    return min(getattr(config.algo, "episode_length", None) or limit, limit)


def make_method(config: Config) -> Method:
    algo = config.algo
    if config.choices["algo"] == "reinforce":
        return reinforce(algo.gamma, algo.baseline, algo.returns, algo.discounted)
    return td(algo.gamma, algo.lambda_, config.run.num_steps, algo.estimator, algo.n)


def make_reuse(config: Config) -> Reuse | None:
    """How often a rollout is learned from; None is once."""
    if config.choices["algo"] != "ppo":
        return None
    return Reuse(**{name: getattr(config.algo, name) for name in Reuse._fields})


def make_optimizer(config: Config) -> optax.GradientTransformation:
    """Adam for actor and critic apart, with shortened gradients and step sizes that fall with the run's progress."""
    algo, reuse = config.algo, make_reuse(config)
    horizon = plan(config).num_updates * (reuse.steps if reuse else 1)

    def adam(step_size):
        schedule = optax.linear_schedule(step_size, step_size * algo.final_lr, horizon)
        steps = optax.chain(optax.scale_by_adam(eps=1e-5), scale_by_progress(lambda progress: -1 * schedule(progress)))
        return optax.chain(optax.clip_by_global_norm(algo.max_gradient_norm), steps)

    optimizers = {"actor": adam(algo.actor_lr), "critic": adam(algo.critic_lr)}
    if config.network.sigma_is != "scheduled":
        return optax.multi_transform(optimizers, {"actor": "actor", "critic": "critic"})
    return optax.multi_transform(optimizers | {"sigma": left_alone()}, labels)


def compile_program(
    config: Config,
    env: Any,
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
    init = jax.jit(init).trace(of_group)
    shape = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), init.out_info)
    with _compilers() as pool:
        # Tracing holds Python's lock and compiling does not: one trace after the other, that of the longest compilation
        # first, so that no compilation waits for another one's trace.
        advance = pool.submit(jax.jit(advance).lower(of_group, shape.train, number=chunk).compile, OPTIMIZED)
        init = None if resumed else pool.submit(init.lower().compile, RUN_ONCE)
        play = pool.submit(jax.jit(play).lower(current_policy(shape.train)).compile, OPTIMIZED)
        meanwhile()
    at_once = groups_at_once(config)
    init, advance, play = (in_groups(fn.result(), size, at_once) if fn else None for fn in (init, advance, play))

    def advance_by(train, number=chunk):
        train, metrics = advance(agents, train, number=number)
        return train, {name: np.asarray(x)[:, :number] for name, x in metrics.items()}

    return Program(
        functools.partial(init, agents) if init else None,
        advance_by,
        play,
        jax.tree.map(lambda x: jax.ShapeDtypeStruct((len(agents.seed), *x.shape[1:]), x.dtype), shape),
    )


def _of_one_agent(config: Config, env: Any, chunk: int) -> tuple[Callable, Callable, Callable]:
    """`init(agent)`, `advance(agent, train, number)` and `play(policy)`, to be traced."""
    run, networks = config.run, make_networks(config, env)

    def algorithm(agent):
        return sound(make_algorithm(with_values(config, agent.values), env), run.nan_policy)

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
        return shards.in_parts(play_from, parts, jax.devices())(policy, starts)

    return init, advance, play


@contextlib.contextmanager
def _compilers() -> Iterator[ThreadPoolExecutor]:
    """Threads to compile in, for which an exception does not wait: XLA cannot be interrupted."""
    pool = ThreadPoolExecutor()
    try:
        yield pool
    finally:
        pool.shutdown(wait=False)


def initial_run(algorithm: Algorithm, seed: jax.Array) -> RunState:
    """One agent's run before its first update."""
    return start(initial_state(algorithm, jax.random.key(seed)))


def state_shape(algorithm: Algorithm, num_agents: int) -> RunState:
    """Shapes and types of a run's state, `[S, ...]`."""
    one = jax.eval_shape(functools.partial(initial_run, algorithm), np.uint32(0))
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((num_agents, *x.shape), x.dtype), one)


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
