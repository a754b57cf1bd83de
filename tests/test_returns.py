"""Returns: float64 loops over the equations, identities between them, and what may pass an episode's end."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from jaxpg.returns import discounted_returns, lambda_returns, n_step_returns, td_errors

SHAPES = [(9,), (1, 4), (7, 3), (5, 3, 2)]
few_examples = settings(max_examples=30, deadline=None)


class Trajectory(NamedTuple):
    """Random everything: nothing but the recursion ties one array to another."""

    reward: np.ndarray
    discount: np.ndarray
    value: np.ndarray
    next_value: np.ndarray
    lambda_: np.ndarray
    continues: np.ndarray


def trajectory(shape, seed=0):
    """About a fifth of the steps terminate (discount 0), another fifth are cut (lambda and continues 0)."""
    rng = np.random.default_rng(seed)
    terminated, cut = rng.random(shape) < 0.2, rng.random(shape) < 0.2
    numbers = Trajectory(
        reward=rng.normal(size=shape),
        discount=rng.uniform(0.8, 1.0, shape) * ~terminated,
        value=rng.normal(size=shape),
        next_value=rng.normal(size=shape),
        lambda_=rng.uniform(0.5, 1.0, shape) * ~cut,
        continues=1.0 * ~cut,
    )
    return Trajectory(*(x.astype(np.float32) for x in numbers))


def float64(*xs):
    return [np.asarray(x, np.float64) for x in xs]


def assert_close(actual, expected, scale=1.0):
    """A sum of T < 10 float32 terms is right to about T * 6e-8 of the largest one; `scale` where that one cancels."""
    expected = np.asarray(expected)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-5 * max(scale, np.abs(expected).max()))


def loop_discounted_returns(reward, discount, bootstrap):
    """G_t = r_t + d_t r_{t+1} + d_t d_{t+1} r_{t+2} + ... + d_t ... d_{T-1} bootstrap."""
    reward, discount, bootstrap = float64(reward, discount, bootstrap)
    result = np.zeros_like(reward)
    for t in range(len(reward)):
        factor = np.ones_like(reward[0])
        for k in range(t, len(reward)):
            result[t] += factor * reward[k]
            factor = factor * discount[k]
        result[t] += factor * bootstrap
    return result


def loop_n_step_returns(reward, discount, next_value, n, continues):
    """Walks ahead from t: the value enters after n rewards, at a cut, and at the end of the trajectory."""
    reward, discount, next_value, continues = float64(reward, discount, next_value, continues)
    result = np.zeros_like(reward)
    for index in np.ndindex(*reward.shape):
        t, rest = index[0], index[1:]
        factor = 1.0
        for k in range(t, len(reward)):
            at = (k, *rest)
            result[index] += factor * reward[at]
            factor *= discount[at]
            if k == t + n - 1 or k == len(reward) - 1 or continues[at] == 0:
                result[index] += factor * next_value[at]
                break
    return result


def loop_lambda_returns(reward, discount, next_value, lambda_):
    """G_t = r_t + d_t ((1 - lambda_t) V(s_{t+1}) + lambda_t G_{t+1}), G_T = V(s_T)."""
    reward, discount, next_value, lambda_ = float64(reward, discount, next_value, lambda_)
    result = np.zeros_like(reward)
    following = next_value[-1]
    for t in reversed(range(len(reward))):
        mixed = (1 - lambda_[t]) * next_value[t] + lambda_[t] * following
        result[t] = reward[t] + discount[t] * mixed
        following = result[t]
    return result


@pytest.mark.parametrize("shape", SHAPES)
def test_discounted_returns_are_the_sum_written_out(shape):
    steps = trajectory(shape)
    bootstrap = steps.value[-1]
    expected = loop_discounted_returns(steps.reward, steps.discount, bootstrap)
    assert_close(discounted_returns(steps.reward, steps.discount, bootstrap), expected)


@pytest.mark.parametrize("shape", SHAPES)
def test_td_errors_are_the_equation_step_by_step(shape):
    steps = trajectory(shape)
    expected = np.zeros(shape)
    for at in np.ndindex(*shape):
        r, d, v, next_v = (float(x[at]) for x in (steps.reward, steps.discount, steps.value, steps.next_value))
        expected[at] = r + d * next_v - v
    assert_close(td_errors(steps.reward, steps.discount, steps.value, steps.next_value), expected)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("n", [1, 2, 3, 100])
def test_n_step_returns_are_n_rewards_then_the_value(shape, n):
    steps = trajectory(shape)
    expected = loop_n_step_returns(steps.reward, steps.discount, steps.next_value, n, steps.continues)
    assert_close(n_step_returns(steps.reward, steps.discount, steps.next_value, n, steps.continues), expected)


@pytest.mark.parametrize("shape", SHAPES)
def test_lambda_returns_are_the_recursion(shape):
    steps = trajectory(shape)
    expected = loop_lambda_returns(steps.reward, steps.discount, steps.next_value, steps.lambda_)
    assert_close(lambda_returns(steps.reward, steps.discount, steps.next_value, steps.lambda_), expected)


jitted_lambda_returns = jax.jit(lambda_returns)
jitted_n_step_returns = jax.jit(n_step_returns, static_argnames="n")
numbers = arrays(np.float32, (6, 2), elements=st.floats(-10, 10, width=32))
fractions = arrays(np.float32, (6, 2), elements=st.sampled_from([0.0, 0.25, 0.5, 0.875, 1.0]))


@few_examples
@given(numbers, fractions, numbers, fractions)
def test_lambda_returns_are_the_recursion_for_any_numbers(reward, discount, next_value, lambda_):
    expected = loop_lambda_returns(reward, discount, next_value, lambda_)
    assert_close(jitted_lambda_returns(reward, discount, next_value, lambda_), expected)


@few_examples
@given(numbers, fractions, numbers, fractions)
def test_lambda_is_the_probability_of_going_on(reward, discount, next_value, lambda_):
    """n_step_returns with c = lambda and n >= T is the same equation."""
    expected = jitted_n_step_returns(reward, discount, next_value, n=6, continues=lambda_)
    assert_close(jitted_lambda_returns(reward, discount, next_value, lambda_), expected)


@few_examples
@given(numbers, fractions, numbers, fractions, st.floats(-2, 2, width=32))
def test_lambda_returns_are_linear_in_rewards_and_values(reward, discount, next_value, lambda_, factor):
    whole = jitted_lambda_returns(reward + factor * next_value, discount, next_value + factor * reward, lambda_)
    parts = [jitted_lambda_returns(x, discount, y, lambda_) for x, y in [(reward, next_value), (next_value, reward)]]
    assert_close(whole, np.float64(parts[0]) + factor * np.float64(parts[1]), scale=30.0)


@pytest.mark.parametrize("shape", [(9,), (5, 3, 2)])
def test_scalars_stand_for_constant_arrays(shape):
    steps = trajectory(shape)
    reward, next_value = steps.reward, steps.next_value
    discount, half, one = (np.full(shape, x, np.float32) for x in (0.9, 0.5, 1.0))
    pairs = [
        (discounted_returns(reward, 0.9, 2.0), discounted_returns(reward, discount, np.full(shape[1:], 2.0))),
        (td_errors(reward, 0.9, steps.value, next_value), td_errors(reward, discount, steps.value, next_value)),
        (n_step_returns(reward, 0.9, next_value, 3), n_step_returns(reward, discount, next_value, 3, one)),
        (lambda_returns(reward, 0.9, next_value, 0.5), lambda_returns(reward, discount, next_value, half)),
    ]
    for with_scalars, with_arrays in pairs:
        assert with_scalars.shape == shape
        np.testing.assert_array_equal(with_scalars, with_arrays)


ALL = {
    "discounted": lambda steps: discounted_returns(steps.reward, steps.discount, steps.next_value[-1]),
    "td": lambda steps: td_errors(steps.reward, steps.discount, steps.value, steps.next_value),
    "n_step": lambda steps: n_step_returns(steps.reward, steps.discount, steps.next_value, 4, steps.continues),
    "lambda": lambda steps: lambda_returns(steps.reward, steps.discount, steps.next_value, steps.lambda_),
}
SUMS = [ALL["discounted"], ALL["n_step"], ALL["lambda"]]
BOOTSTRAPPED = [ALL["n_step"], ALL["lambda"]]
END = 2  # the step that ends the first of two episodes, in the tests that follow


def two_episodes(**end):
    """One trajectory of 7 steps whose step END is given by hand and whose other steps neither end nor cut."""
    shape = (7, 3)
    rng = np.random.default_rng(1)
    steps = trajectory(shape)._replace(discount=np.full(shape, 0.9), lambda_=np.full(shape, 0.8))
    steps = steps._replace(continues=np.ones(shape), reward=rng.normal(size=shape))
    for name, number in end.items():
        getattr(steps, name)[END] = number
    return Trajectory(*(x.astype(np.float32) for x in steps))


def perturbed(steps, rewards_from, values_from):
    """Other rewards and next values from these steps on."""
    reward, next_value = steps.reward.copy(), steps.next_value.copy()
    reward[rewards_from:] += 100.0
    next_value[values_from:] += 100.0
    return steps._replace(reward=reward, next_value=next_value)


@pytest.mark.parametrize("function", SUMS)
def test_nothing_passes_a_termination_not_even_the_value_there(function):
    steps = two_episodes(discount=0.0)
    after = perturbed(steps, rewards_from=END + 1, values_from=END)
    np.testing.assert_array_equal(function(after)[: END + 1], function(steps)[: END + 1])


@pytest.mark.parametrize("function", SUMS)
def test_without_a_termination_what_follows_does_pass(function):
    """The control of the test above: the same perturbation is seen when the step does not terminate."""
    steps = two_episodes()
    after = perturbed(steps, rewards_from=END + 1, values_from=END)
    assert np.all(np.abs(function(after)[: END + 1] - function(steps)[: END + 1]) > 1.0)


@pytest.mark.parametrize("function", BOOTSTRAPPED)
def test_nothing_after_a_time_limit_passes_it(function):
    steps = two_episodes(lambda_=0.0, continues=0.0)
    after = perturbed(steps, rewards_from=END + 1, values_from=END + 1)
    np.testing.assert_array_equal(function(after)[: END + 1], function(steps)[: END + 1])


@pytest.mark.parametrize("function", BOOTSTRAPPED)
def test_a_time_limit_bootstraps_from_the_next_value_there(function):
    steps = two_episodes(lambda_=0.0, continues=0.0)
    assert_close(function(steps)[END], steps.reward[END] + steps.discount[END] * steps.next_value[END])


@pytest.mark.parametrize("function", BOOTSTRAPPED)
def test_the_end_of_the_trajectory_bootstraps_from_the_last_next_value(function):
    steps = two_episodes()
    assert_close(function(steps)[-1], steps.reward[-1] + steps.discount[-1] * steps.next_value[-1])


@pytest.mark.parametrize("shape", SHAPES)
def test_lambda_zero_and_one_step_are_the_td_target(shape):
    steps = trajectory(shape)
    target = td_errors(steps.reward, steps.discount, steps.value, steps.next_value) + steps.value
    assert_close(lambda_returns(steps.reward, steps.discount, steps.next_value, 0.0), target)
    assert_close(n_step_returns(steps.reward, steps.discount, steps.next_value, 1), target)


@pytest.mark.parametrize("shape", [(1, 4), (7, 3)])
def test_lambda_one_and_all_steps_are_monte_carlo_with_a_bootstrap(shape):
    steps = trajectory(shape)
    expected = discounted_returns(steps.reward, steps.discount, steps.next_value[-1])
    assert_close(lambda_returns(steps.reward, steps.discount, steps.next_value, 1.0), expected)
    for n in (shape[0], shape[0] + 1, 50):
        assert_close(n_step_returns(steps.reward, steps.discount, steps.next_value, n), expected)


@pytest.mark.parametrize("lambda_", [0.0, 0.3, 0.95, 1.0])
def test_lambda_return_is_the_weighted_mean_of_the_n_step_returns(lambda_):
    """(1 - lambda) lambda^(n-1) for each n that ends inside the trajectory, the rest for the longest one."""
    steps, length = trajectory((7, 3)), 7
    by_n = [n_step_returns(steps.reward, steps.discount, steps.next_value, n) for n in range(1, length + 1)]
    expected = np.zeros((7, 3))
    for t in range(length):
        longest = length - t
        for n in range(1, longest):
            expected[t] += (1 - lambda_) * lambda_ ** (n - 1) * np.asarray(by_n[n - 1][t])
        expected[t] += lambda_ ** (longest - 1) * np.asarray(by_n[longest - 1][t])
    assert_close(lambda_returns(steps.reward, steps.discount, steps.next_value, lambda_), expected)


def test_td_errors_of_the_true_value_are_zero():
    """V = G satisfies Bellman's equation at every step."""
    steps = trajectory((7, 3))
    value = discounted_returns(steps.reward, steps.discount, 3.0)
    next_value = jnp.concatenate([value[1:], jnp.full((1, 3), 3.0)])
    assert_close(td_errors(steps.reward, steps.discount, value, next_value), np.zeros((7, 3)))


def test_td_errors_telescope_to_the_return_minus_the_value():
    """With V(s_{t+1}) the value of the following step: the discounted sum of delta is G - V, for any V."""
    steps = trajectory((7, 3))
    next_value = np.concatenate([steps.value[1:], steps.next_value[-1:]])
    errors = td_errors(steps.reward, steps.discount, steps.value, next_value)
    expected = loop_discounted_returns(steps.reward, steps.discount, next_value[-1]) - steps.value
    assert_close(discounted_returns(errors, steps.discount, 0.0), expected)


@pytest.mark.parametrize("lambda_", [0.0, 0.5, 1.0])
def test_constant_reward_keeps_its_value_whatever_lambda(lambda_):
    """V = 1 / (1 - gamma) is the fixed point."""
    value = jnp.full((5, 2), 10.0)
    assert_close(lambda_returns(jnp.ones((5, 2)), 0.9, value, lambda_), value)
    assert_close(n_step_returns(jnp.ones((5, 2)), 0.9, value, 3), value)


def test_the_return_is_differentiable_and_a_reward_counts_with_the_discounts_before_it():
    """dG_0 / dr_k = d_0 d_1 ... d_{k-1}."""
    steps = trajectory((6,), seed=3)._replace(discount=np.float32([0.9, 0.8, 0.7, 0.6, 0.5, 0.4]))
    slope = jax.grad(lambda reward: discounted_returns(reward, steps.discount, 0.0)[0])(steps.reward)
    expected = [float(np.prod(np.float64(steps.discount[:k]))) for k in range(6)]
    assert_close(slope, expected)


@pytest.mark.parametrize("function", ALL.values(), ids=ALL)
def test_jit_changes_nothing(function):
    steps = trajectory((7, 3))
    assert_close(jax.jit(function)(steps), function(steps))


@pytest.mark.parametrize("function", ALL.values(), ids=ALL)
def test_batch_entries_are_independent_trajectories(function):
    """A batch, a vmap over the batch axis, and one entry at a time are the same."""
    steps = trajectory((7, 3))
    together = function(steps)
    assert_close(jax.vmap(function, in_axes=1, out_axes=1)(steps), together)
    assert_close(function(Trajectory(*(x[:, 1] for x in steps))), together[:, 1])


X = jnp.ones((4, 3))


@pytest.mark.parametrize("wrong", [np.ones(3), np.ones((4, 1)), np.ones((5, 3))], ids=["[N]", "[T,1]", "[T+1,N]"])
@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("discount", lambda wrong: discounted_returns(X, wrong, 0.0)),
        ("bootstrap", lambda wrong: discounted_returns(X, 1.0, np.ones((4, *wrong.shape)))),
        ("discount", lambda wrong: td_errors(X, wrong, X, X)),
        ("value", lambda wrong: td_errors(X, 1.0, wrong, X)),
        ("next_value", lambda wrong: td_errors(X, 1.0, X, wrong)),
        ("discount", lambda wrong: n_step_returns(X, wrong, X, 2)),
        ("next_value", lambda wrong: n_step_returns(X, 1.0, wrong, 2)),
        ("continues", lambda wrong: n_step_returns(X, 1.0, X, 2, wrong)),
        ("discount", lambda wrong: lambda_returns(X, wrong, X, 1.0)),
        ("next_value", lambda wrong: lambda_returns(X, 1.0, wrong, 1.0)),
        ("lambda_", lambda wrong: lambda_returns(X, 1.0, X, wrong)),
    ],
)
def test_a_shape_that_would_be_spread_in_silence_raises(name, call, wrong):
    with pytest.raises(ValueError, match=rf"^{name} has shape"):
        call(jnp.asarray(wrong))


@pytest.mark.parametrize("n", [0, -1])
def test_fewer_than_one_step_raises(n):
    with pytest.raises(ValueError, match=f"^n must be at least 1, got {n}"):
        n_step_returns(jnp.ones(3), 1.0, jnp.ones(3), n)
