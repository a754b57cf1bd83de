"""Running statistics: batches in any sizes and any order are the whole."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jaxpg import normalization
from jaxpg.normalization import init, normalize

update = jax.jit(normalization.update)  # whose branches would be compiled anew at each call

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


# in which most samples lie close to the median by chance: the others are no outliers
@example([5], 367)
@example([16], 426)
@example([4], 1095)
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
    x = batches_of([16], seed=2)[0]
    np.testing.assert_allclose(normalize(init(3), x), x, rtol=1e-7)


def test_normalized_samples_have_mean_zero_and_deviation_one():
    samples = batches_of([64], seed=3)[0]
    normal = np.float64(normalize(update(init(3), samples), samples))
    np.testing.assert_allclose(normal.mean(axis=0), 0.0, atol=1e-5)
    np.testing.assert_allclose(normal.std(axis=0), 1.0, atol=1e-5)


def test_normalize_is_the_equation():
    samples, x = batches_of([8, 4], seed=4)
    mean, deviation = np.float64(samples).mean(axis=0), np.float64(samples).std(axis=0)
    actual = normalize(update(init(3), samples), x)
    np.testing.assert_allclose(actual, (x - mean) / deviation, rtol=1e-5, atol=1e-5)


def test_normalize_keeps_time_and_batch_axes():
    samples = batches_of([30], seed=5)[0]
    statistics = update(init(3), samples)
    folded = normalize(statistics, samples.reshape(5, 6, 3))
    np.testing.assert_allclose(folded, normalize(statistics, samples).reshape(5, 6, 3), rtol=1e-6)


# --- units ------------------------------------------------------------------------------------------------------------


@few_examples
@given(st.integers(-30, 30), batch_sizes, seeds)
def test_units_do_not_matter(exponent, sizes, seed):
    """2^k times the samples are the same normalized numbers: of 1e-9 metres or of 1e9."""
    batches = batches_of([16, *sizes], seed)
    plain = normalize(statistics_of(batches), batches[0])
    unit = np.float32(2.0) ** exponent
    scaled = normalize(statistics_of([unit * batch for batch in batches]), unit * batches[0])
    np.testing.assert_allclose(scaled, plain, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("offset", "deviation"), [(1e4, 0.1), (-1e4, 0.1), (1e6, 10.0), (3.0, 1e-3), (0.0, 1e-5)])
def test_a_large_offset_hides_no_small_variation(offset, deviation):
    """Mean 0 and deviation 1 to 3 %, by 200 batches: float32 near 1e4 has steps of 1e-3, a hundredth of 0.1."""
    random = np.random.default_rng(0)
    batches = (offset + deviation * random.normal(size=(200, 256, 1))).astype(np.float32)
    statistics, _ = jax.lax.scan(lambda statistics, batch: (update(statistics, batch), None), init(1), batches)
    normal = np.float64(normalize(statistics, batches))
    assert abs(normal.mean()) < 0.03
    assert normal.std() == pytest.approx(1.0, abs=0.03)


@few_examples
@given(
    st.floats(-(2.0**100), 2.0**100, width=32, allow_subnormal=False),
    st.lists(st.sampled_from([1, 5, 16, 4096]), min_size=1, max_size=6),
)
def test_constant_component_becomes_zero(constant, sizes):
    """Exactly: a mean that is a rounding error off would make the same error in all samples, and scale it up to 1."""
    batches = [np.full((n, 1), constant, np.float32) for n in sizes]
    np.testing.assert_array_equal(normalize(statistics_of(batches), batches[0]), 0.0)


def test_rounding_is_not_scaled_up():
    """cos^2 + sin^2 is 1, but for its last place."""
    x = np.random.default_rng(0).uniform(-3, 3, (8, 256, 1)).astype(np.float32)
    batches = list(np.cos(x) ** 2 + np.sin(x) ** 2)
    assert 0 < np.std(batches) < 1e-6
    assert np.abs(normalize(statistics_of(batches), batches[0])).max() < 0.3


# --- samples far outside ----------------------------------------------------------------------------------------------

FAR = [1e3, 1e6, 1e9]


@pytest.mark.parametrize("far", FAR)
@pytest.mark.parametrize("when", [0, 1, 50])
def test_one_sample_far_outside_does_not_spoil_the_others(far, when):
    """One among 1e5 of size 1, in the first batch or later: mean and deviation move by less than 1 %."""
    batches = np.random.default_rng(0).normal(size=(100, 1000, 1)).astype(np.float32)
    batches[when, 300] = far
    statistics = statistics_of(batches)
    assert statistics.mean[0] == pytest.approx(0.0, abs=0.02)
    assert np.sqrt(statistics.variance[0]) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("far", FAR)
def test_some_in_every_batch_do_not_either(far):
    """A few in a thousand, always: what is normalized keeps its size to a factor of 2."""
    batches = np.random.default_rng(0).normal(size=(100, 1000, 1)).astype(np.float32)
    batches[:, [3, 700]] = far
    assert np.sqrt(statistics_of(batches).variance[0]) < 2


@pytest.mark.parametrize(("before", "after", "factor"), [(1, 100, 1e6), (10, 100, 1e6), (200, 400, 1e3)])
def test_a_change_of_scale_that_lasts_is_followed(before, after, factor):
    """A robot that begins to move: at the end the deviation is that of the larger samples to a factor of 2."""
    batches = np.random.default_rng(0).normal(size=(before + after, 100, 1)).astype(np.float32)
    batches[before:] *= factor
    statistics, _ = jax.lax.scan(lambda statistics, batch: (update(statistics, batch), None), init(1), batches)
    assert factor / 2 < np.sqrt(statistics.variance[0]) < 2 * factor


def test_what_begins_to_vary_is_followed():
    """A sensor that was silent for long: at the end the deviation is right to a factor of 2."""
    batches = np.zeros((300, 100, 1), np.float32)
    batches[200:] = np.random.default_rng(0).normal(size=(100, 100, 1))
    statistics, _ = jax.lax.scan(lambda statistics, batch: (update(statistics, batch), None), init(1), batches)
    assert 0.5 < np.sqrt(statistics.variance[0]) / np.float64(batches).std() < 2


@pytest.mark.parametrize("junk", [np.nan, np.inf, 1e38])
@pytest.mark.parametrize("first", [0, 1])
def test_what_does_not_count_is_not_looked_at(junk, first):
    """To the bit: whatever stands in the rows that do not count, and where none counts nothing changes."""
    clean = batches_of([16, 16], seed=6)
    spoiled = [batch.copy() for batch in clean]
    counts = np.arange(16) % 3 > 0
    for batch in spoiled:
        batch[~counts] = junk
    statistics = statistics_of(clean[:first]) if first else init(3)
    actual, expected = (update(statistics, batches[first], counts=counts) for batches in (spoiled, clean))
    jax.tree.map(np.testing.assert_array_equal, actual, expected)
    assert_describes(update(init(3), spoiled[0], counts=counts), clean[0][counts])
    jax.tree.map(np.testing.assert_array_equal, update(statistics, spoiled[0], counts=False), statistics)
