"""The actor-critic: rollout, advantage estimate and one gradient step as a pure `Algorithm`.

REINFORCE and TD are the same program. They differ only in the argument `method` (`jaxpg.methods`).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax

from jaxpg import collectives, divergence, normalization
from jaxpg.batch import find_usable_steps, make_batch_fn
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
    """Policy-gradient training of an actor and a critic, with one gradient step per rollout.

        L(theta, w) = -mean(log pi_theta(a_t | s_t) A_t) + 1/2 mean((V_w(s_t) - target_t)^2) - entropy_coef mean(H_t)

    Args:
      env, networks, optimizer, method, axis_name: as in `on_policy`.
      entropy_coef: weight of the policy's entropy, which is estimated from samples if the policy is squashed.
      options: other options of `on_policy`.

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
    """The loop of rollout, advantage estimate and `update` that `actor_critic` and `jaxpg.ppo.ppo` share.

    Args:
      env: N environments.
      networks: policy and value; they share no parameters, so the two losses may be added.
      optimizer: optimizer of the parameters, `{"actor": ..., "critic": ...}`.
      method: `td(...)` or `reinforce(...)`.
      update: update of the parameters from a rollout's `Batch`, such as `jaxpg.updates.gradient_step(...)`.
      reward_scale: factor on the rewards for the estimator and the critic; reported returns are not scaled.
      normalize_observations: feed the networks (s - mean) / std with running statistics, updated after each step. The
        statistics ignore episodes whose physics diverges in the rollout; learning also ignores those that are about to
        diverge (`find_usable_steps`). If no steps are left, the parameters do not change.
      normalize_advantages: scale the advantages to mean 0 and standard deviation 1 over the rollout.
      axis_name: mapped axis over which the agent's environments are divided (`jaxpg.shards`); not with `reinforce`,
        whose baselines and masks see only one part.

    Returns:
      `Algorithm(init, step)`; metrics are scalars. To combine several updates, sum `return_sum`, `episodes` and
      `diverged`, and average the others.
    """
    prepare = make_batch_fn(networks, method, env.episode_length, reward_scale, normalize_advantages, axis_name)

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
        is_sound = divergence.find_sound_steps(transition.diverged > 0, transition.ended)
        statistics = normalization.update(state.normalizer, transition.obs, axis_name, is_sound)
        counts = find_usable_steps(transition, statistics)
        batch = prepare(state.params, state.normalizer, transition, counts)
        params, opt_state, metrics = update(state.params, state.opt_state, batch, key_learn, state.update)
        any_counts = collectives.maximum(jnp.max(batch.weight), axis_name) > 0
        params, opt_state = select(any_counts, (params, opt_state), (state.params, state.opt_state))
        normalizer = statistics if normalize_observations else state.normalizer
        metrics = metrics | episode_metrics(transition, axis_name)
        return TrainState(params, opt_state, normalizer, env_state, state.update + 1), metrics

    return Algorithm(init, step)
