"""The ladder of estimators: loops over the equations, identities between rungs, and expectations by enumeration."""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxpg.baselines import batch_mean, leave_one_out, optimal, time_mean
from jaxpg.estimators import n_step, normalize_advantages, reinforce, reinforce_whole, td_lambda, td_zero
from jaxpg.returns import discounted_returns

SHAPES = [(1,), (7, 3), (5, 3, 2)]


def less_the_mean(reward, discount, weight=1.0):
    """REINFORCE with the mean return of the batch as baseline."""
    return reinforce(reward, discount, batch_mean(discounted_returns(reward, discount, 0.0), weight))


class Steps(NamedTuple):
    reward: np.ndarray
    discount: np.ndarray
    value: np.ndarray
    next_value: np.ndarray
    lambda_: np.ndarray
    cut: np.ndarray


def trajectory(shape, seed=0):
    """Random ends and cuts. V(s_{t+1}) is the value of the following step wherever the episode goes on."""
    rng = np.random.default_rng(seed)
    terminated, cut = rng.random(shape) < 0.2, rng.random(shape) < 0.2
    value, true_next_value = rng.normal(size=shape), rng.normal(size=shape)
    following = np.concatenate([value[1:], true_next_value[-1:]])
    steps = Steps(
        reward=rng.normal(size=shape),
        discount=rng.uniform(0.8, 1.0, shape) * ~terminated,
        value=value,
        next_value=np.where(cut | terminated, true_next_value, following),
        lambda_=rng.uniform(0.5, 1.0, shape) * ~cut,
        cut=cut,
    )
    return Steps(*(x.astype(np.float32) for x in steps))


def assert_close(actual, expected, tolerance=1e-5):
    """float32 sums of fewer than 10 terms of size 1."""
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance * max(1.0, np.abs(expected).max()))


def loop_returns(reward, discount):
    """G_t = r_t + d_t G_{t+1}, G_T = 0."""
    reward, discount = np.float64(reward), np.float64(discount)
    result, following = np.zeros_like(reward), np.zeros_like(reward[0])
    for t in reversed(range(len(reward))):
        following = reward[t] + discount[t] * following
        result[t] = following
    return result


def loop_delta(steps):
    """delta_t = r_t + d_t V(s_{t+1}) - V(s_t)."""
    reward, discount, value, next_value, _, _ = (np.float64(x) for x in steps)
    return np.stack([reward[t] + discount[t] * next_value[t] - value[t] for t in range(len(reward))])


def loop_gae(steps):
    """A_t = sum_k (d_t lambda_t) ... (d_{t+k-1} lambda_{t+k-1}) delta_{t+k}."""
    delta, factor = loop_delta(steps), np.float64(steps.discount) * np.float64(steps.lambda_)
    result = np.zeros_like(delta)
    for t in range(len(delta)):
        weight = np.ones_like(delta[0])
        for k in range(t, len(delta)):
            result[t] += weight * delta[k]
            weight = weight * factor[k]
    return result


@pytest.mark.parametrize("shape", SHAPES)
def test_reinforce_is_the_return(shape):
    steps = trajectory(shape)
    expected = loop_returns(steps.reward, steps.discount)
    estimate = reinforce(steps.reward, steps.discount)
    assert_close(estimate.advantage, expected)
    assert_close(estimate.target, expected)


@pytest.mark.parametrize("shape", SHAPES)
def test_mean_baseline_subtracts_one_number_from_every_return(shape):
    steps = trajectory(shape)
    returns = loop_returns(steps.reward, steps.discount)
    estimate = less_the_mean(steps.reward, steps.discount)
    assert_close(estimate.advantage, returns - sum(returns.ravel()) / returns.size)
    assert_close(estimate.target, returns)


@pytest.mark.parametrize("shape", SHAPES)
def test_mean_baseline_is_the_weighted_mean(shape):
    steps = trajectory(shape)
    weight = np.random.default_rng(1).uniform(0.1, 2.0, shape).astype(np.float32)
    returns = loop_returns(steps.reward, steps.discount)
    weighted = sum(float(weight[at]) * returns[at] for at in np.ndindex(*shape))
    baseline = weighted / sum(float(weight[at]) for at in np.ndindex(*shape))
    assert_close(less_the_mean(steps.reward, steps.discount, weight).advantage, returns - baseline)


@pytest.mark.parametrize("shape", SHAPES)
def test_value_baseline_is_monte_carlo_minus_value(shape):
    steps = trajectory(shape)
    returns = loop_returns(steps.reward, steps.discount)
    estimate = reinforce(steps.reward, steps.discount, steps.value)
    assert_close(estimate.advantage, returns - steps.value)
    assert_close(estimate.target, returns)


@pytest.mark.parametrize("shape", SHAPES)
def test_td_zero_is_the_td_error(shape):
    steps = trajectory(shape)
    estimate = td_zero(*steps[:4])
    assert_close(estimate.advantage, loop_delta(steps))
    assert_close(estimate.target, loop_delta(steps) + steps.value)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_td_lambda_is_the_discounted_sum_of_td_errors(shape, seed):
    """GAE as Schulman et al. write it, through ends and cuts."""
    steps = trajectory(shape, seed)
    assert_close(td_lambda(*steps[:5]).advantage, loop_gae(steps))


def test_td_lambda_takes_the_value_of_the_true_next_observation_at_a_cut():
    """The usual mistake, V of the following step (after the reset), is another number there."""
    steps = trajectory((7, 3))
    cut = steps.cut[:-1].astype(bool) & (steps.discount[:-1] > 0)
    after_reset = steps._replace(next_value=np.concatenate([steps.value[1:], steps.next_value[-1:]]))
    difference = np.abs(loop_gae(after_reset) - td_lambda(*steps[:5]).advantage)[:-1]
    assert cut.any()
    assert np.all(difference[cut] > 0.01)


@pytest.mark.parametrize("shape", SHAPES)
def test_td_lambda_without_lambda_is_td_zero(shape):
    steps = trajectory(shape)
    for left, right in zip(td_lambda(*steps[:4], 0.0), td_zero(*steps[:4]), strict=True):
        assert_close(left, right)


def test_td_lambda_one_is_monte_carlo_minus_value_in_complete_episodes():
    steps = trajectory((7, 3))
    steps.discount[-1] = 0.0
    expected = reinforce(*steps[:3])
    for left, right in zip(td_lambda(*steps[:4], 1.0), expected, strict=True):
        assert_close(left, right)


ESTIMATORS = {
    "value_baseline": lambda steps: reinforce(*steps[:3]),
    "td_zero": lambda steps: td_zero(*steps[:4]),
    "td_lambda": lambda steps: td_lambda(*steps[:5]),
}


@pytest.mark.parametrize("estimator", ESTIMATORS.values(), ids=ESTIMATORS)
@pytest.mark.parametrize("shape", SHAPES)
def test_advantage_plus_value_is_the_target(estimator, shape):
    steps = trajectory(shape)
    estimate = estimator(steps)
    assert_close(estimate.advantage + steps.value, np.asarray(estimate.target))


@pytest.mark.parametrize("estimator", ESTIMATORS.values(), ids=ESTIMATORS)
def test_jit_and_vmap_change_nothing(estimator):
    steps = trajectory((7, 3))
    expected = estimator(steps)
    for transformed in (jax.jit(estimator), jax.vmap(estimator, in_axes=1, out_axes=1)):
        assert_close(transformed(steps).advantage, np.asarray(expected.advantage))


def test_critic_that_is_right_leaves_no_advantage():
    """V = G for known rewards: nothing is better than expected, at any lambda."""
    steps = trajectory((7, 3))
    steps.discount[-1] = 0.0
    value = loop_returns(steps.reward, steps.discount).astype(np.float32)
    next_value = np.concatenate([value[1:], np.zeros((1, 3), np.float32)])
    for lambda_ in (0.0, 0.7, 1.0):
        advantage = td_lambda(steps.reward, steps.discount, value, next_value, lambda_).advantage
        assert_close(advantage, np.zeros((7, 3)))


def finished_episodes():
    """Episodes of 2, 4 and 5 steps in 5 rows; after the end the weight is 0 and the reward is noise."""
    lengths = np.array([2, 4, 5])
    time = np.arange(5)[:, None]
    weight = (time < lengths).astype(np.float32)
    discount = np.where(time == lengths - 1, 0.0, 0.9).astype(np.float32)
    reward = np.random.default_rng(2).normal(size=(5, 3)).astype(np.float32)
    return reward, discount, weight


def test_mean_baseline_ignores_masked_steps():
    reward, discount, weight = finished_episodes()
    other = np.where(weight == 1, reward, reward + 100.0)
    counted = weight == 1
    left = np.asarray(less_the_mean(reward, discount, weight).advantage)
    right = np.asarray(less_the_mean(other, discount, weight).advantage)
    np.testing.assert_array_equal(left[counted], right[counted])
    assert_close(left[counted].sum(), 0.0)


def test_mean_baseline_without_weights_would_count_masked_steps():
    """The control: the same change is seen when every entry counts."""
    reward, discount, weight = finished_episodes()
    other = np.where(weight == 1, reward, reward + 100.0)
    left, right = (np.asarray(less_the_mean(x, discount).advantage) for x in (reward, other))
    assert np.all(np.abs(left - right)[weight == 1] > 1.0)


# Two actions, taken with probabilities 1 - p and p, one step. Over all batches of N actions the expectation of an
# estimate is a finite sum, and the gradient of J = (1 - p) R_0 + p R_1 in the logit of p is known.
P, REWARDS, N = 0.3, np.array([2.0, 5.0]), 3
TRUE_GRADIENT = P * (1 - P) * (REWARDS[1] - REWARDS[0])


def expected_gradient(advantage_of):
    """sum over batches of  P(batch) mean_i score(a_i) A_i,  score(a) = a - p."""
    batches = np.array(list(itertools.product([0, 1], repeat=N)))
    rewards = jnp.asarray(REWARDS[batches][:, None, :], jnp.float32)  # [batch, T = 1, N]
    total = 0.0
    for actions, advantage in zip(batches, jax.vmap(advantage_of)(rewards)[:, 0], strict=True):
        probability = np.prod(np.where(actions == 1, P, 1 - P))
        total += probability * np.mean((actions - P) * np.float64(advantage))
    return total


def test_reinforce_is_unbiased():
    assert expected_gradient(lambda reward: reinforce(reward, 0.0).advantage) == pytest.approx(TRUE_GRADIENT, rel=1e-5)


def test_mean_baseline_shrinks_the_expected_gradient_by_one_minus_one_over_n():
    gradient = expected_gradient(lambda reward: less_the_mean(reward, 0.0).advantage)
    assert gradient == pytest.approx((1 - 1 / N) * TRUE_GRADIENT, rel=1e-5)


@pytest.mark.parametrize("value", [-1.0, 0.0, 4.0])
def test_value_baseline_is_unbiased_whatever_the_critic_says(value):
    critic = jnp.full((1, N), value)
    gradient = expected_gradient(lambda reward: reinforce(reward, 0.0, critic).advantage)
    assert gradient == pytest.approx(TRUE_GRADIENT, rel=1e-5)


@pytest.mark.parametrize("shape", [(8,), (5, 3, 2)])
def test_normalized_advantages_have_mean_zero_and_deviation_one(shape):
    normal = np.float64(normalize_advantages(3.0 + 2.0 * np.random.default_rng(0).normal(size=shape).astype("f4")))
    assert normal.shape == shape
    assert normal.mean() == pytest.approx(0.0, abs=1e-5)
    assert normal.std() == pytest.approx(1.0, abs=1e-5)


def test_normalized_advantages_count_each_entry_with_its_weight():
    rng = np.random.default_rng(1)
    advantage = rng.normal(4.0, 3.0, (7, 3)).astype(np.float32)
    weight = (rng.random((7, 3)) < 0.6).astype(np.float32)
    normal = np.float64(normalize_advantages(advantage, weight))
    counted = [normal[at] for at in np.ndindex(7, 3) if weight[at] == 1]
    assert 1 < len(counted) < 21
    assert np.mean(counted) == pytest.approx(0.0, abs=1e-5)
    assert np.std(counted) == pytest.approx(1.0, abs=1e-5)
    assert abs(normal.mean()) > 1e-3  # over all entries it is not 0, so that the masked ones were left out


def test_normalized_advantages_do_not_depend_on_masked_entries():
    advantage = np.random.default_rng(2).normal(size=(7, 3)).astype(np.float32)
    weight = np.ones((7, 3), np.float32)
    weight[4:, 1] = 0.0
    other = np.where(weight == 1, advantage, 100.0)
    left, right = (np.asarray(normalize_advantages(x, weight)) for x in (advantage, other))
    np.testing.assert_array_equal(left[weight == 1], right[weight == 1])


@settings(max_examples=30, deadline=None)
@given(st.floats(0.125, 8, width=32), st.floats(-10, 10, width=32))
def test_normalized_advantages_ignore_scale_and_shift(scale, shift):
    """A shift of 80 deviations costs two digits: 100 * 6e-8 in each entry and in the mean."""
    advantage = np.random.default_rng(3).normal(size=(7, 3)).astype(np.float32)
    expected = np.asarray(normalize_advantages(advantage))
    assert_close(normalize_advantages(scale * advantage + shift), expected, tolerance=5e-5)
    assert_close(normalize_advantages(-scale * advantage + shift), -expected, tolerance=5e-5)


@pytest.mark.parametrize("constant", [0.0, 1.0, -3.0, 1024.0])
def test_constant_batch_of_exact_numbers_is_normalized_to_zero(constant):
    np.testing.assert_array_equal(normalize_advantages(jnp.full((7, 3), constant)), np.zeros((7, 3)))


def test_constant_batch_is_normalized_to_zero():
    """The mean of equal float32 numbers may be one unit in the last place away from them."""
    for constant in np.linspace(-7.7, 7.7, 23):
        np.testing.assert_allclose(normalize_advantages(jnp.full((7, 3), constant)), np.zeros((7, 3)), atol=1e-2)


@pytest.mark.parametrize("wrong", [(3,), (4, 1), (5, 3)])
@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("discount", lambda x, wrong: reinforce(x, wrong)),
        ("discount", lambda x, wrong: reinforce_whole(x, wrong)),
        ("baseline", lambda x, wrong: reinforce(x, 1.0, wrong)),
        ("baseline", lambda x, wrong: reinforce_whole(x, 1.0, wrong)),
        ("value", lambda x, wrong: n_step(x, 1.0, wrong, x, 2)),
        ("next_value", lambda x, wrong: n_step(x, 1.0, x, wrong, 2)),
        ("continues", lambda x, wrong: n_step(x, 1.0, x, x, 2, wrong)),
        ("value", lambda x, wrong: td_zero(x, 1.0, wrong, x)),
        ("next_value", lambda x, wrong: td_zero(x, 1.0, x, wrong)),
        ("value", lambda x, wrong: td_lambda(x, 1.0, wrong, x, 1.0)),
        ("next_value", lambda x, wrong: td_lambda(x, 1.0, x, wrong, 1.0)),
        ("lambda_", lambda x, wrong: td_lambda(x, 1.0, x, x, wrong)),
    ],
)
def test_a_shape_that_would_be_spread_in_silence_raises(name, call, wrong):
    with pytest.raises(ValueError, match=rf"^{name} has shape"):
        call(jnp.ones((4, 3)), jnp.ones(wrong))


@pytest.mark.parametrize("wrong", [(3,), (4, 1)])
@pytest.mark.parametrize("baseline", [batch_mean, time_mean, leave_one_out])
def test_a_weight_that_would_be_spread_in_silence_raises(wrong, baseline):
    with pytest.raises(ValueError, match="weight has shape"):
        baseline(jnp.ones((4, 3)), jnp.ones(wrong))


def test_a_squared_score_that_would_be_spread_in_silence_raises():
    with pytest.raises(ValueError, match="squared_score has shape"):
        optimal(jnp.ones((4, 3)), jnp.ones((4, 1)))


def test_leaving_one_out_needs_another():
    with pytest.raises(ValueError, match="at least 2 trajectories"):
        leave_one_out(jnp.ones((4, 1)))


def test_baselines_by_loops():
    reward, discount, weight = finished_episodes()
    returns = loop_returns(reward * weight, discount)
    score = np.random.default_rng(3).uniform(0.1, 2.0, returns.shape)
    counted = weight == 1
    for i in range(3):
        others = np.delete(returns, i, 1)[np.delete(counted, i, 1)]
        assert_close(leave_one_out(returns.astype("f4"), weight)[:, i], np.full(5, others.mean()))
    for t in range(5):
        at = counted[t]
        mean = returns[t, at].mean() if at.any() else 0.0
        best = np.average(returns[t, at], weights=score[t, at]) if at.any() else 0.0
        assert_close(time_mean(returns.astype("f4"), weight)[t], np.full(3, mean))
        assert_close(optimal(returns.astype("f4"), score.astype("f4"), weight)[t], np.full(3, best))


def test_a_step_that_counts_for_nobody_has_baseline_zero():
    returns, weight = jnp.ones((2, 3)), jnp.array([[1.0] * 3, [0.0] * 3])
    np.testing.assert_array_equal(time_mean(returns, weight), weight)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("n", [1, 3, 10])
def test_n_step_goes_from_td_zero_to_monte_carlo(shape, n):
    """Without cuts; with cuts the returns themselves are tested in test_returns."""
    steps = trajectory(shape)
    found = n_step(*steps[:4], n)
    assert_close(found.target - steps.value, np.asarray(found.advantage))
    if n == 1:
        assert_close(found.advantage, np.asarray(td_zero(*steps[:4]).advantage))


@pytest.mark.parametrize("shape", SHAPES)
def test_whole_return_is_that_of_the_first_step(shape):
    steps = trajectory(shape)
    found = reinforce_whole(steps.reward, steps.discount, 2.0)
    returns = loop_returns(steps.reward, steps.discount)
    assert_close(found.advantage, np.broadcast_to(returns[0] - 2.0, shape))
    assert_close(found.target, returns)
