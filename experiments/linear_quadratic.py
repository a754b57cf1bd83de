"""The linear-quadratic problem played, and every estimator of the ladder on it next to the mean that theory gives it.

A trajectory is a polynomial in its standard normal noises z, `[n + T (m + n)]`: those of s_0, a_0, s_1, a_1, ..., s_T.
So `play` serves samples and quadrature alike. For each trajectory the estimate sum_t score_t A_t of the gradient in K,
k and log sigma is one sample. All is numpy in float64, but for the estimators themselves.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.linear_quadratic import Policy, Problem, Quadratic, backup, gradient, lambda_targets, values
from jaxpg import baselines, estimators
from jaxpg.returns import discount_factors, discounted_returns


def random_problem(seed: int, n: int, m: int, horizon: int = 6, discount: float = 0.9) -> Problem:
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


def random_policy(seed: int, problem: Problem) -> Policy:
    random = np.random.default_rng(seed + 1)
    n, m = problem.B.shape
    return Policy(0.3 * random.normal(size=(m, n)), random.normal(size=m), 0.4)


class Setting(NamedTuple):
    """A problem, the policy that plays, its values V_0 ... V_T, and those of quite another policy."""

    problem: Problem
    policy: Policy
    critic: list[Quadratic]
    wrong_critic: list[Quadratic]


@functools.cache
def setting(n: int, horizon: int = 5) -> Setting:
    """With n state and min(n, 2) action variables."""
    problem = random_problem(seed=n, n=n, m=min(n, 2), horizon=horizon, discount=0.8)
    policy = random_policy(n, problem)
    return Setting(problem, policy, values(problem, policy), values(problem, random_policy(77, problem)))


class Played(NamedTuple):
    """`[T, N, ...]`; `value` is that of the exact critic, `wrong_value` that of the wrong one.

    `beyond` is `next_value` as if the last step were not the last one.
    """

    state: np.ndarray
    noise: np.ndarray
    reward: np.ndarray
    discount: np.ndarray
    score: np.ndarray
    value: np.ndarray
    next_value: np.ndarray
    beyond: np.ndarray
    wrong_value: np.ndarray
    wrong_next_value: np.ndarray


def num_noises(setting: Setting) -> int:
    n, m = setting.problem.B.shape
    return n + setting.problem.horizon * (m + n)


def play(setting: Setting, z: np.ndarray) -> Played:
    """The trajectories of the standard normal noises `z`, `[N, num_noises]`."""
    problem, (K, k, sigma), exact, wrong = setting
    n, m = problem.B.shape
    z0, *later = np.split(z, np.cumsum([n, *[m, n] * problem.horizon])[:-1], axis=1)
    s = problem.initial_mean + z0 @ np.linalg.cholesky(problem.initial_covariance).T
    root, steps = np.linalg.cholesky(problem.W).T, []
    for t in range(problem.horizon):
        epsilon, last = later[2 * t], t == problem.horizon - 1
        a = s @ K.T + k + sigma * epsilon
        following = s @ problem.A.T + a @ problem.B.T + later[2 * t + 1] @ root
        cost = np.sum(following @ problem.Q * following, axis=1) + np.sum(a @ problem.R * a, axis=1)
        in_mean = epsilon / sigma
        in_K = (in_mean[:, :, None] * s[:, None, :]).reshape(len(z), -1)
        in_log_sigma = np.sum(epsilon**2 - 1, axis=1, keepdims=True)
        steps.append(
            Played(
                state=s,
                noise=epsilon,
                reward=-cost,
                discount=np.full(len(z), 0.0 if last else problem.discount),
                score=np.concatenate([in_K, in_mean, in_log_sigma], axis=1),
                value=exact[t](s),
                next_value=exact[t + 1](following),
                beyond=exact[0 if last else t + 1](following),
                wrong_value=wrong[t](s),
                wrong_next_value=wrong[t + 1](following),
            )
        )
        s = following
    return Played(*(np.stack(field) for field in zip(*steps, strict=True)))


def flat(policy_like: Policy) -> np.ndarray:
    return np.concatenate([policy_like.K.ravel(), policy_like.k, [policy_like.sigma]])


def closed_form(setting: Setting, following: list[Quadratic] | None = None, discounted: bool = True) -> np.ndarray:
    """The gradient of J, or what `envs.linear_quadratic.gradient` gives instead, as one vector."""
    return flat(gradient(setting.problem, setting.policy, following, discounted))


def n_step_targets(setting: Setting, critic: list[Quadratic], n: int) -> list[Quadratic]:
    """E[G^(n-1)_{t+1} | s_{t+1}] for t = 0 ... T - 1: the critic at t + n or at the end, backed up to t + 1."""
    horizon, found = setting.problem.horizon, []
    for t in range(horizon):
        end = min(t + n, horizon)
        target = critic[end]
        for _ in range(end - t - 1):
            target = backup(setting.problem, setting.policy, target)
        found.append(target)
    return found


def to_go(p: Played) -> jax.Array:
    return discounted_returns(p.reward, p.discount, 0.0)


def squared_score(p: Played) -> jax.Array:
    return jnp.sum(p.score**2, axis=-1)


def with_baseline(baseline_of: Callable[[Played], jax.Array | float]) -> Callable[[Played], jax.Array]:
    return lambda p: estimators.reinforce(p.reward, p.discount, baseline_of(p)).advantage


# All estimate sum_t E[score_t Q_t], and with the factors gamma^t the gradient of J.
UNBIASED = {
    "returns": with_baseline(lambda p: 0.0),
    "returns, batch mean": with_baseline(lambda p: baselines.batch_mean(to_go(p))),
    "returns, time mean": with_baseline(lambda p: baselines.time_mean(to_go(p))),
    "returns, leave one out": with_baseline(lambda p: baselines.leave_one_out(to_go(p))),
    "returns, optimal": with_baseline(lambda p: baselines.optimal(to_go(p), squared_score(p))),
    "returns, value": with_baseline(lambda p: p.value),
    "returns, wrong value": with_baseline(lambda p: p.wrong_value),
    "n_step 3": lambda p: estimators.n_step(p.reward, p.discount, p.value, p.next_value, 3).advantage,
    "td_lambda 0.7": lambda p: estimators.td_lambda(p.reward, p.discount, p.value, p.next_value, 0.7).advantage,
    "td_zero": lambda p: estimators.td_zero(p.reward, p.discount, p.value, p.next_value).advantage,
    "td_lambda 1, wrong critic": lambda p: (
        estimators.td_lambda(p.reward, p.discount, p.wrong_value, p.wrong_next_value, 1.0).advantage
    ),
}


class Biased(NamedTuple):
    """`targets` has in the place of V_{t+1} what the advantage makes of the wrong critic on average."""

    advantage: Callable[[Played], jax.Array]
    targets: Callable[[Setting], list[Quadratic]]


def td_lambda_with_wrong_critic(lambda_: float) -> Biased:
    return Biased(
        lambda p: estimators.td_lambda(p.reward, p.discount, p.wrong_value, p.wrong_next_value, lambda_).advantage,
        lambda s: lambda_targets(s.problem, s.policy, s.wrong_critic, lambda_),
    )


BIASED = {
    "n_step 3, wrong critic": Biased(
        lambda p: estimators.n_step(p.reward, p.discount, p.wrong_value, p.wrong_next_value, 3).advantage,
        lambda s: n_step_targets(s, s.wrong_critic, 3),
    ),
    "td_lambda 0.9, wrong critic": td_lambda_with_wrong_critic(0.9),
    "td_lambda 0.5, wrong critic": td_lambda_with_wrong_critic(0.5),
    "td_zero, wrong critic": Biased(
        lambda p: estimators.td_zero(p.reward, p.discount, p.wrong_value, p.wrong_next_value).advantage,
        lambda s: s.wrong_critic[1:],
    ),
}


class Rung(NamedTuple):
    """An estimator as the sum of score_t A_t, factor gamma^t included where there is one, and its mean in theory."""

    advantage: Callable[[Played], jax.Array]
    expected: np.ndarray


def discounted(advantage: Callable[[Played], jax.Array]) -> Callable[[Played], jax.Array]:
    return lambda p: discount_factors(p.discount) * advantage(p)


def ladder(setting: Setting) -> dict[str, Rung]:
    """With the factors gamma^t, and the unbiased ones without them too: those estimate another sum than grad J."""
    exact, without = closed_form(setting), closed_form(setting, discounted=False)
    whole = Rung(lambda p: estimators.reinforce_whole(p.reward, p.discount).advantage, exact)
    return (
        {"whole return": whole}
        | {name: Rung(discounted(advantage), exact) for name, advantage in UNBIASED.items()}
        | {
            name: Rung(discounted(advantage), closed_form(setting, targets(setting)))
            for name, (advantage, targets) in BIASED.items()
        }
        | {f"{name}, no gamma^t": Rung(advantage, without) for name, advantage in UNBIASED.items()}
    )


def advantages(played: Played, advantage: Callable[[Played], jax.Array]) -> np.ndarray:
    """A_t in float64, `[T, N]`."""
    with jax.enable_x64(True), jax.disable_jit():  # a scan that runs once is not worth its compilation
        return np.asarray(advantage(jax.tree.map(jnp.asarray, played)))


def gradients(played: Played, advantage: Callable[[Played], jax.Array]) -> np.ndarray:
    """sum_t score_t A_t of each trajectory, `[N, parameters]`."""
    return np.einsum("tnp,tn->np", played.score, advantages(played, advantage))


class Measured(NamedTuple):
    """Of the samples of one estimator: how many there are, `[parameters]`, and `[parameters, parameters]`."""

    number: int
    mean: np.ndarray
    covariance: np.ndarray

    def errors(self, expected: np.ndarray) -> np.ndarray:
        """How many standard errors the mean is away, in each component."""
        return (self.mean - expected) / np.sqrt(np.diag(self.covariance) / self.number)


def measure(samples: np.ndarray) -> Measured:
    return Measured(len(samples), samples.mean(0), np.cov(samples.T))


def study(
    setting: Setting, rungs: dict[str, Rung], num_batches: int = 20, batch: int = 50_000, seed: int = 0
) -> dict[str, Measured]:
    """All the rungs on the same trajectories, 10^6 by default; sums in float64. Baselines average over one batch."""
    random = np.random.default_rng(seed)

    @jax.jit
    def sums(played):
        found = {}
        for name, rung in rungs.items():
            samples = jnp.einsum("tnp,tn->np", played.score, rung.advantage(played)) - rung.expected
            found[name] = jnp.sum(samples, axis=0), samples.T @ samples
        return found

    total = dict.fromkeys(rungs, (0.0, 0.0))
    with jax.enable_x64(True):
        for _ in range(num_batches):
            played = play(setting, random.normal(size=(batch, num_noises(setting))))
            found = sums(jax.tree.map(jnp.asarray, played))
            total = {name: tuple(map(np.add, total[name], found[name])) for name in rungs}
    number, measured = num_batches * batch, {}
    for name, (first, second) in total.items():
        off = first / number
        measured[name] = Measured(number, rungs[name].expected + off, second / number - np.outer(off, off))
    return measured
