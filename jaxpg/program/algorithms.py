"""Builds the algorithm of a run from its configuration.

Each algorithm is a function here, `build(config, env) -> Algorithm` for one agent, and an entry with its options in
`jaxpg.config.entries.ALGORITHMS`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable
from typing import Any

import jax
import optax

from envs.base import Env
from jaxpg import baselines, estimators, methods, shards
from jaxpg.actor_critic import actor_critic
from jaxpg.baselines import Baseline, of_returns, of_scores
from jaxpg.config.configuration import Config
from jaxpg.config.entries import ALGORITHMS
from jaxpg.estimators import Estimator
from jaxpg.methods import Method
from jaxpg.online import online_actor_critic
from jaxpg.ppo import ppo
from jaxpg.program.environment import get_training_length
from jaxpg.program.networks import make_networks
from jaxpg.program.schedule import plan
from jaxpg.program.sigma import keep_params, label_params, make_sigma_schedule, schedule_sigma
from jaxpg.types import Algorithm
from jaxpg.updates import scale_by_progress
from jaxpg.vector_env import vectorize

ESTIMATORS: dict[str, Callable[[Any], Estimator]] = {
    "td_lambda": lambda algo: estimators.gae(algo.lambda_),
    "td_zero": lambda algo: estimators.gae(0.0),
    "n_step": lambda algo: estimators.n_rewards(algo.n),
    "monte_carlo": lambda algo: estimators.gae(1.0),
}
BASELINES: dict[str, Baseline] = {
    "none": baselines.zero,
    "mean": of_returns(baselines.batch_mean),
    "time_mean": of_returns(baselines.time_mean),
    "leave_one_out": of_returns(baselines.leave_one_out),
    "optimal": of_scores(baselines.optimal),
    "value": baselines.critic,
}
RETURNS = {"to_go": estimators.reinforce, "whole": estimators.reinforce_whole}


def make_algorithm(config: Config, env: Env) -> Algorithm:
    """One agent's algorithm, as pure functions."""
    algorithm = ALGORITHMS[config.choices["algo"]].make(config, env)
    if config.network.sigma_is == "scheduled":
        return schedule_sigma(algorithm, make_sigma_schedule(config))
    return algorithm


def make_td(config: Config, env: Env) -> Algorithm:
    """Builds the entry `td`."""
    return _make_on_policy(actor_critic, config, env, make_td_method(config))


def make_ppo(config: Config, env: Env) -> Algorithm:
    """Builds the entry `ppo`."""
    names = ("epochs", "minibatches", "clip", "value_clip", "max_kl")
    return _make_on_policy(
        ppo, config, env, make_td_method(config), **{name: getattr(config.algo, name) for name in names}
    )


def make_reinforce(config: Config, env: Env) -> Algorithm:
    """Builds the entry `reinforce`."""
    return _make_on_policy(actor_critic, config, env, make_reinforce_method(config))


def make_online(config: Config, env: Env) -> Algorithm:
    """Builds the entry `online`."""
    vector_env = vectorize(env, config.run.num_envs, get_training_length(config))
    return online_actor_critic(
        vector_env, make_networks(config, env), num_steps=config.run.rollout_steps, **dataclasses.asdict(config.algo)
    )


def make_td_method(config: Config) -> Method:
    """The method with the options of TD or PPO."""
    algo = config.algo
    return methods.td(algo.gamma, config.run.rollout_steps, ESTIMATORS[algo.estimator](algo))


def make_reinforce_method(config: Config) -> Method:
    """The method with the options of REINFORCE."""
    algo = config.algo
    return methods.reinforce(algo.gamma, BASELINES[algo.baseline], RETURNS[algo.returns], algo.discounted)


def _make_on_policy(
    make: Callable[..., Algorithm], config: Config, env: Env, method: Method, **options: Any
) -> Algorithm:
    """`actor_critic` or `ppo` with Adam; with the environments in shards if configured.

    Args:
      make: `actor_critic` or `ppo`.
      config, env: configuration and environment of the run.
      method: how to collect steps and estimate advantages.
      options: further options of `make`.
    """
    algo, number = config.algo, config.algo.num_shards
    algorithm = make(
        vectorize(env, config.run.num_envs // number, get_training_length(config)),
        make_networks(config, env),
        make_optimizer(config),
        method,
        reward_scale=algo.reward_scale,
        entropy_coef=algo.entropy_coef,
        normalize_observations=algo.normalize_observations,
        normalize_advantages=algo.normalize_advantages,
        axis_name=shards.AXIS if number > 1 else None,
        **options,
    )
    return shards.shard(algorithm, number, jax.devices()) if number > 1 else algorithm


def make_optimizer(config: Config) -> optax.GradientTransformation:
    """Adam for actor and critic separately, with clipped gradients and step sizes that decrease over the run."""
    algo = config.algo
    horizon = plan(config).num_updates * algo.gradient_steps

    def adam(step_size):
        schedule = optax.linear_schedule(step_size, step_size * algo.final_lr, horizon)
        steps = optax.chain(optax.scale_by_adam(eps=1e-5), scale_by_progress(lambda progress: -1 * schedule(progress)))
        return optax.chain(optax.clip_by_global_norm(algo.max_gradient_norm), steps)

    optimizers: dict[Hashable, optax.GradientTransformation] = {
        "actor": adam(algo.actor_lr),
        "critic": adam(algo.critic_lr),
    }
    if config.network.sigma_is != "scheduled":
        return optax.multi_transform(optimizers, {"actor": "actor", "critic": "critic"})
    return optax.multi_transform({**optimizers, "sigma": keep_params()}, label_params)
