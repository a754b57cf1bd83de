"""Programs evaluated by NumPy, as the check of models does: what jax computes from the same equations, in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax

from envs.physics.interpreter import trace
from envs.physics.numeric import evaluate


def collatz(x, y):
    """Rounds that differ between environments, one loop in another, and constants in the carry."""

    def halve(state):
        n, total, fixed = state
        inner = lax.while_loop(lambda s: s[0] > 1.0, lambda s: (s[0] - y[0] ** 2 - 0.5, s[1] + 1), (n, 0.0))
        return jnp.floor(n / 2), total + inner[1] + fixed[1], fixed

    n, total, fixed = lax.while_loop(lambda s: s[0] > 1.0, halve, (x, 0.0, jnp.array([0.0, 3.0])))
    return jnp.stack([n, total]), fixed, jnp.zeros(0)


def smooth(x, y):
    return jnp.outer(jnp.sin(y) * x, jnp.exp(-(y**2))), jnp.where(x > 2, x, -x), jnp.argmax(y)


@pytest.mark.parametrize("function", [collatz, smooth])
@settings(deadline=None, max_examples=10)
@given(st.lists(st.floats(-3, 40), min_size=1, max_size=5), st.integers(0, 100))
def test_it_is_what_jax_computes(function, xs, seed):
    x, y = np.array(xs), np.random.default_rng(seed).normal(size=(len(xs), 3))
    with jax.enable_x64(True):
        true = jax.vmap(function)(jnp.asarray(x), jnp.asarray(y))
        ours = evaluate(trace(function, jnp.zeros(()), jnp.zeros(3)), [x, y])
    for mine, wanted in zip(ours, true, strict=True):
        np.testing.assert_allclose(mine, wanted, rtol=1e-12, atol=1e-12)


def test_an_environment_does_not_depend_on_the_others():
    with jax.enable_x64(True):
        program = trace(collatz, jnp.zeros(()), jnp.zeros(3))
    x, y = np.array([3.0, 33.0, np.nan]), np.ones((3, 3))
    together = evaluate(program, [x, y])
    for i in range(3):
        for all_of_them, alone in zip(together, evaluate(program, [x[i : i + 1], y[:1]]), strict=True):
            np.testing.assert_array_equal(all_of_them[i], alone[0])
