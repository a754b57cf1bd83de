"""The ladder of policy-gradient estimators, side by side.

All estimate the same gradient by the same sum, with different advantages:

    grad J(theta) ~ mean over trajectories of  sum_t  grad log pi_theta(a_t | s_t)  A_t

| function          | A_t                              | bias                | variance                    |
|-------------------|----------------------------------|---------------------|-----------------------------|
| `reinforce_whole` | R(tau) - b                       | the baseline's      | highest                     |
| `reinforce`       | G_t - b_t                        | the baseline's      | high; less with a good b_t  |
| `n_step`          | G^(n)_t - V(s_t)                 | gamma^n the critic's| grows with n                |
| `td_lambda` (GAE) | G_t^lambda - V(s_t)              | between             | grows with lambda           |
| `td_zero`         | r_t + gamma V(s_{t+1}) - V(s_t)  | the critic's        | lowest                      |

`jaxpg.baselines` has a table of the baselines b_t. REINFORCE needs complete episodes; the others bootstrap from the
critic where a trajectory is cut. The target of the critic is G_t for REINFORCE and A_t + V(s_t) for the others.

Bias is relative to the gradient without the factor gamma^t, as in the lesson's section 3. With the advantages
multiplied by `jaxpg.returns.discount_factors`, all estimate grad J itself. `reinforce_whole` does so as it is.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp

from jaxpg import collectives
from jaxpg.returns import discounted_returns, lambda_returns, n_step_returns, td_errors
from jaxpg.shapes import broadcast_scalar, check_shape, to_floating


class Estimate(NamedTuple):
    """The result of an estimator for a trajectory.

    Attributes:
      advantage: A_t, the factor of the score grad log pi(a_t | s_t), `[T, ...]`.
      target: regression target of the critic's V(s_t), `[T, ...]`.
    """

    advantage: jax.Array
    target: jax.Array


def reinforce(reward: jax.Array, discount: jax.Array | float, baseline: jax.Array | float = 0.0) -> Estimate:
    """REINFORCE: the return minus a baseline, from complete episodes.

        A_t = G_t - b_t,    G_t = r_t + d_t G_{t+1},    G_T = 0

    With b_t = V(s_t) this is Monte Carlo minus value.

    Args:
      reward: r_t, `[T, ...]`, 0 after the end of an episode.
      discount: d_t, `[T, ...]` or a scalar.
      baseline: b_t, `[T, ...]` or a scalar; may depend on s_t but not on a_t (`jaxpg.baselines`).

    Raises:
      ValueError: an array's shape does not fit the rewards'.

    Source: the lesson, sections 3 and 3.1; Williams, Machine Learning 8 (1992).

    >>> reinforce(jnp.array([1.0, 2.0]), 1.0, jnp.array([2.0, 2.0])).advantage.tolist()
    [1.0, 0.0]
    """
    returns = discounted_returns(reward, discount, 0.0)
    return Estimate(returns - broadcast_scalar(baseline, returns, "baseline"), returns)


def reinforce_whole(reward: jax.Array, discount: jax.Array | float, baseline: jax.Array | float = 0.0) -> Estimate:
    """REINFORCE with the return of the whole trajectory, as in the first form of the theorem.

        A_t = R(tau) - b,    R(tau) = sum_k d_0 ... d_{k-1} r_k = G_0

    This estimates the gradient of J exactly, factor gamma^t included. Each score is also multiplied by the rewards
    before it, which adds variance but does not change the mean. The critic's target is the return to go.

    Args:
      reward: r_t, `[T, ...]`, 0 after the end of an episode.
      discount: d_t, `[T, ...]` or a scalar.
      baseline: b, `[T, ...]` or a scalar.

    Raises:
      ValueError: an array's shape does not fit the rewards'.

    Source: the lesson, section 2.

    >>> reinforce_whole(jnp.array([1.0, 2.0]), 0.5).advantage.tolist()
    [2.0, 2.0]
    >>> reinforce_whole(jnp.array([1.0, 1.0, 1.0]), 0.5).advantage.tolist()
    [1.75, 1.75, 1.75]
    """
    returns = discounted_returns(reward, discount, 0.0)
    return Estimate(returns[0] - broadcast_scalar(baseline, returns, "baseline"), returns)


def td_zero(reward: jax.Array, discount: jax.Array | float, value: jax.Array, next_value: jax.Array) -> Estimate:
    """The one-step TD error as advantage, TD(0).

        A_t = delta_t = r_t + d_t V(s_{t+1}) - V(s_t)

    Args:
      reward: r_t, `[T, ...]`.
      discount: d_t, `[T, ...]` or a scalar; 0 where s_{t+1} is terminal.
      value: V(s_t), `[T, ...]`.
      next_value: V of the true s_{t+1}, `[T, ...]`.

    Raises:
      ValueError: an array's shape does not fit the rewards'.

    Source: the lesson, section 4.1.

    >>> td_zero(jnp.array([1.0]), 0.5, jnp.array([2.0]), jnp.array([4.0])).target.tolist()
    [3.0]
    """
    advantage = td_errors(reward, discount, value, next_value)
    return Estimate(advantage, advantage + value)


def n_step(
    reward: jax.Array,
    discount: jax.Array | float,
    value: jax.Array,
    next_value: jax.Array,
    n: int,
    continues: jax.Array | float = 1.0,
) -> Estimate:
    """n rewards, then the critic: from TD(0), n = 1, to Monte Carlo minus value, n >= T.

        A_t = G^(n)_t - V(s_t)

    Args:
      reward: r_t, `[T, ...]`.
      discount: d_t, `[T, ...]` or a scalar; 0 where s_{t+1} is terminal.
      value: V(s_t), `[T, ...]`.
      next_value: V of the true s_{t+1}, `[T, ...]`.
      n: number of rewards to sum, at least 1.
      continues: 0 at a cut, else 1, `[T, ...]` or a scalar.

    Raises:
      ValueError: n is below 1, or an array's shape does not fit the rewards'.

    Source: Sutton and Barto, Reinforcement Learning (2018), equation 7.1.

    >>> n_step(jnp.ones(3), 1.0, jnp.zeros(3), jnp.array([5.0, 6.0, 7.0]), n=2).advantage.tolist()
    [8.0, 9.0, 8.0]
    """
    returns = n_step_returns(reward, discount, next_value, n, continues)
    return Estimate(returns - check_shape(value, returns, "value"), returns)


def td_lambda(
    reward: jax.Array,
    discount: jax.Array | float,
    value: jax.Array,
    next_value: jax.Array,
    lambda_: jax.Array | float,
) -> Estimate:
    """TD(lambda), the generalized advantage estimate (GAE).

        A_t = G_t^lambda - V(s_t) = delta_t + d_t lambda_t A_{t+1}

    lambda = 0 is `td_zero`; lambda = 1 is Monte Carlo minus value, with a bootstrap at cuts. The second form
    holds only if V(s_{t+1}) = value[t+1] wherever lambda_t > 0, that is, if `next_value` is from the same critic.

    Args:
      reward: r_t, `[T, ...]`.
      discount: d_t, `[T, ...]` or a scalar; 0 where s_{t+1} is terminal.
      value: V(s_t), `[T, ...]`.
      next_value: V of the true s_{t+1}, `[T, ...]`.
      lambda_: lambda_t in [0, 1], 0 at a cut, `[T, ...]` or a scalar.

    Raises:
      ValueError: an array's shape does not fit the rewards'.

    Source: Schulman et al., arXiv 1506.02438, equation 16.

    >>> td_lambda(jnp.array([1.0, 1.0]), 1.0, jnp.array([0.0, 1.0]), jnp.array([1.0, 2.0]), 1.0).advantage.tolist()
    [4.0, 2.0]
    """
    returns = lambda_returns(reward, discount, next_value, lambda_)
    return Estimate(returns - check_shape(value, returns, "value"), returns)


class Estimator(Protocol):
    """`estimate(reward, discount, value, next_value, continues) -> Estimate`, of trajectories that may be cut.

    All arrays are `[T, N]`: r_t; d_t, which is gamma, or 0 if s_{t+1} is terminal; V(s_t); V of the true s_{t+1}; and
    c_t, which is 0 at a time limit, after which the next row belongs to another episode, and else 1.
    """

    def __call__(
        self, reward: jax.Array, discount: jax.Array, value: jax.Array, next_value: jax.Array, continues: jax.Array, /
    ) -> Estimate: ...


def gae(lambda_: jax.Array | float) -> Estimator:
    """`td_lambda` for trajectories that may be cut: lambda_t = lambda continues_t.

    lambda 0 is the one-step TD error; lambda 1 is Monte Carlo minus value, with a bootstrap at cuts.
    """

    def estimate(reward, discount, value, next_value, continues):
        return td_lambda(reward, discount, value, next_value, lambda_ * continues)

    return estimate


def n_rewards(n: int) -> Estimator:
    """`n_step` for trajectories that may be cut: n rewards, then the critic."""

    def estimate(reward, discount, value, next_value, continues):
        return n_step(reward, discount, value, next_value, n, continues)

    return estimate


def normalize_advantages(
    advantage: jax.Array, weight: jax.Array | float = 1.0, epsilon: float = 3e-5, axis_name: str | None = None
) -> jax.Array:
    """Advantages with mean 0 and standard deviation 1 over the whole batch.

        A'_t = (A_t - mean A) / sqrt(var A + (epsilon max |A|)^2),    with weighted mean and variance

    If only one step counts, the batch is returned unchanged: minus its mean it would be 0, whatever the return.

    Args:
      advantage: A_t, `[T, ...]`.
      weight: 1 if the step counts, else 0, `[T, ...]` or a scalar. Entries of weight 0 are shifted too, so the
        loss must mask them again.
      epsilon: keeps a batch of equal entries near 0, as their mean is subject to rounding.
      axis_name: mapped axis over which the batch is divided.

    Raises:
      ValueError: the weight's shape does not fit.

    Source: practice; not part of the theorem. It rescales the step, and its mean includes the sample itself, like every
    mean over the batch.

    >>> normalize_advantages(jnp.array([1.0, 3.0])).round(3).tolist()
    [-1.0, 1.0]
    """
    advantage = to_floating(advantage)
    weight = broadcast_scalar(weight, advantage, "weight")
    total = collectives.total(jnp.sum(weight), axis_name)
    total = jnp.where(total == 0, 1.0, total)  # no step counts
    centred = advantage - collectives.total(jnp.sum(weight * advantage), axis_name) / total
    largest = collectives.maximum(jnp.max(jnp.abs(weight * advantage)), axis_name)
    variance = collectives.total(jnp.sum(weight * centred**2), axis_name) / total + (epsilon * largest) ** 2
    normalized = centred / jnp.sqrt(jnp.maximum(variance, jnp.finfo(advantage.dtype).tiny))
    return jnp.where(total > 1, normalized, advantage)
