"""Scalar losses of arrays, to be minimised.

They take arrays, not parameters and not networks. The gradient is stopped where the theory takes a factor for a
constant: advantages and targets are stopped here, unconditionally. A shape mismatch raises, since `[N]` against
`[N, 1]` would be spread in silence to `[N, N]`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxpg.shapes import same, spread


def policy_gradient_loss(log_prob: jax.Array, advantage: jax.Array, weight: jax.Array | float = 1.0) -> jax.Array:
    """Surrogate whose gradient is minus the estimated policy gradient.

        L = -mean(w_t log pi(a_t | s_t) stop(A_t)),    grad L = -mean(w_t grad log pi(a_t | s_t) A_t)

    Args:
      log_prob: log pi(a_t | s_t), `[T, ...]`, differentiable.
      advantage: A_t, `[T, ...]`; no gradient passes through it.
      weight: w_t, 0 for steps that do not count, `[T, ...]` or a scalar. The mean is over all entries, counted or
        not, so that a random number of counted ones does not bias it.

    Raises:
      ValueError: the shapes differ.

    Source: the lesson, sections 3 and 4.1.

    >>> policy_gradient_loss(jnp.array([-1.0, -2.0]), jnp.array([1.0, 3.0])).item()
    3.5
    """
    weight = spread(weight, log_prob, "weight")
    return -jnp.mean(weight * log_prob * jax.lax.stop_gradient(same(advantage, log_prob, "advantage")))


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
    weight = spread(weight, value, "weight")
    return 0.5 * jnp.mean(weight * (value - jax.lax.stop_gradient(same(target, value, "target"))) ** 2)


def entropy_loss(entropy: jax.Array, weight: jax.Array | float = 1.0) -> jax.Array:
    """Minus the mean entropy: added with a small factor, it keeps the policy exploring.

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
    return -jnp.mean(spread(weight, entropy, "weight") * entropy)
