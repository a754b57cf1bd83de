"""Updates of the parameters from a rollout, by gradient steps on the loss of actor and critic."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import jax
import jax.numpy as jnp
import optax

from jaxpg import collectives
from jaxpg.batch import Batch
from jaxpg.losses import entropy_loss, policy_gradient_loss, value_loss
from jaxpg.networks import Networks
from jaxpg.types import Metrics, PyTree

# loss(params, batch) -> (L, metrics)
Loss = Callable[[PyTree, Batch], tuple[jax.Array, Metrics]]
# update(params, opt_state, batch, key, number) -> (params, opt_state, metrics), after `number` earlier updates
Update = Callable[[PyTree, PyTree, Batch, jax.Array, jax.Array | int], tuple[PyTree, PyTree, Metrics]]


class Step(Protocol):
    """An `Update` that draws nothing."""

    def __call__(
        self, params: PyTree, opt_state: PyTree, batch: Batch, key: jax.Array | None = None, number: jax.Array | int = 0
    ) -> tuple[PyTree, PyTree, Metrics]: ...


# policy_loss(batch, mean, log_std, log_prob) -> (L_pi, metrics)
PolicyLoss = Callable[[Batch, jax.Array, jax.Array, jax.Array], tuple[jax.Array, Metrics]]
# critic_loss(batch, value) -> L_V
CriticLoss = Callable[[Batch, jax.Array], jax.Array]


def actor_critic_loss(networks: Networks, entropy_coef: float) -> Loss:
    """The policy-gradient loss, the critic's squared error and the entropy bonus.

        L(theta, w) = -mean(log pi_theta(a_t | s_t) A_t) + 1/2 mean((V_w(s_t) - target_t)^2) - entropy_coef mean(H_t)

    Args:
      networks, entropy_coef: as in `jaxpg.actor_critic.actor_critic`.
    """

    def policy_loss(batch, mean, log_std, log_prob):
        return policy_gradient_loss(log_prob, batch.advantage, batch.weight), {}

    def critic_loss(batch, value):
        return value_loss(value, batch.target, batch.weight)

    return sum_of_losses(networks, entropy_coef, policy_loss, critic_loss)


def sum_of_losses(networks: Networks, entropy_coef: float, policy_loss: PolicyLoss, critic_loss: CriticLoss) -> Loss:
    """`loss(params, batch) -> (L, metrics)` with L = L_pi + L_V - entropy_coef mean(H_t)."""

    def loss(params, batch):
        value = networks.value(params["critic"], batch.obs)
        mean, log_std = networks.policy(params["actor"], batch.obs)
        log_prob = networks.distribution.log_prob(batch.u, mean, log_std)
        policy_term, metrics = policy_loss(batch, mean, log_std, log_prob)
        entropy = networks.distribution.entropy(batch.u, mean, log_std)
        losses = {
            "policy_loss": policy_term,
            "value_loss": critic_loss(batch, value),
            "entropy": -entropy_loss(entropy, batch.weight),
        }
        total = losses["policy_loss"] + losses["value_loss"] - entropy_coef * losses["entropy"]
        return total, losses | metrics | {"sigma": jnp.mean(jnp.exp(log_std)), "value": jnp.mean(value)}

    return loss


def gradient_step(loss: Loss, optimizer: optax.GradientTransformation, axis_name: str | None = None) -> Step:
    """One gradient step on the whole batch.

    Args:
      loss: `loss(params, batch) -> (L, metrics)`.
      optimizer: optimizer of the parameters. One with extra arguments, such as `scale_by_progress`, is given the number
        of earlier updates as `progress`.
      axis_name: mapped axis over which the batch is divided.
    """
    optimizer = optax.with_extra_args_support(optimizer)

    def update(params, opt_state, batch, key=None, number: jax.Array | int = 0):
        gradients, metrics = collectives.mean(jax.grad(loss, has_aux=True)(params, batch), axis_name)
        steps, opt_state = optimizer.update(gradients, opt_state, params, progress=number)
        metrics = metrics | {"gradient_norm": optax.tree.norm(gradients)}
        return optax.apply_updates(params, steps), opt_state, metrics

    return update


def scale_by_progress(schedule: optax.Schedule) -> optax.GradientTransformationExtraArgs:
    """Scales updates by `schedule(progress)`, as the last part of an optimizer whose step size changes.

    `optax.scale_by_schedule` counts the steps it has taken. Here the step size depends on the progress of the training
    instead: steps that were skipped, as beyond PPO's `max_kl`, count as taken.

    Args:
      schedule: function of the number of earlier gradient steps, taken or skipped: after u updates of K steps each, u K
        plus those before it in the current update.
    """

    def init(params):
        return optax.ScaleByScheduleState(count=jnp.zeros((), jnp.int32))

    def update(gradients, state, params=None, *, progress, **others):
        factor = schedule(progress)
        scaled = jax.tree.map(lambda g: jnp.asarray(factor, g.dtype) * g, gradients)
        return scaled, optax.ScaleByScheduleState(count=jnp.asarray(progress, jnp.int32) + 1)

    # optax's type of an update has no place for an argument that must be given.
    return optax.GradientTransformationExtraArgs(init, update)  # pyright: ignore[reportArgumentType]
