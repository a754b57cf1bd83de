"""Indices and orders that depend on the data: what jax makes of them, bit by bit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax

from envs.physics import scalarize
from envs.physics.interpreter import trace
from envs.physics.numeric import evaluate
from envs.physics.rules.sorting import list_exchanges

BATCH = 200  # more than a tile
EXAMPLES = settings(deadline=None, max_examples=8)


def check(fn, *arguments):
    """The equations give the same numbers, for every environment of a batch."""
    program = trace(fn, *(x[0] for x in arguments))
    theirs = jax.tree.leaves(jax.jit(jax.vmap(fn))(*arguments))
    for mine, true, result in zip(evaluate(program, arguments), theirs, program.results, strict=True):
        assert result.dtype == true.dtype
        np.testing.assert_array_equal(mine, true)


def numbers(seed, *shape):
    """Whole numbers, so that sums are exact and many are equal."""
    return np.random.default_rng(seed).integers(-4, 5, (BATCH, *shape)).astype(np.float32)


def indices(seed, *shape, limit=7):
    """Also negative ones and such as lie outside."""
    return np.random.default_rng(seed).integers(-limit, limit + 1, (BATCH, *shape), np.int32)


SEEDS = st.integers(0, 2**16)
SHAPES = st.tuples(st.integers(1, 4), st.integers(1, 5))
MODES = st.sampled_from(["clip", "fill", "promise_in_bounds", None])
WHERE = st.sampled_from(
    [
        lambda i: (i[0],),
        lambda i: (slice(None), i[0]),
        lambda i: (i[0], i[1]),
        lambda i: (i,),
        lambda i: (i, i[::-1]),
        lambda i: (i[:, None], i),
        lambda i: (0, i),
        lambda i: (i[0], slice(None, None, 2)),
    ]
)


@EXAMPLES
@given(SEEDS, SHAPES, WHERE, MODES, st.none() | st.just(7.0))
def test_reading(seed, shape, where, mode, fill_value):
    if mode == "promise_in_bounds":
        limit, fill_value = 0, None  # otherwise jax gives no promise
    else:
        limit = 7
    fill_value = fill_value if mode == "fill" else None

    def fn(x, i):
        return x.at[where(i)].get(mode=mode, fill_value=fill_value)

    check(fn, numbers(seed, *shape), indices(seed, 2, limit=limit))


WRITES = {
    "set": lambda at, value, mode: at.set(value[0, 0], mode=mode),
    "add": lambda at, value, mode: at.add(value[0, 0], mode=mode),
    "multiply": lambda at, value, mode: at.multiply(value[0, 0], mode=mode),
    "min": lambda at, value, mode: at.min(value[0, 0], mode=mode),
    "max": lambda at, value, mode: at.max(value[0, 0], mode=mode),
}


@EXAMPLES
@given(SEEDS, SHAPES, WHERE, st.sampled_from(["clip", "drop", None]), st.sampled_from(list(WRITES)))
def test_writing(seed, shape, where, mode, name):
    def fn(x, i):
        return WRITES[name](x.at[where(i)], 0.5 * x, mode)

    check(fn, numbers(seed, *shape), indices(seed, 2))


@EXAMPLES
@given(SEEDS, SHAPES, st.data())
def test_slices(seed, shape, data):
    sizes = [data.draw(st.integers(1, size)) for size in shape]
    is_known = data.draw(st.booleans())

    def fn(x, i):
        start = (1 if is_known else i[0], i[1])
        part = lax.dynamic_slice(x, start, sizes)
        return part, lax.dynamic_update_slice(x, 2 * part, (i[1], start[0]))

    check(fn, numbers(seed, *shape), indices(seed, 2))


@EXAMPLES
@given(SEEDS, st.integers(1, 12), st.integers(1, 3), st.integers(0, 2), st.booleans())
def test_sorts(seed, size, num_keys, num_values, has_nan):
    """By several keys; rows with equal keys keep their order."""
    x = numbers(seed, num_keys, size)
    x = np.where(x == 3, np.nan, np.where(x == 2, np.inf, x)).astype(np.float32) if has_nan else x

    def fn(x):
        operands = (*x, *(jnp.arange(size) + i for i in range(num_values)))
        return lax.sort(operands, num_keys=num_keys)

    check(fn, x)


@EXAMPLES
@given(SEEDS, SHAPES, st.data())
def test_orders(seed, shape, data):
    axis = data.draw(st.integers(0, 1))
    k = data.draw(st.integers(0, shape[axis]))

    def fn(x):
        return jnp.argsort(x, axis), lax.top_k(x, k, axis=axis), jnp.sort(x > 0, axis), jnp.argmax(x, axis)

    check(fn, numbers(seed, *shape))


def test_an_order_of_many():
    """Also compiled."""
    x = np.random.default_rng(0).normal(size=(BATCH, 33)).astype(np.float32)
    check(jnp.sort, x)
    np.testing.assert_array_equal(jax.jit(jax.vmap(scalarize(jnp.sort, x[0])))(x), np.sort(x))


@pytest.mark.parametrize("size", range(11))
def test_a_network_sorts(size):
    """Every sequence of 0 and 1, and hence every sequence."""
    for number in range(2**size):
        bits = [number >> place & 1 for place in range(size)]
        for i, j in list_exchanges(size):
            bits[i], bits[j] = sorted((bits[i], bits[j]))
        assert bits == sorted(bits)


@EXAMPLES
@given(SEEDS, SHAPES)
def test_derivatives(seed, shape):
    """Of what an index or an order selects."""

    def fn(x, i):
        ordered = lax.sort((x[:, 0], 2 * x[:, -1]), num_keys=1)
        return jnp.sum(x.at[i[0]].add(x[0]) ** 2) + x[i[0] % shape[0], i[1] % shape[1]] + ordered[0] @ ordered[1]

    x = numbers(seed, *shape) + 0.01 * np.arange(shape[0], dtype=np.float32)[:, None]
    i = indices(seed, 2)
    ours, theirs = (jax.jit(jax.vmap(jax.grad(f)))(x, i) for f in (scalarize(fn, x[0], i[0]), fn))
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5)


def test_equal_elements_need_no_select():
    table = np.asarray([1.0, 1.0, 1.0, 1.0, 2.0, 2.0, 2.0])
    program = trace(lambda i: lax.dynamic_slice(table, (i,), (1,)), jnp.asarray(1))
    assert [x.op for x in program.equations()] == ["lt", "add", "select_n", "ge", "select_n"]  # -1 is the last one
