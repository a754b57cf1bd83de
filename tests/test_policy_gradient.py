"""The estimators' mean is what theory gives, on the linear-quadratic problem, where theory gives a number.

Trajectories are played by numpy in float64. For each the estimate sum_t score_t A_t of the gradient in K, k and log
sigma is one sample; their mean has to be within four standard errors of the closed form in every component (with some
8 components, a right estimator is further away in one of 2,000 draws; the seeds are fixed). Wrong variants are further
away: each test has its own.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_quadratic import random_policy, random_problem

from envs.quadratic import gradient, lambda_targets, values
from jaxpg import baselines, estimators
from jaxpg.returns import discount_factors, discounted_returns

NUM_TRAJECTORIES = 40_000
ERRORS = 4.0  # that a right estimator may be away
SEEN = 6.0  # that a wrong one is away at least


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


@functools.cache
def play(n, num_trajectories=NUM_TRAJECTORIES, seed=0):
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
            )
        )
        s = following
    return Played(*(np.stack(field) for field in zip(*steps, strict=True)))


def flat(policy_like):
    return np.concatenate([policy_like.K.ravel(), policy_like.k, [policy_like.sigma]])


def closed_form(n, **options):
    return flat(gradient(problem(n), policy(n), **options))


def errors(samples, expected):
    """How many standard errors the samples' mean is away, in each component."""
    return (samples.mean(0) - expected) / (samples.std(0) / np.sqrt(len(samples)))


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
    "td_lambda 1, wrong critic": lambda p: (
        estimators.td_lambda(p.reward, p.discount, p.wrong_value, p.wrong_next_value, 1.0).advantage
    ),
}


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("name", UNBIASED)
def test_unbiased_without_the_discount_factors(name, n):
    """Problems 1, 2 and 4 of the lesson; a baseline that holds the sample is off by 1/N, a hundredth of the error."""
    found = samples(play(n), UNBIASED[name])
    assert np.abs(errors(found, closed_form(n, discounted=False))).max() < ERRORS


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("name", UNBIASED)
def test_unbiased_with_the_discount_factors(name, n):
    """gamma^t A_t estimates the gradient of J."""
    found = samples(play(n), lambda p: discount_factors(p.discount) * UNBIASED[name](p))
    assert np.abs(errors(found, closed_form(n))).max() < ERRORS


@pytest.mark.parametrize("n", [1, 3])
def test_whole_return_estimates_the_gradient_of_the_objective(n):
    found = samples(play(n), lambda p: estimators.reinforce_whole(p.reward, p.discount).advantage)
    assert np.abs(errors(found, closed_form(n))).max() < ERRORS


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("lambda_", [0.0, 0.5, 0.9])
def test_bias_of_a_wrong_critic_is_the_formulas(n, lambda_):
    """TD(lambda) with a critic that is wrong: biased, and by how much is known."""
    found = samples(
        play(n),
        lambda p: estimators.td_lambda(p.reward, p.discount, p.wrong_value, p.wrong_next_value, lambda_).advantage,
    )
    targets = lambda_targets(problem(n), policy(n), wrong_critic(n), lambda_)
    assert np.abs(errors(found, closed_form(n, following=targets, discounted=False))).max() < ERRORS
    if lambda_ <= 0.5:  # of 0.9 the bias is there too, but within 4 standard errors
        assert np.abs(errors(found, closed_form(n, discounted=False))).max() > SEEN


WRONG = {
    "return off by one step": lambda p: jnp.concatenate([to_go(p)[1:], jnp.zeros_like(p.reward[:1])]),
    "discount forgotten": lambda p: discounted_returns(p.reward, 1.0, 0.0),
    "baseline that knows the action": with_baseline(lambda p: 3.0 * p.noise),
    "bootstrap through the end": lambda p: (
        estimators.td_zero(p.reward, problem(3).discount, p.value, p.beyond).advantage
    ),
    "value of this state for the next one": lambda p: (
        estimators.td_zero(p.reward, p.discount, p.value, p.value).advantage
    ),
    "sign of the value": lambda p: estimators.td_zero(p.reward, p.discount, -p.value, -p.next_value).advantage,
    "discount factors": lambda p: discount_factors(p.discount) * to_go(p),
    "whole return": lambda p: estimators.reinforce_whole(p.reward, p.discount).advantage,
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_variants_are_seen(name):
    found = samples(play(3), WRONG[name])
    assert np.abs(errors(found, closed_form(3, discounted=False))).max() > SEEN


@pytest.mark.parametrize("num_trajectories", [2, 5])
def test_small_batches(num_trajectories):
    """In batches of N the time mean takes a share of exactly 1/N away, leaving one out takes none."""
    played = play(1)
    batches = jax.tree.map(
        lambda x: x.reshape(len(x), -1, num_trajectories, *x.shape[2:]).swapaxes(0, 1), played
    )  # [batch, T, N, ...]

    def mean_gradient(baseline):
        def of_batch(p):
            advantage = estimators.reinforce(p.reward, p.discount, baseline(to_go(p))).advantage
            return jnp.einsum("tnp,tn->p", p.score, advantage) / num_trajectories

        with jax.enable_x64(True):
            return np.asarray(jax.vmap(of_batch)(jax.tree.map(jnp.asarray, batches)))

    exact, share = closed_form(1, discounted=False), 1 - 1 / num_trajectories
    assert np.abs(errors(mean_gradient(baselines.leave_one_out), exact)).max() < ERRORS
    assert np.abs(errors(mean_gradient(baselines.time_mean), share * exact)).max() < ERRORS
    assert np.abs(errors(mean_gradient(baselines.time_mean), exact)).max() > SEEN


def test_order_of_the_variances():
    """Of the whole gradient: the sum over its components."""
    played = play(3)

    def variance(name):
        return samples(played, UNBIASED[name]).var(0).sum()

    whole = samples(played, lambda p: estimators.reinforce_whole(p.reward, p.discount).advantage).var(0).sum()
    assert variance("returns") > variance("returns, time mean") > variance("returns, value")
    assert variance("returns, value") > variance("td_lambda") > variance("td_zero")
    undiscounted = samples(played, lambda p: discount_factors(p.discount) * to_go(p)).var(0).sum()
    assert whole > undiscounted
