"""Gaussian policies: closed forms, scores by hand, and densities that integrate to one and fit their samples."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxpg.distributions import (
    gaussian_entropy,
    gaussian_kl,
    gaussian_log_prob,
    gaussian_sample,
    squash,
    squash_log_det,
    squashed_gaussian_log_prob,
)

LIMITS = [1.0, 2.0]
MEAN, SIGMA = 0.4, 0.8  # of the policies with one action whose densities are integrated
LOG_STD = float(np.log(SIGMA))


def policy(shape=(5, 3), seed=0):
    """u, mean and log sigma, all of this shape."""
    rng = np.random.default_rng(seed)
    mean, log_std = rng.normal(size=shape), rng.uniform(-1.0, 0.7, shape)
    u = mean + np.exp(log_std) * rng.normal(size=shape)
    return tuple(x.astype(np.float32) for x in (u, mean, log_std))


def assert_close(actual, expected, tolerance=1e-5):
    """float32, relative to the largest entry."""
    expected = np.asarray(expected)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance * max(1.0, np.abs(expected).max()))


@pytest.mark.parametrize("shape", [(1,), (3,), (5, 3), (4, 2, 3)])
def test_log_prob_is_scipys_summed_over_the_actions(shape):
    u, mean, log_std = policy(shape)
    expected = scipy.stats.norm.logpdf(np.float64(u), np.float64(mean), np.exp(np.float64(log_std))).sum(axis=-1)
    assert_close(gaussian_log_prob(u, mean, log_std), expected)


def test_log_std_of_one_policy_serves_a_batch():
    u, mean, _ = policy((5, 3))
    log_std = np.float32([-0.5, 0.0, 0.5])
    expected = scipy.stats.norm.logpdf(np.float64(u), np.float64(mean), np.exp(np.float64(log_std))).sum(axis=-1)
    assert_close(gaussian_log_prob(u, mean, log_std), expected)


def test_score_in_the_mean():
    """(u - mean) / sigma^2."""
    u, mean, log_std = policy()
    score = jax.grad(lambda mean: gaussian_log_prob(u, mean, log_std).sum())(mean)
    assert_close(score, (np.float64(u) - mean) / np.exp(2 * np.float64(log_std)))


def test_score_in_the_log_deviation():
    """(u - mean)^2 / sigma^2 - 1."""
    u, mean, log_std = policy()
    score = jax.grad(lambda log_std: gaussian_log_prob(u, mean, log_std).sum())(log_std)
    assert_close(score, (np.float64(u) - mean) ** 2 / np.exp(2 * np.float64(log_std)) - 1)


@pytest.mark.parametrize("limit", [None, *LIMITS])
def test_score_is_the_slope_of_central_differences(limit):
    """Problem 3, plain and squashed: (f(x + h) - f(x - h)) / 2h is the score by hand to h^2 = 1e-10, in float64."""
    h = 1e-5
    with jax.enable_x64(True):
        u, mean, log_std = (jnp.asarray(x, jnp.float64) for x in policy())

        def log_prob(mean, log_std):
            if limit is None:
                return np.asarray(gaussian_log_prob(u, mean, log_std))
            return np.asarray(squashed_gaussian_log_prob(u, mean, log_std, limit))

        for i in range(3):  # one action's parameters at a time
            step = h * jnp.eye(3)[i]
            in_mean = (log_prob(mean + step, log_std) - log_prob(mean - step, log_std)) / (2 * h)
            in_log_std = (log_prob(mean, log_std + step) - log_prob(mean, log_std - step)) / (2 * h)
            standardized = np.asarray((u - mean) / jnp.exp(log_std))[:, i]
            assert_close(in_mean, standardized / np.exp(log_std[:, i]), tolerance=1e-8)
            assert_close(in_log_std, standardized**2 - 1, tolerance=1e-8)


def test_kl_divergence_is_the_integral():
    """Of p log(p / q) for one action, by quadrature, and of the squashed densities, by the integral over the action."""
    old_mean, old_log_std, mean, log_std = (jnp.array([x]) for x in (0.3, -0.5, -0.2, 0.1))
    u = np.linspace(-12, 12, 200_001)
    old, new = (
        scipy.stats.norm.logpdf(u, m.item(), np.exp(s.item())) for m, s in ((old_mean, old_log_std), (mean, log_std))
    )
    expected = np.trapezoid(np.exp(old) * (old - new), u)
    assert_close(gaussian_kl(old_mean, old_log_std, mean, log_std), expected)

    a = jnp.linspace(-0.99999, 0.99999, 400_001)[:, None]
    old, new = (
        np.float64(squashed_gaussian_log_prob(jnp.arctanh(a), m, s))
        for m, s in ((old_mean, old_log_std), (mean, log_std))
    )
    np.testing.assert_allclose(np.trapezoid(np.exp(old) * (old - new), a[:, 0]), expected, rtol=1e-3)


def test_kl_divergence_is_zero_at_itself_and_adds_up_over_the_actions():
    _, mean, log_std = policy()
    assert_close(gaussian_kl(mean, log_std, mean, log_std), np.zeros(len(mean)))
    each = [
        gaussian_kl(mean[:, i : i + 1], log_std[:, i : i + 1], 0 * mean[:, :1], 0 * log_std[:, :1]) for i in range(3)
    ]
    assert_close(gaussian_kl(mean, log_std, 0 * mean, 0 * log_std), sum(each))


@pytest.mark.parametrize("shape", [(1,), (3,), (5, 3)])
def test_entropy_is_scipys_summed_over_the_actions(shape):
    _, _, log_std = policy(shape)
    assert_close(gaussian_entropy(log_std), scipy.stats.norm.entropy(scale=np.exp(np.float64(log_std))).sum(axis=-1))


def test_entropy_grows_by_one_nat_for_each_nat_of_log_deviation():
    _, _, log_std = policy()
    np.testing.assert_array_equal(jax.grad(lambda x: gaussian_entropy(x).sum())(log_std), np.ones((5, 3)))


def samples_with(mean, log_std, number=100_000, seed=0):
    """[number, actions] samples in float64."""
    means = jnp.broadcast_to(jnp.asarray(mean, jnp.float32), (number, len(mean)))
    return np.float64(gaussian_sample(jax.random.key(seed), means, jnp.asarray(log_std, jnp.float32)))


def test_samples_have_the_mean_and_the_deviation():
    """Within four standard errors: sigma / sqrt(n) of the mean, sigma / sqrt(2 n) of the deviation."""
    mean, sigma = np.array([-1.0, 0.0, 2.0]), np.array([0.1, 1.0, 3.0])
    samples = samples_with(mean, np.log(sigma))
    error = sigma / np.sqrt(len(samples))
    assert np.all(np.abs(samples.mean(axis=0) - mean) < 4 * error)
    assert np.all(np.abs(samples.std(axis=0) - sigma) < 4 * error / np.sqrt(2))


def test_samples_of_different_actions_are_uncorrelated():
    """Within four standard errors, 1 / sqrt(n); one number for all actions would correlate fully."""
    samples = samples_with(np.zeros(3), np.zeros(3))
    correlations = np.corrcoef(samples.T)[np.triu_indices(3, k=1)]
    assert np.all(np.abs(correlations) < 4 / np.sqrt(len(samples)))


def test_sample_is_differentiable_in_mean_and_deviation():
    """u = mean + sigma epsilon: du/dmean = 1, du/dlog sigma = u - mean."""
    _, mean, log_std = policy()

    def sample(mean, log_std):
        return gaussian_sample(jax.random.key(0), mean, log_std)

    slopes = jax.grad(lambda *parameters: sample(*parameters).sum(), argnums=(0, 1))(mean, log_std)
    assert_close(slopes[0], np.ones((5, 3)))
    assert_close(slopes[1], sample(mean, log_std) - mean)


@settings(max_examples=50, deadline=None)
@given(st.floats(-100, 100, width=32), st.sampled_from([0.5, 1.0, 2.0]))
def test_squash_stays_within_the_limits(u, limit):
    assert_close(squash(jnp.float32(u), limit), limit * np.tanh(float(u)))
    assert abs(squash(jnp.float32(u), limit)) <= limit


@pytest.mark.parametrize("limit", LIMITS)
def test_log_det_is_the_log_of_the_derivative(limit):
    """For |u| <= 3, where 1 - tanh^2 >= 0.01 still has five digits in float32."""
    u = jnp.linspace(-3.0, 3.0, 25)
    derivative = jax.vmap(jax.grad(lambda u: squash(u, limit)))(u)
    assert_close(squash_log_det(u[:, None], limit), jnp.log(derivative), tolerance=2e-5)


@pytest.mark.parametrize("limit", LIMITS)
def test_log_det_far_out_is_the_float64_value(limit):
    """1 - tanh^2 = 1 / cosh^2, which float64 has up to |u| = 350; float32's tanh is 1 from 9 on."""
    u = np.linspace(-50.0, 50.0, 401).astype(np.float32)
    expected = np.log(limit) - 2 * np.log(np.cosh(np.float64(u)))
    np.testing.assert_allclose(squash_log_det(u[:, None], limit), expected, rtol=1e-6, atol=1e-6)


def test_log_det_written_out_is_infinite_far_out():
    """Why the docstring's right-hand form is used: the wrong variant of the test above."""
    written_out = jnp.log(1 - jnp.tanh(jnp.float32([20.0, 50.0])) ** 2)
    assert not np.any(np.isfinite(written_out))


def test_log_det_has_the_right_gradient_far_out():
    """-2 tanh u, finite everywhere."""
    u = np.linspace(-50.0, 50.0, 401).astype(np.float32)
    slope = jax.grad(lambda u: squash_log_det(u[:, None]).sum())(u)
    assert_close(slope, -2 * np.tanh(np.float64(u)))


def test_log_det_adds_up_over_actions_with_their_own_limits():
    u, limit = policy((5, 3))[0], np.float32([0.5, 1.0, 2.0])
    expected = sum(squash_log_det(u[:, i : i + 1], limit[i]) for i in range(3))
    assert_close(squash_log_det(u, limit), expected)


def squashed_density(a, limit):
    """pi(a) from the code under test, at u = atanh(a / limit) in float64."""
    u = jnp.asarray(np.arctanh(a / limit)[:, None], jnp.float32)
    return np.exp(np.float64(squashed_gaussian_log_prob(u, jnp.full(1, MEAN), jnp.full(1, LOG_STD), limit)))


def density_without_jacobian(a, limit):
    """The usual mistake: the Gaussian's density at u taken for the density at a."""
    return scipy.stats.norm.pdf(np.arctanh(a / limit), MEAN, SIGMA)


def integral(density, limit, low=None, high=None, points=20_001):
    """Midpoint rule over a; the density goes to 0 at the limits, so nothing is lost there."""
    low, high = (-limit if low is None else low), (limit if high is None else high)
    edges = np.linspace(low, high, points + 1)
    return density((edges[:-1] + edges[1:]) / 2, limit).sum() * (high - low) / points


@pytest.mark.parametrize("limit", LIMITS)
def test_squashed_density_integrates_to_one(limit):
    assert integral(squashed_density, limit) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("limit", LIMITS)
def test_density_without_the_jacobian_does_not_integrate_to_one(limit):
    """It integrates to E[limit (1 - tanh(u)^2)]."""
    u = np.linspace(MEAN - 8 * SIGMA, MEAN + 8 * SIGMA, 20_001)
    weights = scipy.stats.norm.pdf(u, MEAN, SIGMA) * (u[1] - u[0])
    expected = np.sum(weights * limit * (1 - np.tanh(u) ** 2))
    assert integral(density_without_jacobian, limit) == pytest.approx(expected, abs=1e-4)
    assert abs(expected - 1.0) > 0.1


BINS = 12


def standard_scores(density, limit, number=50_000):
    """Deviation of each bin's count of squashed samples from the density, in units of its standard error.

    A bin of probability p holds n p samples with standard error sqrt(n p (1 - p)).
    """
    samples = limit * np.tanh(samples_with([MEAN], [LOG_STD], number, seed=1)[:, 0])
    edges = np.linspace(-limit, limit, BINS + 1)
    counts = np.histogram(samples, edges)[0]
    bins = itertools.pairwise(edges)
    probability = np.array([integral(density, limit, low, high, points=501) for low, high in bins])
    probability = probability / probability.sum()
    return (counts - number * probability) / np.sqrt(number * probability * (1 - probability))


@pytest.mark.parametrize("limit", LIMITS)
def test_squashed_samples_fill_the_bins_as_the_density_says(limit):
    """Within four standard errors in each of 12 bins: 1 seed in 1300 would fail, and the seed is fixed."""
    assert np.abs(standard_scores(squashed_density, limit)).max() < 4


@pytest.mark.parametrize("limit", LIMITS)
def test_density_without_the_jacobian_does_not_fit_the_samples(limit):
    """Not even when it is scaled to integrate to 1."""
    assert np.abs(standard_scores(density_without_jacobian, limit)).max() > 20


def test_squashed_log_prob_is_that_of_the_gaussian_minus_the_log_det():
    """Change of variables in float64, with limits by action."""
    u, mean, log_std = policy((5, 3))
    limit = np.array([0.5, 1.0, 2.0])
    gaussian = scipy.stats.norm.logpdf(np.float64(u), np.float64(mean), np.exp(np.float64(log_std)))
    expected = (gaussian - np.log(limit * (1 - np.tanh(np.float64(u)) ** 2))).sum(axis=-1)
    assert_close(squashed_gaussian_log_prob(u, mean, log_std, jnp.float32(limit)), expected)


def test_score_of_a_stored_action_does_not_see_the_squashing():
    u, mean, log_std = policy()
    plain = jax.grad(lambda *parameters: gaussian_log_prob(u, *parameters).sum(), argnums=(0, 1))
    squashed = jax.grad(lambda *parameters: squashed_gaussian_log_prob(u, *parameters, 2.0).sum(), argnums=(0, 1))
    for left, right in zip(squashed(mean, log_std), plain(mean, log_std), strict=True):
        np.testing.assert_array_equal(left, right)


def test_where_the_action_is_differentiated_the_squashing_counts():
    """d log pi / du = -(u - mean) / sigma^2 + 2 tanh u."""
    u, mean, log_std = policy()
    slope = jax.grad(lambda u: squashed_gaussian_log_prob(u, mean, log_std, 2.0).sum())(u)
    plain = -(np.float64(u) - mean) / np.exp(2 * np.float64(log_std))
    assert_close(slope, plain + 2 * np.tanh(np.float64(u)))


def test_squashed_log_prob_and_its_gradients_are_finite_far_out():
    u = jnp.float32([[-50.0], [-9.5], [9.5], [50.0]])
    value, slopes = jax.value_and_grad(
        lambda *arguments: squashed_gaussian_log_prob(*arguments, 2.0).sum(), argnums=(0, 1, 2)
    )(u, jnp.zeros((4, 1)), jnp.zeros((4, 1)))
    assert np.isfinite(value)
    assert all(np.all(np.isfinite(slope)) for slope in slopes)
