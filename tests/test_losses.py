"""Losses: values and gradients by hand, and where no gradient may flow."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpg.distributions import gaussian_log_prob
from jaxpg.losses import (
    clipped_surrogate_loss,
    clipped_value_loss,
    entropy_loss,
    policy_gradient_loss,
    value_loss,
)

SHAPES = [(1,), (6,), (5, 3)]


def random(shape, count, seed=0):
    return np.random.default_rng(seed).normal(size=(count, *shape)).astype(np.float32)


def random_weight(shape):
    """Fractions, and about a third zeros."""
    rng = np.random.default_rng(9)
    return (rng.uniform(0.2, 1.5, shape) * (rng.random(shape) < 0.7)).astype(np.float32)


def mean(terms):
    """Over all entries, in float64."""
    terms = list(terms)
    return sum(terms) / len(terms)


def entries(*xs):
    """The arrays' entries, one tuple of Python floats for each index."""
    return zip(*(np.float64(x).ravel().tolist() for x in xs), strict=True)


def assert_close(actual, expected):
    """float32 means of at most 15 terms of size 1."""
    np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("shape", SHAPES)
def test_policy_gradient_loss_is_minus_the_mean_of_score_times_advantage(shape):
    log_prob, advantage = random(shape, 2)
    weight = random_weight(shape)
    assert_close(policy_gradient_loss(log_prob, advantage), -mean(p * a for p, a in entries(log_prob, advantage)))
    expected = -mean(w * p * a for w, p, a in entries(weight, log_prob, advantage))
    assert_close(policy_gradient_loss(log_prob, advantage, weight), expected)


@pytest.mark.parametrize("shape", SHAPES)
def test_value_loss_is_half_the_mean_squared_error(shape):
    value, target = random(shape, 2)
    weight = random_weight(shape)
    assert_close(value_loss(value, target), 0.5 * mean((v - y) ** 2 for v, y in entries(value, target)))
    expected = 0.5 * mean(w * (v - y) ** 2 for w, v, y in entries(weight, value, target))
    assert_close(value_loss(value, target, weight), expected)


@pytest.mark.parametrize("clip", [0.1, 0.5, None])
@pytest.mark.parametrize("shape", SHAPES)
def test_clipped_surrogate_is_the_equation(shape, clip):
    log_prob, old, advantage = random(shape, 3)
    log_prob = old + 0.4 * log_prob  # ratios from about 0.5 to 2
    weight = random_weight(shape)

    def gain(p, q, a):
        ratio = np.exp(p - q)
        return ratio * a if clip is None else min(ratio * a, np.clip(ratio, 1 - clip, 1 + clip) * a)

    expected = -mean(w * gain(p, q, a) for w, p, q, a in entries(weight, log_prob, old, advantage))
    assert_close(clipped_surrogate_loss(log_prob, old, advantage, clip, weight), expected)


@pytest.mark.parametrize("clip", [0.2, None])
def test_clipped_surrogate_has_the_policy_gradient_at_the_policy_that_acted(clip):
    log_prob, advantage = random((5, 3), 2)
    weight = random_weight((5, 3))
    found = jax.grad(clipped_surrogate_loss)(log_prob, log_prob, advantage, clip, weight)
    np.testing.assert_array_equal(found, jax.grad(policy_gradient_loss)(log_prob, advantage, weight))


@pytest.mark.parametrize(
    ("ratio", "advantage", "moves"),
    [(1.3, 1.0, False), (0.7, -1.0, False), (1.3, -1.0, True), (0.7, 1.0, True), (1.1, 1.0, True), (0.9, -1.0, True)],
)
def test_no_gradient_beyond_the_clip_in_the_advantages_direction(ratio, advantage, moves):
    """Back towards 1, and within 1 +- 0.2, it is -rho A."""
    slope = jax.grad(clipped_surrogate_loss)(jnp.log(jnp.array([ratio])), jnp.zeros(1), jnp.array([advantage]), 0.2)
    assert_close(slope, [-ratio * advantage * moves])


@pytest.mark.parametrize("shape", SHAPES)
def test_clipped_value_loss_is_the_equation(shape):
    value, old, target = random(shape, 3)
    weight = random_weight(shape)

    def error(v, q, y):
        return max((v - y) ** 2, (q + np.clip(v - q, -0.5, 0.5) - y) ** 2)

    expected = 0.5 * mean(w * error(v, q, y) for w, v, q, y in entries(weight, value, old, target))
    assert_close(clipped_value_loss(value, old, target, 0.5, weight), expected)
    assert_close(clipped_value_loss(value, old, target, 100.0, weight), value_loss(value, target, weight))


def test_no_gradient_passes_through_what_was_before():
    x, old, y = random((5, 3), 3)
    for slope in (
        *jax.grad(clipped_surrogate_loss, argnums=(1, 2))(x, old, y, 0.2),
        *jax.grad(clipped_value_loss, argnums=(1, 2))(x, old, y, 0.2),
    ):
        np.testing.assert_array_equal(slope, np.zeros((5, 3)))


@pytest.mark.parametrize("shape", SHAPES)
def test_entropy_loss_is_minus_the_mean_entropy(shape):
    (entropy,) = random(shape, 1)
    weight = random_weight(shape)
    assert_close(entropy_loss(entropy), -mean(h for (h,) in entries(entropy)))
    assert_close(entropy_loss(entropy, weight), -mean(w * h for w, h in entries(weight, entropy)))


@pytest.mark.parametrize("shape", SHAPES)
def test_gradients_are_those_of_the_docstrings(shape):
    x, y = random(shape, 2)
    weight = random_weight(shape)
    size = x.size
    assert_close(jax.grad(policy_gradient_loss)(x, y, weight), -weight * y / size)
    assert_close(jax.grad(value_loss)(x, y, weight), -weight * (y - x) / size)
    assert_close(jax.grad(entropy_loss)(x, weight), -weight / size)


@pytest.mark.parametrize("loss", [policy_gradient_loss, value_loss])
def test_no_gradient_passes_through_advantage_or_target(loss):
    x, y = random((5, 3), 2)
    np.testing.assert_array_equal(jax.grad(loss, argnums=1)(x, y), np.zeros((5, 3)))


@pytest.mark.parametrize("loss", [policy_gradient_loss, value_loss])
def test_entries_of_weight_zero_do_not_count(loss):
    x, y = random((5, 3), 2)
    weight = np.ones((5, 3), np.float32)
    weight[3:, 1] = 0.0
    other = np.where(weight == 1, x, 100.0), np.where(weight == 1, y, -100.0)
    assert_close(loss(*other, weight), loss(x, y, weight))
    assert abs(loss(*other) - loss(x, y)) > 1.0  # without the weight they do


@pytest.mark.parametrize("loss", [policy_gradient_loss, value_loss])
def test_the_mean_is_over_all_entries_counted_or_not(loss):
    """As many entries of weight 0 as there are others halve the loss; a mean over the weights would keep it."""
    x, y = random((6,), 2)
    weight = np.concatenate([np.ones(6), np.zeros(6)]).astype(np.float32)
    assert_close(loss(np.tile(x, 2), np.tile(y, 2), weight), 0.5 * loss(x, y))


def test_the_mean_of_entropies_is_over_all_entries():
    entropy = random((6,), 1)[0]
    weight = np.concatenate([np.ones(6), np.zeros(6)]).astype(np.float32)
    assert_close(entropy_loss(np.tile(entropy, 2), weight), 0.5 * entropy_loss(entropy))


# A linear Gaussian policy and a linear critic on states of 4 numbers, time 5, batch 3.
STATES, NEXT_STATES = random((5, 3, 4), 2, seed=1)
ACTIONS, ADVANTAGES, REWARDS = random((5, 3), 3, seed=2)
THETA, CRITIC = random((4,), 2, seed=3)
SIGMA, GAMMA = 0.7, 0.9


def linear_gaussian_log_prob(theta):
    mean_action = STATES @ theta
    return gaussian_log_prob(ACTIONS[..., None], mean_action[..., None], jnp.log(jnp.full(1, SIGMA)))


def gradient_by_hand(factor, states):
    """-1/(T N) sum factor_t s_t in float64."""
    total = np.zeros(4)
    for at in np.ndindex(5, 3):
        total -= float(factor[at]) * np.float64(states[at])
    return total / 15


def test_gradient_of_a_linear_gaussian_policy():
    """grad log pi(a | s) = (a - theta's) / sigma^2 s."""
    gradient = jax.grad(lambda theta: policy_gradient_loss(linear_gaussian_log_prob(theta), ADVANTAGES))(THETA)
    score = (np.float64(ACTIONS) - np.float64(STATES) @ np.float64(THETA)) / SIGMA**2
    assert_close(gradient, gradient_by_hand(score * ADVANTAGES, STATES))


def test_advantage_that_depends_on_the_parameters_is_a_constant_all_the_same():
    """As when policy and critic share a layer."""

    def shared(theta):
        return policy_gradient_loss(linear_gaussian_log_prob(theta), REWARDS - STATES @ theta)

    advantage = REWARDS - STATES @ THETA
    expected = jax.grad(lambda theta: policy_gradient_loss(linear_gaussian_log_prob(theta), advantage))(THETA)
    assert_close(jax.grad(shared)(THETA), expected)


def one_step_loss(critic):
    return value_loss(STATES @ critic, REWARDS + GAMMA * NEXT_STATES @ critic)


def delta_by_hand():
    states, next_states, critic = np.float64(STATES), np.float64(NEXT_STATES), np.float64(CRITIC)
    return REWARDS + GAMMA * next_states @ critic - states @ critic


def test_one_step_target_gives_the_semi_gradient():
    """-mean delta_t s_t: the TD(0) update of a linear critic."""
    assert_close(jax.grad(one_step_loss)(CRITIC), gradient_by_hand(delta_by_hand(), STATES))


def test_one_step_target_does_not_give_the_gradient_of_the_residual():
    """-mean delta_t (s_t - gamma s_{t+1}) is what the squared TD error would give if nothing were stopped."""
    residual = gradient_by_hand(delta_by_hand(), STATES - GAMMA * NEXT_STATES)
    assert np.abs(jax.grad(one_step_loss)(CRITIC) - residual).max() > 0.1


@pytest.mark.parametrize(("loss", "second"), [(policy_gradient_loss, "advantage"), (value_loss, "target")])
@pytest.mark.parametrize("shapes", [((4,), (4, 1)), ((4, 1), (4,)), ((4, 3), (3,))])
def test_shapes_that_would_be_spread_in_silence_raise(loss, second, shapes):
    with pytest.raises(ValueError, match=rf"^{second} has shape"):
        loss(jnp.ones(shapes[0]), jnp.ones(shapes[1]))


@pytest.mark.parametrize("loss", [policy_gradient_loss, value_loss])
def test_a_weight_that_would_be_spread_in_silence_raises(loss):
    with pytest.raises(ValueError, match="weight"):
        loss(jnp.ones((4, 1)), jnp.ones((4, 1)), jnp.ones(4))
