"""Running statistics: batches in any sizes and any order are the whole."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxpg.normalization import init, normalize, update

# few sizes, so that few shapes are compiled
batch_sizes = st.lists(st.sampled_from([1, 2, 5, 16]), min_size=1, max_size=6)
seeds = st.integers(0, 1000)
few_examples = settings(max_examples=30, deadline=None)


def batches_of(sizes, seed, size=3):
    """Each batch has its own mean, which the merged variance has to notice; components differ in scale."""
    rng = np.random.default_rng(seed)
    scale = np.array([0.1, 1.0, 10.0])[:size]
    return [((rng.normal(size=(n, size)) + rng.normal(size=size)) * scale).astype(np.float32) for n in sizes]


def statistics_of(batches):
    statistics = init(batches[0].shape[-1])
    for batch in batches:
        statistics = update(statistics, batch)
    return statistics


def assert_describes(statistics, samples):
    """Mean and population variance in float64; errors are relative to the samples' own scale."""
    samples = np.float64(samples)
    scale = np.sqrt(np.mean(samples**2, axis=0))
    assert statistics.count == len(samples)
    assert np.all(np.abs(statistics.mean - samples.mean(axis=0)) < 1e-5 * scale)
    assert np.all(np.abs(statistics.variance - samples.var(axis=0)) < 1e-5 * scale**2)


@few_examples
@given(batch_sizes, seeds)
def test_updates_give_mean_and_variance_of_all_samples(sizes, seed):
    batches = batches_of(sizes, seed)
    assert_describes(statistics_of(batches), np.concatenate(batches))


@few_examples
@given(batch_sizes, seeds)
def test_order_of_the_batches_does_not_matter(sizes, seed):
    batches = batches_of(sizes, seed)
    assert_describes(statistics_of(batches[::-1]), np.concatenate(batches))


def test_variance_between_batches_counts():
    """Two constant batches have no variance inside; all of (10^2) lies between them."""
    statistics = statistics_of([np.full((4, 1), -10.0, np.float32), np.full((4, 1), 10.0, np.float32)])
    assert statistics.mean[0] == pytest.approx(0.0, abs=1e-5)
    assert statistics.variance[0] == pytest.approx(100.0, rel=1e-5)


def test_first_batch_leaves_nothing_of_the_initial_variance():
    statistics = update(init(2), np.float32([[1.0, 5.0]]))
    np.testing.assert_array_equal(statistics.mean, [1.0, 5.0])
    np.testing.assert_array_equal(statistics.variance, [0.0, 0.0])


def test_time_and_batch_axes_are_all_samples():
    samples = batches_of([30], seed=0)[0]
    folded = update(init(3), samples.reshape(5, 6, 3))
    assert_describes(folded, samples)
    assert folded.mean.shape == folded.variance.shape == (3,)


def test_jit_and_scan_are_a_loop():
    batches = batches_of([5] * 8, seed=1)
    scanned, _ = jax.lax.scan(lambda statistics, batch: (update(statistics, batch), None), init(3), np.stack(batches))
    assert_describes(scanned, np.concatenate(batches))


def far_from_zero():
    """1000 batches of 16 with mean 3000 and variance 1/2. Near 3000^2 float32 has whole numbers only."""
    return np.random.default_rng(0).normal(3000.0, np.sqrt(0.5), (1000, 16, 1)).astype(np.float32)


def test_many_updates_far_from_zero_do_not_drift():
    """The mean is kept to some units in its last place, 2e-4; the variance gets by with differences from it."""
    batches = far_from_zero()
    statistics, _ = jax.lax.scan(lambda statistics, batch: (update(statistics, batch), None), init(1), batches)
    samples = np.float64(batches.reshape(-1))
    assert statistics.mean[0] == pytest.approx(samples.mean(), abs=1e-2)
    assert statistics.variance[0] == pytest.approx(samples.var(), abs=1e-2)


def test_mean_of_squares_minus_square_of_mean_would_drift():
    """The wrong variant of the test above: its variance is a whole number, or worse."""

    def add(sums, batch):
        return (sums[0] + jnp.sum(batch), sums[1] + jnp.sum(batch**2)), None

    batches = far_from_zero()
    (total, squares), _ = jax.lax.scan(add, (jnp.zeros(()), jnp.zeros(())), batches)
    variance = squares / batches.size - (total / batches.size) ** 2
    assert abs(variance - np.float64(batches).var()) > 0.1


def test_normalize_before_any_update_is_the_identity():
    """To epsilon / 2 = 5e-7 relative."""
    x = batches_of([16], seed=2)[0]
    np.testing.assert_allclose(normalize(init(3), x), x, rtol=1e-6)


def test_normalized_samples_have_mean_zero_and_deviation_one():
    """Deviation 1 up to epsilon / (2 variance), which is 5e-5 for the component of variance 0.01."""
    samples = batches_of([64], seed=3)[0]
    normal = np.float64(normalize(update(init(3), samples), samples))
    np.testing.assert_allclose(normal.mean(axis=0), 0.0, atol=1e-5)
    np.testing.assert_allclose(normal.std(axis=0), 1.0, atol=1e-4)


def test_normalize_is_the_equation():
    """(x - mean) / sqrt(variance + epsilon), with an epsilon that shows."""
    samples, x = batches_of([8, 4], seed=4)
    mean, variance = np.float64(samples).mean(axis=0), np.float64(samples).var(axis=0)
    actual = normalize(update(init(3), samples), x, epsilon=0.5)
    np.testing.assert_allclose(actual, (x - mean) / np.sqrt(variance + 0.5), rtol=1e-5, atol=1e-5)


def test_normalize_keeps_time_and_batch_axes():
    samples = batches_of([30], seed=5)[0]
    statistics = update(init(3), samples)
    folded = normalize(statistics, samples.reshape(5, 6, 3))
    np.testing.assert_allclose(folded, normalize(statistics, samples).reshape(5, 6, 3), rtol=1e-6)


@few_examples
@given(st.floats(-10, 10, width=32))
def test_constant_component_becomes_zero(constant):
    """Up to a few units in the last place of the constant (10 * 1e-7), over sqrt(epsilon) = 1e-3."""
    batches = [np.full((n, 1), constant, np.float32) for n in (16, 5, 1)]
    np.testing.assert_allclose(normalize(statistics_of(batches), batches[0]), 0.0, atol=1e-2)
