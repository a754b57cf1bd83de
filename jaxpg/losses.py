"""Scalar losses of arrays, to be minimised.

They take arrays, not parameters or networks. Advantages and targets are constants in the theory, so their gradient is
always stopped here. A shape mismatch raises, since `[N]` and `[N, 1]` would silently broadcast to `[N, N]`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxpg.shapes import broadcast_scalar, check_shape


def policy_gradient_loss(log_prob: jax.Array, advantage: jax.Array, weight: jax.Array | float = 1.0) -> jax.Array:
    """Surrogate whose gradient is minus the estimated policy gradient.

        L = -mean(w_t log pi(a_t | s_t) stop(A_t)),    grad L = -mean(w_t grad log pi(a_t | s_t) A_t)

    Args:
      log_prob: log pi(a_t | s_t), `[T, ...]`, differentiable.
      advantage: A_t, `[T, ...]`; no gradient passes through it.
      weight: w_t, 0 for steps that do not count, `[T, ...]` or a scalar. The mean is over all entries, so that it is
        not biased when the number of counted ones is random.

    Raises:
      ValueError: the shapes differ.

    Source: the lesson, sections 3 and 4.1.

    >>> policy_gradient_loss(jnp.array([-1.0, -2.0]), jnp.array([1.0, 3.0])).item()
    3.5
    """
    weight = broadcast_scalar(weight, log_prob, "weight")
    return -jnp.mean(weight * log_prob * jax.lax.stop_gradient(check_shape(advantage, log_prob, "advantage")))


def clipped_surrogate_loss(
    log_prob: jax.Array,
    old_log_prob: jax.Array,
    advantage: jax.Array,
    clip: float | None,
    weight: jax.Array | float = 1.0,
) -> jax.Array:
    """PPO's surrogate, for several gradient steps on the actions of one policy.

        L     = -mean(w_t min(rho_t A_t, clip(rho_t, 1 - epsilon, 1 + epsilon) A_t))
        rho_t = pi(a_t | s_t) / pi_old(a_t | s_t)

    At pi = pi_old its gradient equals that of `policy_gradient_loss`. A step has no gradient once its ratio has left
    the interval in the direction that the advantage favours.

    Args:
      log_prob: log pi(a_t | s_t), `[T, ...]`, differentiable.
      old_log_prob: log pi_old(a_t | s_t), of the policy that acted, `[T, ...]`; no gradient passes through it.
      advantage: A_t, `[T, ...]`; no gradient passes through it.
      clip: epsilon, positive; None does not clip.
      weight: as in `policy_gradient_loss`.

    Raises:
      ValueError: the shapes differ.

    Source: Schulman et al., arXiv 1707.06347, equation 7.

    >>> log_prob, advantage = jnp.log(jnp.array([1.5, 1.5])), jnp.array([1.0, -1.0])
    >>> round(clipped_surrogate_loss(log_prob, jnp.zeros(2), advantage, clip=0.2).item(), 3)  # mean of -1.2 and 1.5
    0.15
    """
    weight = broadcast_scalar(weight, log_prob, "weight")
    advantage = jax.lax.stop_gradient(check_shape(advantage, log_prob, "advantage"))
    ratio = jnp.exp(log_prob - jax.lax.stop_gradient(check_shape(old_log_prob, log_prob, "old_log_prob")))
    gain = ratio * advantage
    if clip is not None:
        gain = jnp.minimum(gain, jnp.clip(ratio, 1 - clip, 1 + clip) * advantage)
    return -jnp.mean(weight * gain)


def value_loss(value: jax.Array, target: jax.Array, weight: jax.Array | float = 1.0) -> jax.Array:
    """Half the mean squared error of the critic.

        L = 1/2 mean(w_t (V(s_t) - stop(target_t))^2),    grad L = -mean(w_t (target_t - V(s_t)) grad V(s_t))

    With the one-step target the gradient is the lesson's semi-gradient update delta_t grad V(s_t).

    Args:
      value: V(s_t), `[T, ...]`, differentiable.
      target: `[T, ...]`; no gradient passes through it.
      weight: as in `policy_gradient_loss`.

    Raises:
      ValueError: the shapes differ.

    Source: the lesson, section 4.1.

    >>> value_loss(jnp.array([1.0, 2.0]), jnp.array([0.0, 4.0])).item()
    1.25
    """
    weight = broadcast_scalar(weight, value, "weight")
    return 0.5 * jnp.mean(weight * (value - jax.lax.stop_gradient(check_shape(target, value, "target"))) ** 2)


def clipped_value_loss(
    value: jax.Array, old_value: jax.Array, target: jax.Array, clip: float, weight: jax.Array | float = 1.0
) -> jax.Array:
    """The larger of `value_loss` and the same loss with the value clipped to within `clip` of the old one.

        L = 1/2 mean(w_t max((V - G)^2, (V_old + clip(V - V_old, -c, c) - G)^2)),    G = stop(target_t)

    Args:
      value: V(s_t), `[T, ...]`, differentiable.
      old_value: V_old(s_t), before the first gradient step on this rollout, `[T, ...]`; no gradient passes through it.
      target: `[T, ...]`; no gradient passes through it.
      clip: c, positive, in units of the (scaled) return.
      weight: as in `policy_gradient_loss`.

    Raises:
      ValueError: the shapes differ.

    Source: practice (OpenAI's baselines); Andrychowicz et al., arXiv 2006.05990, found that it hurts.

    >>> clipped_value_loss(jnp.array([3.0]), jnp.array([0.0]), jnp.array([3.0]), clip=1.0).item()
    2.0
    """
    weight = broadcast_scalar(weight, value, "weight")
    target = jax.lax.stop_gradient(check_shape(target, value, "target"))
    old_value = jax.lax.stop_gradient(check_shape(old_value, value, "old_value"))
    clipped_value = old_value + jnp.clip(value - old_value, -clip, clip)
    return 0.5 * jnp.mean(weight * jnp.maximum((value - target) ** 2, (clipped_value - target) ** 2))


def entropy_loss(entropy: jax.Array, weight: jax.Array | float = 1.0) -> jax.Array:
    """Minus the mean entropy; added to the loss with a small factor, it keeps the policy exploring.

        L = -mean(w_t H_t)

    Args:
      entropy: H_t of the policy at s_t, `[T, ...]`, differentiable.
      weight: as in `policy_gradient_loss`.

    Raises:
      ValueError: the shapes differ.

    Source: Mnih et al., arXiv 1602.01783, section 4.

    >>> entropy_loss(jnp.array([1.0, 3.0])).item()
    -2.0
    """
    return -jnp.mean(broadcast_scalar(weight, entropy, "weight") * entropy)
