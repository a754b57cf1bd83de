"""What is learned from a rollout: the loss of actor and critic, and the gradient steps on it, one or several.

A rollout comes as a `Batch`, whose advantages and targets are constants; `jaxpg.actor_critic` makes it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxpg import collectives
from jaxpg.distributions import gaussian_kl
from jaxpg.losses import (
    clipped_surrogate_loss,
    clipped_value_loss,
    entropy_loss,
    policy_gradient_loss,
    value_loss,
)
from jaxpg.networks import Networks
from jaxpg.types import Metrics, PyTree


class Batch(NamedTuple):
    """A rollout as the losses see it, `[T, N, ...]`; constants, of the parameters that acted.

    Attributes:
      obs: normalized.
      u: what the policy's Gaussian drew.
      mean, log_std, log_prob: of the policy that acted.
      value: V(s_t) of the critic at that time.
      advantage, target, weight: as in `Estimate` and `Method`.
    """

    obs: jax.Array
    u: jax.Array
    mean: jax.Array
    log_std: jax.Array
    log_prob: jax.Array
    value: jax.Array
    advantage: jax.Array
    target: jax.Array
    weight: jax.Array


class Reuse(NamedTuple):
    """How often one rollout is learned from, and how far that may move the policy: PPO.

    Attributes:
      epochs: passes over the rollout, each in another order.
      minibatches: gradient steps of a pass, each on its share of the environments; a divisor of their number.
      clip: epsilon of `jaxpg.losses.clipped_surrogate_loss`; None does not clip.
      value_clip: c of `jaxpg.losses.clipped_value_loss`; None does not clip.
      max_kl: the rest of the rollout's gradient steps is left out once the policy that acted is further than this from
        the one that it has become, as the mean over a minibatch; None takes all of them.
    """

    epochs: int
    minibatches: int
    clip: float | None = 0.2
    value_clip: float | None = None
    max_kl: float | None = None

    @property
    def steps(self) -> int:
        """Gradient steps on one rollout, as far as `max_kl` lets them."""
        return self.epochs * self.minibatches


def actor_critic_loss(
    networks: Networks, entropy_coef: float, reuse: Reuse | None = None
) -> Callable[[PyTree, Batch], tuple[jax.Array, Metrics]]:
    """`loss(params, batch) -> (L, metrics)`: of actor and critic together.

        L(theta, w) = L_pi(theta) + 1/2 mean((V_w(s_t) - target_t)^2) - entropy_coef mean(H_t)

    Args:
      networks, entropy_coef: as in `actor_critic`.
      reuse: None for L_pi = -mean(log pi_theta(a_t | s_t) A_t); else the clipped surrogate.
    """

    def policy_loss(batch, mean, log_std):
        log_prob = networks.distribution.log_prob(batch.u, mean, log_std)
        if reuse is None:
            return policy_gradient_loss(log_prob, batch.advantage, batch.weight), {}
        moved = {"kl": jnp.mean(gaussian_kl(batch.mean, batch.log_std, mean, log_std))}
        loss = clipped_surrogate_loss(log_prob, batch.log_prob, batch.advantage, reuse.clip, batch.weight)
        return loss, jax.lax.stop_gradient(moved)

    def critic_loss(batch, value):
        if reuse is None or reuse.value_clip is None:
            return value_loss(value, batch.target, batch.weight)
        return clipped_value_loss(value, batch.value, batch.target, reuse.value_clip, batch.weight)

    def loss(params, batch):
        value = networks.value(params["critic"], batch.obs)
        mean, log_std = networks.policy(params["actor"], batch.obs)
        of_policy, moved = policy_loss(batch, mean, log_std)
        entropy = networks.distribution.entropy(batch.u, mean, log_std)
        losses = {
            "policy_loss": of_policy,
            "value_loss": critic_loss(batch, value),
            "entropy": -entropy_loss(entropy, batch.weight),
        }
        total = losses["policy_loss"] + losses["value_loss"] - entropy_coef * losses["entropy"]
        return total, losses | moved | {"sigma": jnp.mean(jnp.exp(log_std)), "value": jnp.mean(value)}

    return loss


# learn(params, opt_state, batch, key, update) -> (params, opt_state, metrics)
Learn = Callable[[PyTree, PyTree, Batch, jax.Array, jax.Array | int], tuple[PyTree, PyTree, Metrics]]


def one_step(loss: Callable, optimizer: optax.GradientTransformation, axis_name: str | None = None) -> Learn:
    """One gradient step on the whole batch.

    Args:
      loss: `loss(params, batch) -> (L, metrics)`.
      optimizer: of the parameters; one that takes further arguments, as `scale_by_progress` does, is told how far the
        training is.
      axis_name: a mapped axis, along which there are further parts of the batch.
    """
    optimizer = optax.with_extra_args_support(optimizer)

    def learn(params, opt_state, batch, key=None, update=0):
        gradients, metrics = collectives.mean(jax.grad(loss, has_aux=True)(params, batch), axis_name)
        updates, opt_state = optimizer.update(gradients, opt_state, params, progress=update)
        metrics = metrics | {"gradient_norm": optax.tree.norm(gradients)}
        return optax.apply_updates(params, updates), opt_state, metrics

    return learn


def several_steps(
    loss: Callable, optimizer: optax.GradientTransformation, reuse: Reuse, axis_name: str | None = None
) -> Learn:
    """`reuse.epochs` passes over the batch in `reuse.minibatches` parts; metrics are means over the steps taken."""
    once = one_step(loss, optimizer, axis_name)

    def take(carry, numbered_part):
        (params, opt_state, near), (number, part) = carry, numbered_part
        params, opt_state, metrics = once(params, opt_state, part, update=number)
        return (params, opt_state, near), metrics | {"gradient_steps": jnp.ones(())}

    def take_while_near(carry, numbered_part):
        def attempt():
            (params, opt_state, _), metrics = take(carry, numbered_part)
            near = metrics["kl"] <= reuse.max_kl  # of the parameters before the step
            taken = jax.tree.map(lambda new, old: jnp.where(near, new, old), (params, opt_state), carry[:2])
            return (*taken, near), jax.tree.map(lambda x: near * x, metrics)

        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(attempt)[1])
        return jax.lax.cond(carry[2], attempt, lambda: (carry, nothing))

    step = take if reuse.max_kl is None else take_while_near

    def learn(params, opt_state, batch, key, update=0):
        def epoch(carry, numbers_and_key):
            numbers, key = numbers_and_key
            return jax.lax.scan(step, carry, (numbers, shuffled_parts(batch, key, reuse.minibatches)))

        carry = params, opt_state, jnp.array(True)
        numbers = jnp.arange(reuse.steps, dtype=jnp.int32).reshape(reuse.epochs, reuse.minibatches)
        keys = jax.random.split(key, reuse.epochs)
        (params, opt_state, _), metrics = jax.lax.scan(epoch, carry, (update * reuse.steps + numbers, keys))
        steps = jnp.sum(metrics["gradient_steps"])
        metrics = {name: jnp.sum(x) / jnp.maximum(steps, 1) for name, x in metrics.items()}
        return params, opt_state, metrics | {"gradient_steps": steps}

    return learn


def scale_by_progress(schedule: optax.Schedule) -> optax.GradientTransformationExtraArgs:
    """Gradients times `schedule(progress)`, the last part of an optimizer whose step size changes.

    `optax.scale_by_schedule` counts the steps that it has taken. Here the step size belongs to a point of the training
    and not to its history: steps that were left out, as beyond `Reuse.max_kl`, are counted as if they had been taken.

    Args:
      schedule: of the gradient steps that the training had room for before this one: with u updates made and K steps in
        each, u K and those before it in its own.
    """

    def init(params):
        return optax.ScaleByScheduleState(count=jnp.zeros((), jnp.int32))

    def update(gradients, state, params=None, *, progress, **others):
        factor = schedule(progress)
        scaled = jax.tree.map(lambda g: jnp.asarray(factor, g.dtype) * g, gradients)
        return scaled, optax.ScaleByScheduleState(count=jnp.asarray(progress, jnp.int32) + 1)

    return optax.GradientTransformationExtraArgs(init, update)


def shuffled_parts(batch: PyTree, key: jax.Array, number: int) -> PyTree:
    """The environments of a batch `[T, N, ...]` in `number` parts `[number, T, N / number, ...]`, all steps of each.

    Neighbours stay neighbours: the parts begin at a random environment, which costs a copy and not a gather.
    """
    num_envs = batch.advantage.shape[1]
    shift = jax.random.randint(key, (), 0, num_envs)

    def parts(x):
        x = jnp.roll(x, shift, axis=1)
        return jnp.moveaxis(x.reshape(len(x), number, num_envs // number, *x.shape[2:]), 1, 0)

    return jax.tree.map(parts, batch)
