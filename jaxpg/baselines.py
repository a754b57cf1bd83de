"""Baselines: subtracted from the return, they reduce the variance of the gradient without changing its mean.

    grad J = E[sum_t grad log pi(a_t | s_t) (G_t - b_t)]      for every b_t independent of a_t

| function        | b_t of trajectory i              | bias of the gradient   | when to use                     |
|-----------------|----------------------------------|------------------------|---------------------------------|
| `batch_mean`    | mean of all returns              | of the order of 1/N    | the simplest; large batches     |
| `time_mean`     | mean of the returns at step t    | a share of exactly 1/N | returns fall with the time left |
| `optimal`       | the same, by squared score       | of the order of 1/N    | scores of very different size   |
| `leave_one_out` | mean of the other trajectories   | none                   | small batches                   |
| V(s_t)          | a learned value                  | none                   | returns depend on the state     |

N is the number of trajectories; the first three include the trajectory's own return. All take returns `[T, N]`, time
first, and return an array of that shape. A learned value comes from a network instead, and is unbiased as long as it
was not fitted to the same trajectories.

`jaxpg.methods.reinforce` takes any `Baseline`. `critic` and `zero` are baselines themselves; `of_returns` and
`of_scores` make one from a function above.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxpg.shapes import broadcast_scalar, check_shape

# baseline(returns, weight, value, squared_score) -> b_t
Baseline = Callable[[jax.Array, jax.Array, jax.Array, jax.Array], jax.Array | float]


def batch_mean(returns: jax.Array, weight: jax.Array | float = 1.0) -> jax.Array:
    """The mean return of the batch.

        b = sum_{t,i} w_{t,i} G_{t,i} / sum_{t,i} w_{t,i}

    The mean includes the sample itself, which gives a bias of the order of 1/N for N trajectories; in episodes of one
    step it is the factor 1 - 1/N.

    Args:
      returns: G_t, `[T, ...]`.
      weight: 1 if the step belongs to the episode and 0 after its end, `[T, ...]` or a scalar. A mean over no steps
        is 0.

    Raises:
      ValueError: the weight's shape does not fit.

    Source: the lesson, section 3.1 (the same baseline for every state).

    >>> batch_mean(jnp.array([3.0, 2.0])).tolist()
    [2.5, 2.5]
    """
    weight = broadcast_scalar(weight, returns, "weight")
    return jnp.broadcast_to(_ratio(jnp.sum(weight * returns), jnp.sum(weight)), returns.shape)


def time_mean(returns: jax.Array, weight: jax.Array | float = 1.0) -> jax.Array:
    """The mean return of the trajectories at each step.

        b_t = sum_i w_{t,i} G_{t,i} / sum_i w_{t,i}

    It includes the sample itself, which shrinks the expected gradient by exactly 1 - 1/N while all N trajectories last.

    Args:
      returns: G_t, `[T, ...]`.
      weight: as in `batch_mean`; b_t is 0 at a step with no weight.

    Raises:
      ValueError: the weight's shape does not fit.

    >>> time_mean(jnp.array([[1.0, 3.0], [0.0, 1.0]])).tolist()
    [[2.0, 2.0], [0.5, 0.5]]
    """
    return optimal(returns, jnp.ones_like(returns), weight)


def leave_one_out(returns: jax.Array, weight: jax.Array | float = 1.0) -> jax.Array:
    """The mean return of the other trajectories.

        b_i = sum_{t, j != i} w_{t,j} G_{t,j} / sum_{t, j != i} w_{t,j}

    It is independent of trajectory i, so it is exactly unbiased for every N.

    Args:
      returns: G_t, `[T, N]` with N of at least 2.
      weight: as in `batch_mean`.

    Raises:
      ValueError: there is only one trajectory, or a shape does not fit.

    Source: Kool et al., Buy 4 REINFORCE samples, get a baseline for free! (2019).

    >>> leave_one_out(jnp.array([[1.0, 3.0, 5.0]])).tolist()
    [[4.0, 3.0, 2.0]]
    """
    if returns.ndim != 2 or returns.shape[1] < 2:
        raise ValueError(f"returns have shape {returns.shape}, expected [T, N] with at least 2 trajectories")
    weight = broadcast_scalar(weight, returns, "weight")
    total, count = jnp.sum(weight * returns, axis=0), jnp.sum(weight, axis=0)
    return jnp.broadcast_to(_ratio(jnp.sum(total) - total, jnp.sum(count) - count), returns.shape)


def optimal(returns: jax.Array, squared_score: jax.Array, weight: jax.Array | float = 1.0) -> jax.Array:
    """The baseline of least variance among those that depend on the step alone.

        b_t = sum_i w_{t,i} |score_{t,i}|^2 G_{t,i} / sum_i w_{t,i} |score_{t,i}|^2

    It minimises E|score_t (G_t - b_t)|^2 over the b_t that depend on t alone. The mean includes the sample itself,
    which gives a relative bias of the order of 1/N.

    Args:
      returns: G_t, `[T, ...]`.
      squared_score: |grad log pi(a_t | s_t)|^2, `[T, ...]`; for all parameters, or for those whose variance to reduce.
      weight: as in `batch_mean`; b_t is 0 at a step with no weight.

    Raises:
      ValueError: a shape does not fit.

    Source: Greensmith, Bartlett and Baxter, Journal of Machine Learning Research 5 (2004), section 4.

    >>> optimal(jnp.array([[1.0, 3.0]]), jnp.array([[3.0, 1.0]])).tolist()
    [[1.5, 1.5]]
    """
    weight = broadcast_scalar(weight, returns, "weight") * check_shape(squared_score, returns, "squared_score")
    axes = tuple(range(1, returns.ndim))
    total = jnp.sum(weight, axis=axes, keepdims=True)
    return jnp.broadcast_to(_ratio(jnp.sum(weight * returns, axis=axes, keepdims=True), total), returns.shape)


def critic(returns: jax.Array, weight: jax.Array, value: jax.Array, squared_score: jax.Array) -> jax.Array:
    """The critic's V(s_t)."""
    return value


def zero(returns: jax.Array, weight: jax.Array, value: jax.Array, squared_score: jax.Array) -> float:
    """b_t = 0: no baseline."""
    return 0.0


def of_returns(function: Callable[[jax.Array, jax.Array], jax.Array]) -> Baseline:
    """The baseline `function(returns, weight)`, such as `leave_one_out`."""
    return lambda returns, weight, value, squared_score: function(returns, weight)


def of_scores(function: Callable[[jax.Array, jax.Array, jax.Array], jax.Array]) -> Baseline:
    """The baseline `function(returns, squared_score, weight)`, such as `optimal`."""
    return lambda returns, weight, value, squared_score: function(returns, squared_score, weight)


def _ratio(total: jax.Array, count: jax.Array) -> jax.Array:
    """total / count, or 0 if both are 0."""
    return total / jnp.where(count == 0, 1, count)
