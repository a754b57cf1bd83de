"""Trajectories of random linear-quadratic problems, the ladder of estimators on them, and what theory says of each.

Shared by the tests and by `estimator_table.py`. Trajectories are played by numpy in float64. Of each one the estimate
sum_t score_t A_t of the gradient in K, k and log sigma is a sample; the samples' mean is held against closed forms.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.quadratic import Policy, Problem, gradient, lambda_targets, values
from jaxpg import baselines, estimators
from jaxpg.returns import discount_factors, discounted_returns


def random_problem(seed, n, m, horizon=6, discount=0.9):
    random = np.random.default_rng(seed)

    def covariance(size):
        root = random.normal(size=(size, size))
        return root @ root.T / size

    return Problem(
        A=random.normal(size=(n, n)) / np.sqrt(n),
        B=random.normal(size=(n, m)),
        Q=covariance(n),
        R=covariance(m) + 0.1 * np.eye(m),
        W=0.1 * covariance(n),
        initial_mean=random.normal(size=n),
        initial_covariance=covariance(n),
        horizon=horizon,
        discount=discount,
    )


def random_policy(seed, problem):
    random = np.random.default_rng(seed + 1)
    n, m = problem.B.shape
    return Policy(0.3 * random.normal(size=(m, n)), random.normal(size=m), 0.4)


class Played(NamedTuple):
    """`[T, N, ...]`; the critics' values are exact (`value`) and those of another policy (`wrong_value`).

    `beyond` is `next_value` as if the last step were not the last one.
    """

    reward: np.ndarray
    discount: np.ndarray
    score: np.ndarray
    value: np.ndarray
    next_value: np.ndarray
    beyond: np.ndarray
    wrong_value: np.ndarray
    wrong_next_value: np.ndarray
    noise: np.ndarray
    state: np.ndarray


@functools.cache
def problem(n):
    return random_problem(seed=n, n=n, m=min(n, 2), horizon=5, discount=0.8)


@functools.cache
def policy(n):
    return random_policy(n, problem(n))


@functools.cache
def wrong_critic(n):
    """The values of quite another policy."""
    return values(problem(n), random_policy(77, problem(n)))


def simulate(n, num_trajectories, seed):
    case, (K, k, sigma), random = problem(n), policy(n), np.random.default_rng(seed)
    exact, wrong = values(case, policy(n)), wrong_critic(n)

    def noise(covariance):
        return random.normal(size=(num_trajectories, len(covariance))) @ np.linalg.cholesky(covariance).T

    s = case.initial_mean + noise(case.initial_covariance)
    steps = []
    for t in range(case.horizon):
        epsilon = random.normal(size=(num_trajectories, len(k)))
        a = s @ K.T + k + sigma * epsilon
        following = s @ case.A.T + a @ case.B.T + noise(case.W)
        cost = np.einsum("ni,ij,nj->n", following, case.Q, following) + np.einsum("ni,ij,nj->n", a, case.R, a)
        in_mean = epsilon / sigma
        in_K = (in_mean[:, :, None] * s[:, None, :]).reshape(num_trajectories, -1)
        in_log_sigma = np.sum(epsilon**2 - 1, axis=1, keepdims=True)
        score = np.concatenate([in_K, in_mean, in_log_sigma], axis=1)
        last = t == case.horizon - 1
        steps.append(
            Played(
                reward=-cost,
                discount=np.full(num_trajectories, 0.0 if last else case.discount),
                score=score,
                value=exact[t](s),
                next_value=exact[t + 1](following),
                beyond=exact[0 if last else t + 1](following),
                wrong_value=wrong[t](s),
                wrong_next_value=wrong[t + 1](following),
                noise=epsilon[:, 0],
                state=s,
            )
        )
        s = following
    return Played(*(np.stack(field) for field in zip(*steps, strict=True)))


@functools.cache
def play(n, num_trajectories=40_000, seed=0):
    """`simulate`, once for all who ask for the same."""
    return simulate(n, num_trajectories, seed)


def flat(policy_like):
    return np.concatenate([policy_like.K.ravel(), policy_like.k, [policy_like.sigma]])


def closed_form(n, **options):
    return flat(gradient(problem(n), policy(n), **options))


class Moments(NamedTuple):
    """Of an estimator's samples: their number, and mean and variance of each component."""

    count: int
    mean: np.ndarray
    variance: np.ndarray

    def errors(self, expected: np.ndarray) -> np.ndarray:
        """How many standard errors the mean is away, in each component."""
        return (self.mean - expected) / np.sqrt(self.variance / self.count)


def errors(samples, expected):
    """How many standard errors the samples' mean is away, in each component."""
    return Moments(len(samples), samples.mean(0), samples.var(0)).errors(expected)


def samples(played, advantage_of):
    """sum_t score_t A_t of each trajectory, `[N, parameters]`."""
    with jax.enable_x64(True):
        advantage = np.asarray(advantage_of(jax.tree.map(jnp.asarray, played)))
    return np.einsum("tnp,tn->np", played.score, advantage)


def squared(score):
    return jnp.sum(score**2, axis=-1)


def to_go(played):
    return discounted_returns(played.reward, played.discount, 0.0)


def with_baseline(baseline_of):
    return lambda p: estimators.reinforce(p.reward, p.discount, baseline_of(p)).advantage


def with_wrong_critic(lambda_):
    return lambda p: estimators.td_lambda(p.reward, p.discount, p.wrong_value, p.wrong_next_value, lambda_).advantage


UNBIASED = {
    "returns": with_baseline(lambda p: 0.0),
    "returns, batch mean": with_baseline(lambda p: baselines.batch_mean(to_go(p))),
    "returns, time mean": with_baseline(lambda p: baselines.time_mean(to_go(p))),
    "returns, leave one out": with_baseline(lambda p: baselines.leave_one_out(to_go(p))),
    "returns, optimal": with_baseline(lambda p: baselines.optimal(to_go(p), squared(p.score))),
    "returns, value": with_baseline(lambda p: p.value),
    "returns, wrong value": with_baseline(lambda p: p.wrong_value),
    "td_zero": lambda p: estimators.td_zero(p.reward, p.discount, p.value, p.next_value).advantage,
    "n_step": lambda p: estimators.n_step(p.reward, p.discount, p.value, p.next_value, 3).advantage,
    "td_lambda": lambda p: estimators.td_lambda(p.reward, p.discount, p.value, p.next_value, 0.7).advantage,
    "td_lambda 1, wrong critic": with_wrong_critic(1.0),
}


def wrong_critic_mean(n, lambda_):
    """The mean of the gradient by TD(lambda) with the wrong critic."""
    following = lambda_targets(problem(n), policy(n), wrong_critic(n), lambda_)
    return closed_form(n, following=following, discounted=False)


class Rung(NamedTuple):
    """One estimator of the ladder.

    Attributes:
      advantage: what it makes of the trajectories.
      discounted: whether it is meant for the gradient of J, or for the sum without the factors gamma^t.
      biased_mean: the mean of its gradient on the problem with n variables; None where it is what it is meant for.
    """

    advantage: Callable[[Played], jax.Array]
    discounted: bool = False
    biased_mean: Callable[[int], np.ndarray] | None = None

    def target(self, n: int) -> np.ndarray:
        """The gradient that it is meant for."""
        return closed_form(n, discounted=self.discounted)

    def mean(self, n: int) -> np.ndarray:
        """The mean that theory gives it."""
        return self.biased_mean(n) if self.biased_mean else self.target(n)


def _with_factors(advantage):
    return Rung(lambda p: discount_factors(p.discount) * advantage(p), discounted=True)


def _wrong_critic_rung(lambda_):
    return Rung(with_wrong_critic(lambda_), biased_mean=lambda n: wrong_critic_mean(n, lambda_))


LADDER = {
    **{name: Rung(advantage) for name, advantage in UNBIASED.items()},
    "whole return": Rung(lambda p: estimators.reinforce_whole(p.reward, p.discount).advantage, discounted=True),
    "returns, gamma^t": _with_factors(UNBIASED["returns"]),
    "returns, value, gamma^t": _with_factors(UNBIASED["returns, value"]),
    "td_zero, wrong critic": _wrong_critic_rung(0.0),
    "td_lambda 0.5, wrong critic": _wrong_critic_rung(0.5),
    "td_lambda 0.9, wrong critic": _wrong_critic_rung(0.9),
}


def measure(n: int, num_batches: int, batch_size: int = 50_000) -> dict[str, Moments]:
    """Moments of every estimator of the ladder over `num_batches` batches of trajectories, the same for all.

    Baselines that average over the batch see one batch at a time.
    """
    sums = {name: [0.0, 0.0] for name in LADDER}
    for seed in range(num_batches):
        played = simulate(n, batch_size, seed)
        for name, rung in LADDER.items():
            found = samples(played, rung.advantage)
            sums[name][0] += found.sum(0)
            sums[name][1] += (found**2).sum(0)
    count = num_batches * batch_size
    return {
        name: Moments(count, total / count, squares / count - (total / count) ** 2)
        for name, (total, squares) in sums.items()
    }
