"""Proximal policy optimization: several gradient steps on the clipped surrogate per rollout.

Source: Schulman et al., Proximal policy optimization algorithms, arXiv 1707.06347.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import optax

from jaxpg.actor_critic import on_policy
from jaxpg.distributions import gaussian_kl
from jaxpg.losses import clipped_surrogate_loss, clipped_value_loss, value_loss
from jaxpg.methods import Method
from jaxpg.networks import Networks
from jaxpg.types import Algorithm, PyTree
from jaxpg.updates import Loss, Update, gradient_step, sum_of_losses
from jaxpg.vector_env import VectorEnv


def ppo(
    env: VectorEnv,
    networks: Networks,
    optimizer: optax.GradientTransformation,
    method: Method,
    *,
    epochs: int = 10,
    minibatches: int = 1,
    clip: float | None = 0.2,
    value_clip: float | None = None,
    max_kl: float | None = None,
    entropy_coef: float = 0.0,
    axis_name: str | None = None,
    **options: Any,
) -> Algorithm:
    """PPO: `actor_critic` with several steps on the clipped surrogate instead of one.

    Args:
      env, networks, optimizer, method, axis_name: as in `jaxpg.actor_critic.on_policy`.
      epochs, minibatches, max_kl: as in `minibatch_steps`.
      clip, value_clip, entropy_coef: as in `ppo_loss`.
      options: other options of `on_policy`.

    Returns:
      As `on_policy`, with the additional metrics `kl` and `gradient_steps`.
    """
    loss = ppo_loss(networks, entropy_coef, clip, value_clip)
    update = minibatch_steps(loss, optimizer, epochs, minibatches, max_kl, axis_name)
    return on_policy(env, networks, optimizer, method, update, axis_name=axis_name, **options)


def ppo_loss(
    networks: Networks, entropy_coef: float = 0.0, clip: float | None = 0.2, value_clip: float | None = None
) -> Loss:
    """The clipped surrogate, the critic's squared error and the entropy bonus; the metrics include `kl`.

        L(theta, w) = L_clip(theta) + L_V(w) - entropy_coef mean(H_t)

    Args:
      networks: policy and value.
      entropy_coef: weight of the policy's entropy.
      clip: epsilon of `jaxpg.losses.clipped_surrogate_loss`; None does not clip.
      value_clip: c of `jaxpg.losses.clipped_value_loss`; None does not clip.
    """

    def policy_loss(batch, mean, log_std, log_prob):
        kl = jnp.mean(gaussian_kl(batch.mean, batch.log_std, mean, log_std))
        loss = clipped_surrogate_loss(log_prob, batch.log_prob, batch.advantage, clip, batch.weight)
        return loss, {"kl": jax.lax.stop_gradient(kl)}

    def critic_loss(batch, value):
        if value_clip is None:
            return value_loss(value, batch.target, batch.weight)
        return clipped_value_loss(value, batch.value, batch.target, value_clip, batch.weight)

    return sum_of_losses(networks, entropy_coef, policy_loss, critic_loss)


def minibatch_steps(
    loss: Loss,
    optimizer: optax.GradientTransformation,
    epochs: int,
    minibatches: int,
    max_kl: float | None = None,
    axis_name: str | None = None,
) -> Update:
    """`epochs` passes over the batch, with one gradient step per minibatch; metrics are means over the steps taken.

    Args:
      loss, optimizer, axis_name: as in `jaxpg.updates.gradient_step`.
      epochs: passes over the rollout, each in a different order.
      minibatches: gradient steps per pass, each on an equal share of the environments; must divide their number.
      max_kl: the remaining gradient steps are skipped once the policy is further than this from the one that acted, by
        the mean of KL(acted || current) over a minibatch; None takes all steps.
    """
    step = gradient_step(loss, optimizer, axis_name)
    num_steps = epochs * minibatches

    def take_step(carry, numbered_minibatch):
        (params, opt_state, is_near), (number, minibatch) = carry, numbered_minibatch
        params, opt_state, metrics = step(params, opt_state, minibatch, number=number)
        return (params, opt_state, is_near), metrics | {"gradient_steps": jnp.ones(())}

    def take_step_if_near(limit, carry, numbered_minibatch):
        def attempt():
            (params, opt_state, _), metrics = take_step(carry, numbered_minibatch)
            is_near = metrics["kl"] <= limit  # the KL divergence before the step
            selected = jax.tree.map(lambda new, old: jnp.where(is_near, new, old), (params, opt_state), carry[:2])
            return (*selected, is_near), jax.tree.map(lambda x: is_near * x, metrics)

        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(attempt)[1])
        return jax.lax.cond(carry[2], attempt, lambda: (carry, zeros))

    scan_step = take_step if max_kl is None else functools.partial(take_step_if_near, max_kl)

    def update(params, opt_state, batch, key, number: jax.Array | int = 0):
        def epoch(carry, numbers_and_key):
            numbers, key = numbers_and_key
            return jax.lax.scan(scan_step, carry, (numbers, split_environments(batch, key, minibatches)))

        carry = params, opt_state, jnp.array(True)
        numbers = jnp.arange(num_steps, dtype=jnp.int32).reshape(epochs, minibatches)
        keys = jax.random.split(key, epochs)
        (params, opt_state, _), metrics = jax.lax.scan(epoch, carry, (number * num_steps + numbers, keys))
        num_taken = jnp.sum(metrics["gradient_steps"])
        metrics = {name: jnp.sum(x) / jnp.maximum(num_taken, 1) for name, x in metrics.items()}
        return params, opt_state, metrics | {"gradient_steps": num_taken}

    return update


def split_environments(batch: PyTree, key: jax.Array, number: int) -> PyTree:
    """Splits the environments of a batch `[T, N, ...]` into `number` minibatches `[number, T, N / number, ...]`.

    Minibatches are blocks of neighbouring environments, starting at a random one, which costs a copy and not a gather.
    """
    num_envs = batch.advantage.shape[1]
    shift = jax.random.randint(key, (), 0, num_envs)

    def split(x):
        x = jnp.roll(x, shift, axis=1)
        return jnp.moveaxis(x.reshape(len(x), number, num_envs // number, *x.shape[2:]), 1, 0)

    return jax.tree.map(split, batch)
