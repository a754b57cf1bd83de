"""Returns of a trajectory: four uses of one reverse recursion.

Every array has time first and any batch shape after it. The discount d_t is gamma (1 - terminated_t): gamma inside an
episode, 0 if step t ended in a terminal state. If an episode was cut for another reason (time limit, end of the
rollout), set lambda_t to 0: the sum stops there and bootstraps from the value of the true next observation.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxpg.shapes import broadcast_scalar, to_floating


def discounted_returns(reward: jax.Array, discount: jax.Array | float, bootstrap: jax.Array | float) -> jax.Array:
    """Discounted sum of future rewards (reward-to-go).

        G_t = r_t + d_t G_{t+1},    G_T = bootstrap

    Args:
      reward: r_t, `[T, ...]`.
      discount: d_t, `[T, ...]` or a scalar; 0 if step t ended the episode.
      bootstrap: value after the last step, `[...]` or a scalar; 0 for a complete episode.

    Returns:
      G_t, `[T, ...]`.

    Raises:
      ValueError: an array's shape does not fit the rewards'.

    Source: the lesson, section 3.

    >>> discounted_returns(jnp.array([1.0, 1.0, 1.0]), 0.5, 8.0).tolist()
    [2.75, 3.5, 5.0]
    """
    reward = to_floating(reward)
    discount = broadcast_scalar(discount, reward, "discount")
    bootstrap = broadcast_scalar(bootstrap, reward[0], "bootstrap")
    return _backward(reward, discount, bootstrap)


def discount_factors(discount: jax.Array) -> jax.Array:
    """The factor gamma^t of the policy-gradient theorem.

        d_0 d_1 ... d_{t-1},    1 at t = 0

    Multiplying the advantages of `jaxpg.estimators` by it gives an estimate of grad J. The lesson's section 3, like
    nearly every program, leaves it out: late steps of an episode then count as much as early ones.

    Args:
      discount: d_t, `[T, ...]`, for trajectories that begin at t = 0.

    Returns:
      `[T, ...]`.

    Source: Sutton and Barto, Reinforcement Learning (2018), section 13.3; Nota and Thomas, arXiv 1906.07073.

    >>> discount_factors(jnp.array([0.5, 0.5, 0.5])).tolist()
    [1.0, 0.5, 0.25]
    """
    discount = to_floating(discount)
    return jnp.cumprod(jnp.concatenate([jnp.ones_like(discount[:1]), discount[:-1]]), axis=0)


def td_errors(reward: jax.Array, discount: jax.Array | float, value: jax.Array, next_value: jax.Array) -> jax.Array:
    """One-step temporal-difference errors.

        delta_t = r_t + d_t V(s_{t+1}) - V(s_t)

    Args:
      reward: r_t, `[T, ...]`.
      discount: d_t, `[T, ...]` or a scalar; 0 where s_{t+1} is terminal.
      value: V(s_t), `[T, ...]`.
      next_value: V of the true s_{t+1}, the observation before any reset, `[T, ...]`.

    Returns:
      delta_t, `[T, ...]`.

    Raises:
      ValueError: an array's shape does not fit the rewards'.

    Source: the lesson, section 4.1.

    >>> td_errors(jnp.array([1.0]), 0.5, jnp.array([2.0]), jnp.array([4.0])).tolist()
    [1.0]
    """
    reward = to_floating(reward)
    discount = broadcast_scalar(discount, reward, "discount")
    return (
        reward
        + discount * broadcast_scalar(next_value, reward, "next_value")
        - broadcast_scalar(value, reward, "value")
    )


def n_step_returns(
    reward: jax.Array,
    discount: jax.Array | float,
    next_value: jax.Array,
    n: int,
    continues: jax.Array | float = 1.0,
) -> jax.Array:
    """Returns over at most n rewards, then the value.

        G^(1)_t = r_t + d_t V(s_{t+1})
        G^(k)_t = r_t + d_t ((1 - c_t) V(s_{t+1}) + c_t G^(k-1)_{t+1})

    At a cut (c_t = 0) and at the end of the trajectory the sum stops early and bootstraps from V(s_{t+1}).

    Args:
      reward: r_t, `[T, ...]`.
      discount: d_t, `[T, ...]` or a scalar; 0 where s_{t+1} is terminal.
      next_value: V of the true s_{t+1}, `[T, ...]`.
      n: number of rewards to sum, at least 1; n >= T sums the whole trajectory.
      continues: c_t, 1 if step t + 1 continues the same episode and 0 at a cut, `[T, ...]` or a scalar.

    Returns:
      G^(n)_t, `[T, ...]`.

    Raises:
      ValueError: n is below 1, or an array's shape does not fit the rewards'.

    Source: Sutton and Barto, Reinforcement Learning (2018), equation 7.1.

    >>> n_step_returns(jnp.array([1.0, 1.0, 1.0]), 0.5, jnp.array([8.0, 8.0, 8.0]), n=2).tolist()
    [3.5, 3.5, 5.0]
    """
    if n < 1:
        raise ValueError(f"n must be at least 1, got {n}")
    reward = to_floating(reward)
    discount = broadcast_scalar(discount, reward, "discount")
    next_value = broadcast_scalar(next_value, reward, "next_value")
    continues = broadcast_scalar(continues, reward, "continues")
    returns = reward + discount * next_value
    for _ in range(min(n, len(reward)) - 1):
        following = jnp.concatenate([returns[1:], next_value[-1:]])
        returns = reward + discount * ((1 - continues) * next_value + continues * following)
    return returns


def lambda_returns(
    reward: jax.Array,
    discount: jax.Array | float,
    next_value: jax.Array,
    lambda_: jax.Array | float,
) -> jax.Array:
    """TD(lambda) returns: the exponentially weighted mean of all n-step returns.

        G_t = r_t + d_t ((1 - lambda_t) V(s_{t+1}) + lambda_t G_{t+1}),    G_T = V(s_T)

    lambda = 0 gives the one-step target, lambda = 1 the Monte Carlo return. At a cut set lambda_t = 0: the sum stops
    there and bootstraps. At a termination d_t = 0 already stops it, with value 0.

    Args:
      reward: r_t, `[T, ...]`.
      discount: d_t, `[T, ...]` or a scalar; 0 where s_{t+1} is terminal.
      next_value: V of the true s_{t+1}, the observation before any reset, `[T, ...]`.
      lambda_: lambda_t in [0, 1], `[T, ...]` or a scalar.

    Returns:
      G_t, `[T, ...]`.

    Raises:
      ValueError: an array's shape does not fit the rewards'.

    Source: Sutton and Barto, Reinforcement Learning (2018), equation 12.18; Schulman et al., arXiv 1506.02438
    (the generalized advantage estimate is G_t - V(s_t)).

    >>> lambda_returns(jnp.array([1.0, 1.0]), 0.5, jnp.array([4.0, 8.0]), 0.5).tolist()
    [3.25, 5.0]
    """
    reward = to_floating(reward)
    discount = broadcast_scalar(discount, reward, "discount")
    next_value = broadcast_scalar(next_value, reward, "next_value")
    lambda_ = broadcast_scalar(lambda_, reward, "lambda_")
    return _backward(reward + discount * (1 - lambda_) * next_value, discount * lambda_, next_value[-1])


def _backward(term: jax.Array, factor: jax.Array, last: jax.Array) -> jax.Array:
    """x_t = term_t + factor_t x_{t+1} with x_T = last."""

    def step(following, inputs):
        term_t, factor_t = inputs
        current = term_t + factor_t * following
        return current, current

    return jax.lax.scan(step, last, (term, factor), reverse=True)[1]
