"""The per-step actor-critic: actor and critic learn after every environment step, with eligibility traces.

This is the lesson's online update (sections 4.1, 7 and 8.1) with traces, for any networks and several environments.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxpg import divergence, normalization
from jaxpg.batch import neutralize
from jaxpg.networks import Networks
from jaxpg.policy import sampling_policy
from jaxpg.returns import td_errors
from jaxpg.rollout import rollout
from jaxpg.shapes import expand_like, select
from jaxpg.types import Algorithm, Metrics, PyTree, TrainState, Transition
from jaxpg.vector_env import VectorEnv, episode_metrics, stagger


class Traces(NamedTuple):
    """The eligibility traces of each environment's episode; leaves `[N, ...]`.

    Attributes:
      actor: z_theta, with the structure of the actor's parameters.
      critic: z_w, with the structure of the critic's parameters.
      factor: I = gamma^t, or 1 without discounting, `[N]`.
    """

    actor: PyTree
    critic: PyTree
    factor: jax.Array


def online_actor_critic(
    env: VectorEnv,
    networks: Networks,
    *,
    num_steps: int,
    gamma: float,
    lambda_actor: float,
    lambda_critic: float,
    actor_lr: float,
    critic_lr: float,
    reward_scale: float = 1.0,
    discounted: bool = False,
    normalize_observations: bool = True,
) -> Algorithm:
    """Actor-critic with one plain gradient update after every step.

        delta   = r_t + gamma V_w(s_{t+1}) - V_w(s_t)
        z_w     = gamma lambda_critic z_w + grad_w V_w(s_t)
        z_theta = gamma lambda_actor z_theta + I grad_theta log pi_theta(a_t | s_t)
        w      += alpha_c delta z_w
        theta  += alpha_a delta z_theta
        I       = gamma I

    All gradients are taken at the parameters before the update. Termination sets the discount of the bootstrap to 0; a
    time limit bootstraps from the value of the true next observation. Both reset the traces to 0 and I to 1. Each of N
    environments has its own traces, and the updates are averaged; N = 1 is the lesson's update.

    Args:
      env: N environments.
      networks: policy and value.
      num_steps: environment steps in one step of the `Algorithm`, each with an update of the parameters.
      gamma: discount, in [0, 1].
      lambda_actor, lambda_critic: decay of the accumulating traces, in [0, 1]; 0 is the lesson's update.
      actor_lr, critic_lr: alpha_a and alpha_c. Steps are not clipped, so learning diverges if these are too large.
      reward_scale: factor on the rewards for learning; reported returns are not scaled.
      discounted: use the factor I = gamma^t; without it I = 1, as in the lesson.
      normalize_observations: feed the networks (s - mean) / std with running statistics, updated after `num_steps`.

    Learning ignores steps whose physics diverges. With normalized observations it also ignores those more than
    `jaxpg.normalization.REACH` standard deviations from the mean, where an exploding joint would cause huge updates.
    Earlier steps of such an episode have already been learned from; they were like any others.

    Returns:
      `Algorithm(init, step)`, with those metrics of `actor_critic` that apply.

    Source: the lesson, sections 4.1, 7 and 8.1; Sutton and Barto, Reinforcement Learning, 2nd edition, section 13.5.
    """

    def make_zero_traces(params: PyTree) -> Traces:
        zeros = jax.tree.map(lambda x: jnp.zeros((env.num_envs, *x.shape), x.dtype), params)
        return Traces(zeros["actor"], zeros["critic"], jnp.ones(env.num_envs))

    def init(key: jax.Array) -> TrainState:
        key_params, key_reset, key_stagger = jax.random.split(key, 3)
        params = networks.init(key_params)
        env_state = stagger(env.reset(key_reset), key_stagger, env.episode_length)
        normalizer = normalization.init(env.observation_size)
        return TrainState(params, make_zero_traces(params), normalizer, env_state, jnp.zeros((), jnp.int32))

    update = trace_update(networks, gamma, lambda_actor, lambda_critic, actor_lr, critic_lr, reward_scale, discounted)

    def step(state: TrainState, key: jax.Array) -> tuple[TrainState, Metrics]:
        def step_once(carry, key):
            params, traces, env_state = carry
            policy_fn = sampling_policy(networks, params, state.normalizer)
            env_state, transition = rollout(policy_fn, env.step, env_state, key, length=1)
            transition = jax.tree.map(lambda x: x[0], transition)
            counts = find_learnable_steps(transition, state.normalizer, normalize_observations)
            params, traces, metrics = update(params, traces, state.normalizer, transition, counts)
            return (params, traces, env_state), (transition, metrics)

        carry = state.params, state.opt_state, state.env_state
        (params, traces, env_state), (transition, metrics) = jax.lax.scan(
            step_once, carry, jax.random.split(key, num_steps)
        )
        normalizer = state.normalizer
        if normalize_observations:
            is_sound = divergence.find_sound_steps(transition.diverged > 0, transition.ended)
            normalizer = normalization.update(normalizer, transition.obs, counts=is_sound)
        metrics = jax.tree.map(jnp.mean, metrics) | episode_metrics(transition)
        return TrainState(params, traces, normalizer, env_state, state.update + 1), metrics

    return Algorithm(init, step)


def trace_update(
    networks: Networks,
    gamma: float,
    lambda_actor: float,
    lambda_critic: float,
    actor_lr: float,
    critic_lr: float,
    reward_scale: float,
    discounted: bool,
) -> Callable[[PyTree, Traces, PyTree, Transition, jax.Array | bool], tuple[PyTree, Traces, Metrics]]:
    """`update(params, traces, normalizer, transition, counts) -> (params, traces, metrics)`.

    Args:
      networks, gamma, lambda_actor, lambda_critic, actor_lr, critic_lr, reward_scale, discounted: as in
        `online_actor_critic`.

    The transition is one step of each environment, `[N, ...]`. In environments whose step does not count (`counts`,
    `[N]` of bool), the traces decay and the step has no other effect.
    """

    def log_prob(actor, obs, u):
        mean, log_std = networks.policy(actor, obs)
        return networks.distribution.log_prob(u, mean, log_std), jnp.exp(log_std)

    def update(params, traces, normalizer, transition, counts: jax.Array | bool = True):
        counts = jnp.broadcast_to(counts, transition.reward.shape)
        transition = neutralize(transition, counts, normalizer)
        obs = normalization.normalize(normalizer, transition.obs)
        next_obs = normalization.normalize(normalizer, transition.next_obs)
        value, value_gradient = _map_over_envs(jax.value_and_grad(networks.value))(params["critic"], obs)
        score, sigma = _map_over_envs(jax.grad(log_prob, has_aux=True))(params["actor"], obs, transition.u)
        gradients = value_gradient, score
        value_gradient, score = select(counts, gradients, jax.tree.map(jnp.zeros_like, gradients))
        discount = gamma * (1 - transition.terminated)
        next_value = networks.value(params["critic"], next_obs)
        delta = jnp.where(counts, td_errors(reward_scale * transition.reward, discount, value, next_value), 0.0)
        z_critic = jax.tree.map(lambda z, g: gamma * lambda_critic * z + g, traces.critic, value_gradient)
        z_actor = jax.tree.map(
            lambda z, g: gamma * lambda_actor * z + expand_like(traces.factor, g) * g, traces.actor, score
        )
        params = {
            "actor": _ascend(params["actor"], actor_lr, delta, z_actor),
            "critic": _ascend(params["critic"], critic_lr, delta, z_critic),
        }
        continues = 1 - jnp.maximum(transition.terminated, transition.truncated)
        z_actor, z_critic = jax.tree.map(lambda z: expand_like(continues, z) * z, (z_actor, z_critic))
        factor = jnp.where(continues > 0, (gamma if discounted else 1.0) * traces.factor, 1.0)
        metrics = {"td_error": jnp.mean(jnp.abs(delta)), "value": jnp.mean(value), "sigma": jnp.mean(sigma)}
        return params, Traces(z_actor, z_critic, factor), metrics

    return update


def find_learnable_steps(transition: Transition, normalizer: PyTree, normalized: bool) -> jax.Array:
    """The steps to learn from, `[..., N]` of bool; `normalized` says whether observations are normalized."""
    is_sound = (transition.diverged == 0) & jnp.all(jnp.isfinite(transition.u), axis=-1)
    if not normalized:
        return is_sound
    reach = normalization.REACH
    is_near, is_next_near = (normalization.near(normalizer, x, reach) for x in (transition.obs, transition.next_obs))
    return is_sound & is_near & is_next_near


def _ascend(params: PyTree, step_size: float, delta: jax.Array, traces: PyTree) -> PyTree:
    """params + step_size delta z, averaged over the environments."""
    return jax.tree.map(lambda x, z: x + step_size * jnp.mean(expand_like(delta, z) * z, axis=0), params, traces)


def _map_over_envs(function):
    """Maps `function(params, *arrays)` over the rows of the arrays, with the same parameters."""

    def apply(params, *arrays):
        return jax.vmap(lambda *rows: function(params, *rows))(*arrays)

    return apply
