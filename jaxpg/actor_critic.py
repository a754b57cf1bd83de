"""The actor-critic: rollout, advantage estimate and one gradient step as a pure `Algorithm`.

REINFORCE and TD are the same program. They differ in one argument, the `Method` (`jaxpg.methods`).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax

from jaxpg import collectives, divergence, normalization
from jaxpg.batch import batch_fn, usable_steps
from jaxpg.methods import Method
from jaxpg.networks import Networks
from jaxpg.policy import sampling_policy
from jaxpg.shapes import select
from jaxpg.types import Algorithm, Metrics, TrainState
from jaxpg.updates import Update, actor_critic_loss, gradient_step
from jaxpg.vector_env import VectorEnv, episode_metrics


def actor_critic(
    env: VectorEnv,
    networks: Networks,
    optimizer: optax.GradientTransformation,
    method: Method,
    *,
    entropy_coef: float = 0.0,
    axis_name: str | None = None,
    **options: Any,
) -> Algorithm:
    """Policy-gradient training of an actor and a critic, one gradient step for each rollout.

        L(theta, w) = -mean(log pi_theta(a_t | s_t) A_t) + 1/2 mean((V_w(s_t) - target_t)^2) - entropy_coef mean(H_t)

    Args:
      env, networks, optimizer, method, axis_name: as in `on_policy`.
      entropy_coef: weight of the policy's entropy; of a squashed one estimated by its samples.
      options: further ones of `on_policy`.

    Returns:
      As `on_policy`.
    """
    update = gradient_step(actor_critic_loss(networks, entropy_coef), optimizer, axis_name)
    return on_policy(env, networks, optimizer, method, update, axis_name=axis_name, **options)


def on_policy(
    env: VectorEnv,
    networks: Networks,
    optimizer: optax.GradientTransformation,
    method: Method,
    update: Update,
    *,
    reward_scale: float = 1.0,
    normalize_observations: bool = True,
    normalize_advantages: bool = True,
    axis_name: str | None = None,
) -> Algorithm:
    """Rollout, advantage estimate and `update`, again and again: what `actor_critic` and `jaxpg.ppo.ppo` share.

    Args:
      env: N environments.
      networks: policy and value; their parameters are apart, so the two losses may be added.
      optimizer: of `{"actor": ..., "critic": ...}`.
      method: `td(...)` or `reinforce(...)`.
      update: what is done with a rollout's `Batch`, such as `jaxpg.updates.gradient_step(...)`.
      reward_scale: factor on the rewards that the estimator and the critic see; reported returns are not scaled.
      normalize_observations: feed the networks (s - mean) / std with running statistics, updated after each step.
        Episodes whose physics diverges in the rollout are left out of them. What is learned leaves out these and those
        that are about to diverge (`usable_steps`); where nothing is left, the parameters stay as they are.
      normalize_advantages: mean 0 and standard deviation 1 over the rollout.
      axis_name: a mapped axis, along which further parts of the agent's environments are (`jaxpg.shards`); not with
        `reinforce`, whose baselines and masks are of one part.

    Returns:
      `Algorithm(init, step)`; metrics are scalars, of which `return_sum`, `episodes` and `diverged` are to be summed
      over updates and the others averaged.
    """
    prepare = batch_fn(networks, method, env.episode_length, reward_scale, normalize_advantages, axis_name)

    def init(key: jax.Array) -> TrainState:
        key_params, key_env = jax.random.split(key)
        params = networks.init(key_params)
        return TrainState(
            params=params,
            opt_state=optimizer.init(params),
            normalizer=normalization.init(env.observation_size),
            env_state=method.start(env, collectives.fold_in_index(key_env, axis_name)),
            update=jnp.zeros((), jnp.int32),
        )

    def step(state: TrainState, key: jax.Array) -> tuple[TrainState, Metrics]:
        key_rollout, key_learn = jax.random.split(key)
        policy_fn = sampling_policy(networks, state.params, state.normalizer)
        key_rollout = collectives.fold_in_index(key_rollout, axis_name)
        env_state, transition = method.collect(env, policy_fn, state.env_state, key_rollout)
        sound = divergence.lasting(transition.diverged > 0, transition.ended)
        statistics = normalization.update(state.normalizer, transition.obs, axis_name, sound)
        counts = usable_steps(transition, statistics)
        batch = prepare(state.params, state.normalizer, transition, counts)
        params, opt_state, metrics = update(state.params, state.opt_state, batch, key_learn, state.update)
        something = collectives.largest(jnp.max(batch.weight), axis_name) > 0
        params, opt_state = select(something, (params, opt_state), (state.params, state.opt_state))
        normalizer = statistics if normalize_observations else state.normalizer
        metrics = metrics | episode_metrics(transition, axis_name)
        return TrainState(params, opt_state, normalizer, env_state, state.update + 1), metrics

    return Algorithm(init, step)
