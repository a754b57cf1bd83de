"""The algorithms of a run, by the name that the configuration gives them.

An algorithm is a function here, `build(config, env) -> Algorithm` of one agent, and an entry with its options in
`jaxpg.config.schema.ALGORITHMS`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import optax

from jaxpg import actor_critic, baselines, estimators, shards
from jaxpg.actor_critic import Baseline, Method, critic, no_baseline, of_returns, of_scores
from jaxpg.config.configuration import Config
from jaxpg.config.schema import ALGORITHMS
from jaxpg.estimators import Estimator
from jaxpg.learning import Reuse, scale_by_progress
from jaxpg.online import online_actor_critic
from jaxpg.program.environment import training_length
from jaxpg.program.networks import make_networks
from jaxpg.program.schedule import plan
from jaxpg.program.sigma import labels, left_alone, log_sigma, with_sigma
from jaxpg.types import Algorithm
from jaxpg.vector_env import vectorize

ESTIMATORS: dict[str, Callable[[Any], Estimator]] = {
    "td_lambda": lambda algo: estimators.gae(algo.lambda_),
    "td_zero": lambda algo: estimators.gae(0.0),
    "n_step": lambda algo: estimators.n_rewards(algo.n),
    "monte_carlo": lambda algo: estimators.gae(1.0),
}
BASELINES: dict[str, Baseline] = {
    "none": no_baseline,
    "mean": of_returns(baselines.batch_mean),
    "time_mean": of_returns(baselines.time_mean),
    "leave_one_out": of_returns(baselines.leave_one_out),
    "optimal": of_scores(baselines.optimal),
    "value": critic,
}
RETURNS = {"to_go": estimators.reinforce, "whole": estimators.reinforce_whole}


def make_algorithm(config: Config, env: Any) -> Algorithm:
    """One agent's algorithm, as pure functions."""
    algorithm = ALGORITHMS[config.choices["algo"]].built(config, env)
    return with_sigma(algorithm, log_sigma(config)) if config.network.sigma_is == "scheduled" else algorithm


def td(config: Config, env: Any) -> Algorithm:
    """The entry `td`."""
    return _actor_critic(config, env, td_method(config))


def ppo(config: Config, env: Any) -> Algorithm:
    """The entry `ppo`."""
    return _actor_critic(config, env, td_method(config), make_reuse(config))


def reinforce(config: Config, env: Any) -> Algorithm:
    """The entry `reinforce`."""
    return _actor_critic(config, env, reinforce_method(config))


def online(config: Config, env: Any) -> Algorithm:
    """The entry `online`."""
    batch = vectorize(env, config.run.num_envs, training_length(config))
    return online_actor_critic(
        batch, make_networks(config, env), num_steps=config.run.num_steps, **dataclasses.asdict(config.algo)
    )


def td_method(config: Config) -> Method:
    """The estimator of the options of TD and PPO."""
    algo = config.algo
    return actor_critic.td(algo.gamma, config.run.num_steps, ESTIMATORS[algo.estimator](algo))


def reinforce_method(config: Config) -> Method:
    """The estimator of the options of REINFORCE."""
    algo = config.algo
    return actor_critic.reinforce(algo.gamma, BASELINES[algo.baseline], RETURNS[algo.returns], algo.discounted)


def make_reuse(config: Config) -> Reuse:
    """How often PPO learns from a rollout, and within which bounds."""
    return Reuse(**{name: getattr(config.algo, name) for name in Reuse._fields})


def _actor_critic(config: Config, env: Any, method: Method, reuse: Reuse | None = None) -> Algorithm:
    """Whole rollouts, learned from with Adam; its environments in shards where that is asked for."""
    algo, number = config.algo, config.algo.num_shards
    algorithm = actor_critic.actor_critic(
        vectorize(env, config.run.num_envs // number, training_length(config)),
        make_networks(config, env),
        make_optimizer(config),
        method,
        reuse=reuse,
        reward_scale=algo.reward_scale,
        entropy_coef=algo.entropy_coef,
        normalize_observations=algo.normalize_observations,
        normalize_advantages=algo.normalize_advantages,
        axis_name=shards.AXIS if number > 1 else None,
    )
    return shards.sharded(algorithm, number, jax.devices()) if number > 1 else algorithm


def make_optimizer(config: Config) -> optax.GradientTransformation:
    """Adam for actor and critic apart, with shortened gradients and step sizes that fall with the run's progress."""
    algo = config.algo
    horizon = plan(config).num_updates * algo.gradient_steps

    def adam(step_size):
        schedule = optax.linear_schedule(step_size, step_size * algo.final_lr, horizon)
        steps = optax.chain(optax.scale_by_adam(eps=1e-5), scale_by_progress(lambda progress: -1 * schedule(progress)))
        return optax.chain(optax.clip_by_global_norm(algo.max_gradient_norm), steps)

    optimizers = {"actor": adam(algo.actor_lr), "critic": adam(algo.critic_lr)}
    if config.network.sigma_is != "scheduled":
        return optax.multi_transform(optimizers, {"actor": "actor", "critic": "critic"})
    return optax.multi_transform(optimizers | {"sigma": left_alone()}, labels)
