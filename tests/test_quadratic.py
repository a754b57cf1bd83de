"""The linear-quadratic problem's closed forms are those of its definition."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_quadratic import random_policy, random_problem

from envs.linear_quadratic import (
    Policy,
    Problem,
    action_value,
    best_policy,
    gradient,
    lambda_targets,
    objective,
    optimum,
    riccati_gains,
    state_moments,
    values,
)
from envs.quadratic import QuadraticConfig, chain, make
from jaxpg.config.parsing import compose
from jaxpg.networks import linear_mean
from jaxpg.program.algorithms import make_algorithm
from jaxpg.program.environment import make_env
from jaxpg.program.schedule import plan
from jaxpg.rollout import rollout
from jaxpg.training import train_scan
from jaxpg.vector_env import vectorize

problems = st.builds(
    random_problem,
    st.integers(0, 1000),
    st.integers(1, 3),
    st.integers(1, 2),
    st.integers(1, 8),
    st.sampled_from([0.0, 0.9, 1.0]),
)


@given(problems, st.integers(0, 1000))
@settings(max_examples=50, deadline=None)
def test_objective_is_the_sum_of_the_expected_rewards(problem, seed):
    """E[x' Q x] = tr(Q E[x x']) at every step, forwards in time; the objective comes from the backward recursion."""
    policy = random_policy(seed, problem)
    K, k, sigma = policy
    moments = [*state_moments(problem, policy)]
    total = 0.0
    for t, (mean, second) in enumerate(moments):
        action = K @ second @ K.T + np.outer(K @ mean, k) + np.outer(k, K @ mean) + np.outer(k, k)
        action = action + sigma**2 * np.eye(len(k))
        both = np.block([[second, second @ K.T + np.outer(mean, k)], [K @ second + np.outer(k, mean), action]])
        step = np.concatenate([problem.A, problem.B], axis=1)
        following = step @ both @ step.T + problem.W
        total -= problem.discount**t * (np.trace(problem.Q @ following) + np.trace(problem.R @ action))
    np.testing.assert_allclose(objective(problem, policy), total, rtol=1e-9)


@given(problems, st.integers(0, 1000))
@settings(max_examples=50, deadline=None)
def test_gradient_is_the_objectives_slope(problem, seed):
    """Central differences; J is quadratic in k and sigma, and a polynomial in K."""
    policy = random_policy(seed, problem)
    exact = gradient(problem, policy)
    epsilon = 1e-5

    def slope(change):
        plus, minus = (objective(problem, change(sign * epsilon)) for sign in (1, -1))
        return (plus - minus) / (2 * epsilon)

    def at(array, place, by):
        changed = array.copy()
        changed[place] += by
        return changed

    size = max(np.abs(x).max() for x in exact)
    for place in np.ndindex(policy.K.shape):
        found = slope(lambda by, place=place: policy._replace(K=at(policy.K, place, by)))
        np.testing.assert_allclose(exact.K[place], found, rtol=1e-5, atol=1e-6 * size)
    for place in np.ndindex(policy.k.shape):
        found = slope(lambda by, place=place: policy._replace(k=at(policy.k, place, by)))
        np.testing.assert_allclose(exact.k[place], found, rtol=1e-5, atol=1e-6 * size)
    found = slope(lambda by: policy._replace(sigma=policy.sigma * np.exp(by)))
    np.testing.assert_allclose(exact.sigma, found, rtol=1e-5, atol=1e-6 * size)


@given(problems, st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_bellmans_equations(problem, seed):
    """V_t(s) = E_a Q_t(s, a), and Q_t(s, a) = E[r + gamma V_{t+1}(s')], the noise integrated by sigma points."""
    policy = random_policy(seed, problem)
    n, m = problem.B.shape
    random = np.random.default_rng(seed)
    s, a = random.normal(size=n), random.normal(size=m)
    value = values(problem, policy)
    of_action = [action_value(problem, following) for following in value[1:]]
    root = np.linalg.cholesky(problem.W + 1e-300 * np.eye(n))
    for t in range(problem.horizon):
        # 2 n points at +- sqrt(n) columns of the root have the noise's mean and covariance: exact for quadratics.
        expected = 0.0
        for noise in np.concatenate([root.T, -root.T]) * np.sqrt(n):
            following = problem.A @ s + problem.B @ a + noise
            reward = -(following @ problem.Q @ following + a @ problem.R @ a)
            expected += (reward + problem.discount * value[t + 1](following)) / (2 * n)
        np.testing.assert_allclose(of_action[t](np.concatenate([s, a])), expected, rtol=1e-9)
        mean = policy.K @ s + policy.k
        points = [mean + sign * np.sqrt(m) * policy.sigma * column for column in np.eye(m) for sign in (1, -1)]
        averaged = np.mean([of_action[t](np.concatenate([s, point])) for point in points])
        np.testing.assert_allclose(value[t](s), averaged, rtol=1e-9)


def test_riccati_gains_are_the_best():
    """Backwards in time, each gain is where the slope of Q_t with respect to the action vanishes, at every state."""
    problem = random_problem(5, 3, 2)
    n = len(problem.A)
    gains = riccati_gains(problem)
    P = np.zeros((n, n))
    for K in gains[::-1]:
        M = problem.Q + problem.discount * P
        both = np.concatenate([problem.A, problem.B], axis=1)
        hessian = both.T @ M @ both
        hessian[n:, n:] += problem.R
        np.testing.assert_allclose(hessian[n:, :n] + hessian[n:, n:] @ K, 0, atol=1e-12)
        closed = np.concatenate([np.eye(n), K])
        P = closed.T @ hessian @ closed
    optimum = -(problem.initial_mean @ P @ problem.initial_mean + np.trace(P @ problem.initial_covariance))
    noise = Policy(gains[0], np.zeros(2), 0.0)
    assert objective(Problem(**{**vars(problem), "W": np.zeros((n, n))}), noise) <= optimum


def test_the_lessons_example():
    """Without control the state stays at 0.5 and each step costs 0.25, besides the exploration's cost."""
    idle = Policy(np.zeros((1, 1)), np.zeros(1), 0.0)
    np.testing.assert_allclose(objective(chain(QuadraticConfig(), discount=1.0), idle), -50 * 0.25)
    gains = [K.item() for K in riccati_gains(chain(QuadraticConfig()))]
    assert -10 < min(gains) < max(gains) < 0
    assert gains[-1] == pytest.approx(-0.1 / (0.1**2 + 0.01))


def test_gradient_without_discount_factors_is_not_the_gradient():
    problem = random_problem(1, 2, 1)
    policy = random_policy(1, problem)
    true, without = gradient(problem, policy), gradient(problem, policy, discounted=False)
    assert np.abs(true.K - without.K).max() > 0.01
    jax.tree.map(
        np.testing.assert_array_equal,
        *(gradient(Problem(**{**vars(problem), "discount": 1.0}), policy, discounted=flag) for flag in (True, False)),
    )


def test_lambda_goes_from_the_critic_to_the_truth():
    problem = random_problem(2, 2, 1)
    policy = random_policy(2, problem)
    critic = values(problem, random_policy(9, problem))
    for lambda_, expected in ((0.0, critic), (1.0, values(problem, policy))):
        for mine, true in zip(lambda_targets(problem, policy, critic, lambda_), expected[1:], strict=True):
            jax.tree.map(np.testing.assert_allclose, tuple(mine), tuple(true))


@pytest.mark.parametrize("options", [{}, {"state_size": 3, "noise": 0.2, "start_spread": 0.5}], ids=["toy", "noise"])
def test_environment_plays_the_problem(options):
    """Mean return of 20,000 episodes under a linear-Gaussian policy: J within four standard errors, at discount 1."""
    config = QuadraticConfig(**options)
    problem, env = chain(config, discount=1.0), make(config)
    policy = Policy(-2.0 * np.eye(config.state_size), 0.1 * np.ones(config.state_size), 0.5)

    def act(obs, key):
        action = obs @ policy.K.T + policy.k + policy.sigma * jax.random.normal(key, obs.shape)
        return action, action

    batch = vectorize(env, 20_000, config.episode_length)
    start = batch.reset(jax.random.key(0))
    _, played = jax.jit(lambda: rollout(act, batch.step, start, jax.random.key(1), config.episode_length))()
    returns = np.asarray(played.reward, np.float64).sum(0)
    assert (played.truncated[-1] == 1).all()
    assert abs(returns.mean() - objective(problem, policy)) < 4 * returns.std() / np.sqrt(len(returns))


def test_best_policy():
    """Its gradient is 0, and the lesson's problem is solved as well by no other gain on a grid."""
    problem = chain(QuadraticConfig())
    best = best_policy(problem, 0.5)
    slope = gradient(problem, best)
    assert max(np.abs(slope.K).max(), np.abs(slope.k).max()) < 1e-5
    others = [objective(problem, Policy(np.array([[K]]), np.zeros(1), 0.5)) for K in np.linspace(-12, 2, 400)]
    assert 0 < objective(problem, best) - max(others) < 1e-4


def test_default_training_finds_the_best_gain():
    """REINFORCE on the lesson's problem: within 2 % of the cost of the best linear policy."""
    config = compose(["env=quadratic", "algo=reinforce"])
    algorithm = make_algorithm(config, make_env(config))
    state, _ = jax.jit(lambda key: train_scan(algorithm, key, plan(config).num_updates))(jax.random.key(0))
    K, k = (np.asarray(x, np.float64) for x in linear_mean(state.params["actor"]))
    policy = Policy(K, k, 0.5)
    problem = chain(config.env)
    assert objective(problem, policy) / objective(problem, best_policy(problem, 0.5)) < 1.02


@given(problems)
@settings(max_examples=30, deadline=None)
def test_the_optimum_is_what_its_gains_earn_step_by_step(problem):
    """The moments of the states forwards in time, and the expected cost of each step; no constant policy earns more."""
    mean, covariance, earned = problem.initial_mean, problem.initial_covariance, 0.0
    for t, K in enumerate(riccati_gains(problem)):
        second = covariance + np.outer(mean, mean)
        closed = problem.A + problem.B @ K
        following = closed @ second @ closed.T + problem.W
        earned -= problem.discount**t * (np.trace(problem.Q @ following) + np.trace(problem.R @ K @ second @ K.T))
        mean, covariance = closed @ mean, closed @ covariance @ closed.T + problem.W
    best = optimum(problem)
    np.testing.assert_allclose(best, earned, rtol=1e-9, atol=1e-12)
    for seed in range(3):
        assert objective(problem, random_policy(seed, problem)) <= best + 1e-9 * abs(best)


def test_an_environment_knows_what_can_be_earned_at_best():
    """s' = s + 0.1 a for one step from s = 0.5: -((0.5 + 0.1 a)^2 + 0.01 a^2) is the largest at a = -2.5."""
    assert make(QuadraticConfig(episode_length=1)).references["best possible"] == pytest.approx(-(0.25**2 + 0.0625))
