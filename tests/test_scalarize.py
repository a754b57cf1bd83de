"""Scalar equations compute what the function they were made of computes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax

import envs
from envs.physics import UnsupportedPrimitiveError, scalarize
from envs.physics.interpreter import CONTROL, trace
from envs.physics.rules import RULES
from envs.physics.trigonometry import sincos

A = jnp.asarray(np.random.default_rng(0).normal(size=(3, 3)), jnp.float32)
V = jnp.asarray([0.3, -1.7, 0.9], jnp.float32)
W = jnp.asarray([2.5, 0.4, -0.6], jnp.float32)
SPD = A @ A.T + 3 * jnp.eye(3)
LOWER = jnp.tril(A) + 3 * jnp.eye(3)
INT = jnp.asarray([5, -3, 7], jnp.int32)
BOOL = jnp.asarray([True, False, True])


def unary(f, x=V):
    return f, (x,)


def square_with_own_gradient():
    square = jax.custom_vjp(lambda x: x * x)
    square.defvjp(lambda x: (x * x, x), lambda x, g: (2 * x * g,))
    return square


# For each primitive functions with arguments; a function may use others besides.
CASES = {
    "add": [(lax.add, (V, W)), (lambda x: x + 1.5, (V,)), (lambda x: (2.0 + x) + (1.0 - x), (V,))],
    "add_any": [unary(jax.grad(lambda x: jnp.sum(x * x * jnp.sin(x))))],
    "stop_gradient": [
        unary(lambda x: x * lax.stop_gradient(x)),
        unary(lambda x: lax.stop_gradient(lax.stop_gradient(x))),
        unary(lambda x: lax.stop_gradient(0.0 * x)),
    ],
    "sub": [(lax.sub, (V, W)), (lambda x: 1.5 - x, (V,)), (lambda x: x - x, (V,)), (lambda x, y: -x - y, (V, W))],
    "mul": [(lax.mul, (V, W)), (lambda x: 0.0 * x, (V,)), (lambda x: -3.0 * (x * -2.0), (V,)), (lambda x: x * x, (V,))],
    "div": [(lax.div, (V, W)), (lambda x: 2.0 / (3.0 / x), (V,)), (lambda x: x / 4.0, (V,)), (lax.div, (INT, INT + 1))],
    "rem": [(lax.rem, (V, W)), (lax.rem, (INT, INT - 1))],
    "neg": [unary(lax.neg), (lambda x, y: -(x - y), (V, W)), (lambda x: -(2.0 + x), (V,))],
    "abs": [unary(lax.abs)],
    "sign": [unary(lax.sign)],
    "floor": [unary(lax.floor)],
    "ceil": [unary(lax.ceil)],
    "round": [unary(jnp.round, V * 10), unary(lambda x: lax.round(x, lax.RoundingMethod.AWAY_FROM_ZERO), V * 10)],
    "max": [(lax.max, (V, W)), (lambda x: jnp.maximum(x, -jnp.inf), (V,)), (lambda x: jnp.maximum(x, 0.5), (V,))],
    "min": [(lax.min, (V, W)), (lambda x: jnp.minimum(x, jnp.inf), (V,))],
    "clamp": [(lambda x: lax.clamp(-0.5, x, 0.5), (V,)), (lax.clamp, (W - 3, V, W))],
    "pow": [(lax.pow, (jnp.abs(V), W)), (lambda x: x ** jnp.float32(2), (V,)), (lambda x: x ** jnp.float32(-3), (V,))],
    "integer_pow": [
        unary(lambda x: x**3),
        unary(lambda x: x**-2),
        unary(lambda x: x**4),
        unary(lambda x: (1e-30 * x) ** -16),
    ],
    "square": [unary(jnp.square)],
    "sqrt": [unary(lax.sqrt, jnp.abs(V))],
    "rsqrt": [unary(lax.rsqrt, jnp.abs(V))],
    "cbrt": [unary(lax.cbrt)],
    "exp": [unary(lax.exp)],
    "exp2": [unary(lax.exp2)],
    "log": [unary(lax.log, jnp.abs(V))],
    "expm1": [unary(lax.expm1)],
    "log1p": [unary(lax.log1p, jnp.abs(V))],
    "sin": [unary(lax.sin), unary(lambda x: jnp.sin(-2.0 * x)), (lambda x, y: jnp.sin(x) * jnp.cos(y), (V, W))],
    "cos": [
        unary(lambda x: jnp.cos(x) ** 2 + jnp.sin(x) ** 2),
        unary(lambda x: jnp.cos(x) ** 2 - jnp.sin(x) ** 2),
        unary(lambda x: jnp.cos(x) * jnp.sin(x)),
        (lambda x, y: jnp.cos(x) * jnp.cos(y) + jnp.sin(x) * jnp.sin(y), (V, W)),
        (lambda x, y: jnp.cos(x) * jnp.cos(y) - jnp.sin(x) * jnp.sin(y), (V, W)),
        (lambda x, y: jnp.sin(x) * jnp.sin(y) - jnp.cos(x) * jnp.cos(y), (V, W)),
        (lambda x, y: jnp.sin(x) * jnp.cos(y) + jnp.cos(x) * jnp.sin(y), (V, W)),
        (lambda x, y: jnp.sin(x) * jnp.cos(y) - jnp.cos(x) * jnp.sin(y), (V, W)),
        (lambda x, y: jnp.cos(x) * jnp.sin(y) - jnp.cos(y) * jnp.sin(x), (V, W)),
        (lambda x, y: jnp.cos(x) * jnp.sin(x) + jnp.cos(y) * jnp.sin(x), (V, W)),
    ],
    "tan": [unary(lax.tan)],
    "asin": [unary(lax.asin, V / 2)],
    "acos": [unary(lax.acos, V / 2)],
    "atan": [unary(lax.atan)],
    "atan2": [(lax.atan2, (V, W))],
    "sinh": [unary(lax.sinh)],
    "cosh": [unary(lax.cosh)],
    "tanh": [unary(lax.tanh)],
    "logistic": [unary(lax.logistic)],
    "is_finite": [unary(lax.is_finite, jnp.asarray([1.0, jnp.inf, jnp.nan]))],
    "eq": [(lax.eq, (INT, jnp.asarray([5, 3, 7])))],
    "ne": [(lax.ne, (INT, jnp.asarray([5, 3, 7])))],
    "lt": [(lax.lt, (V, W))],
    "le": [(lax.le, (V, V))],
    "gt": [(lax.gt, (V, W))],
    "ge": [(lax.ge, (V, V))],
    "and": [
        (lambda x, y: (x > 0) & (y > 0), (V, W)),
        (lax.bitwise_and, (INT, INT + 1)),
        (lambda x: (x > 0) & True, (V,)),
    ],
    "or": [
        (lambda x, y: (x > 0) | (y > 0), (V, W)),
        (lax.bitwise_or, (INT, INT + 1)),
        (lambda x: (x > 0) | False, (V,)),
    ],
    "xor": [(lax.bitwise_xor, (INT, INT + 1)), (lax.bitwise_xor, (BOOL, ~BOOL))],
    "not": [(lambda x: ~(x > 0), (V,)), (lax.bitwise_not, (INT,))],
    "nextafter": [(lax.nextafter, (V, W))],
    "select_n": [
        (lambda x, y: jnp.where(x > 0, x, y), (V, W)),
        (lambda x: jnp.where(x > 0, 2.0, 3.0), (V,)),
        (lambda x, y: jnp.where(~(x > 0), x, y), (V, W)),
        (lambda x: jnp.where(~(x > 0), 2.0, 3.0), (V,)),
        (lambda x, y: jnp.where(np.array([True, False, True]), x, y), (V, W)),
        (lambda i, x, y: lax.select_n(i, x, y, x + y, x - y), (jnp.asarray([0, 3, 2]), V, W)),
    ],
    "convert_element_type": [unary(lambda x: x.astype(jnp.int32), V * 5), (lambda x: (x > 0) * 2.5, (V,))],
    "copy": [unary(jnp.copy)],
    "optimization_barrier": [unary(lax.optimization_barrier)],
    "broadcast_in_dim": [unary(lambda x: lax.broadcast_in_dim(x, (2, 3, 4), (1,)))],
    "reshape": [unary(lambda x: x.reshape(9), A)],
    "squeeze": [unary(lambda x: lax.squeeze(x[None], (0,)))],
    "transpose": [unary(lambda x: x.T, A)],
    "rev": [unary(lambda x: lax.rev(x, (0,)), A)],
    "slice": [unary(lambda x: lax.slice(x, (0, 1), (3, 3), (2, 1)), A)],
    "concatenate": [(lambda x, y: jnp.concatenate([x, np.ones(2, np.float32), y]), (V, W))],
    "stack": [(lambda x, y: jnp.stack([x, np.ones(3, np.float32), y], 1), (V, W))],
    "unstack": [unary(lambda x: jnp.unstack(x), A), unary(lambda x: jnp.unstack(x, axis=1), A)],
    "empty": [unary(lambda x: lax.empty((2, 3), jnp.float32).at[0].set(x).at[1].set(-x))],
    "tile": [unary(lambda x: jnp.tile(x, (2, 2)))],
    "split": [unary(lambda x: jnp.split(x, [1, 2], axis=1), A)],
    "pad": [unary(lambda x: lax.pad(x, np.float32(7), ((1, 2, 1),)))],
    "iota": [unary(lambda x: x * jnp.arange(3) + lax.broadcasted_iota(jnp.float32, (3, 3), 1))],
    "platform_index": [unary(lambda x: lax.platform_dependent(x, cpu=jnp.sin, default=jnp.sin))],
    "dynamic_slice": [
        (lambda x, i: lax.dynamic_slice(x, (i, 1), (2, 2)), (A, 1)),
        (lambda x, i: lax.dynamic_slice(x, (i, 1), (2, 2)), (A, 7)),
        (lambda x: lax.dynamic_slice(x, (1, -4), (2, 2)), (A,)),
        (lambda x, i: x[i], (V, 2)),
        (lambda x, i: lax.dynamic_slice(x, (i, i - 4), (1, 2)), (A, 2)),
    ],
    "dynamic_update_slice": [
        (lambda x, y: lax.dynamic_update_slice(x, y[None], (1, 2)), (A, V[:2])),
        (lambda x, y, i: lax.dynamic_update_slice(x, y[None], (i, i)), (A, V[:2], 1)),
        (lambda x, y, i: lax.dynamic_update_slice(x, y[None], (0, i)), (A, V[:2], 7)),
    ],
    "gather": [
        unary(lambda x: x[np.array([2, 0, 0])], A),
        unary(lambda x: x[np.array([2, 0]), np.array([1, 1])], A),
        unary(lambda x: x.at[np.array([2, 5])].get(mode="fill", fill_value=4.0)),
        unary(lambda x: x.at[np.array([2, 5])].get(mode="fill")),
        unary(lambda x: x.at[np.array([2, 5])].get(mode="clip")),
        unary(lambda x: jax.vmap(lambda row, i: row[i])(x, np.array([2, 0, 1])), A),
        unary(lambda x: x[:, np.array([[0, 1], [2, 2]])], A),
        (lambda x, i: x[i], (A, INT)),
        (lambda x, i: x[i, i[::-1]], (A, INT - 4)),
        (lambda x, i: x.at[i].get(mode="fill"), (V, INT)),
        (lambda x, i: x.at[:, i].get(mode="fill", fill_value=4.0), (A, INT)),
        (lambda x, i: x.at[i].get(mode="clip"), (V, INT)),
        (lambda x, i: jax.vmap(lambda row, j: row[j])(x, i), (A, INT)),
        (lambda i: jnp.arange(7).astype(jnp.uint8).at[i].get(mode="fill"), (INT,)),
        (lambda i: (jnp.arange(7) > 2).at[i].get(mode="fill"), (INT,)),
    ],
    "scatter": [
        (lambda x, y: x.at[np.array([2, 0])].set(y[:2]), (V, W)),
        (lambda x, y: x.at[:, 1].set(y), (A, W)),
        (lambda x: x.at[np.array([2, 5])].set(1.0, mode="drop"), (V,)),
        (lambda x: x.at[np.array([0, 5])].set(1.0, mode="clip"), (V,)),
        (lambda x, i: x.at[i].set(1.0), (V, INT)),
        (lambda x, y, i: x.at[:, i].set(y, mode="clip"), (A, W, INT)),
        (lambda x, y, i: x.at[i, i[::-1]].set(y), (A, W, INT - 5)),
        (lambda x, i, y: jax.vmap(lambda row, j, z: row.at[j].set(z))(x, i, y), (A, INT - 5, W)),
    ],
    "scatter-add": [
        (lambda x, y: x.at[np.array([2, 0, 2])].add(y), (V, W)),
        (lambda x, y: jax.vmap(lambda row, i, z: row.at[i].add(z))(x, np.array([2, 0, 1]), y), (A, W)),
        (lambda x, y, i: x.at[i].add(y), (V, W, jnp.asarray([2, 0, 2]))),
    ],
    "scatter-sub": [(lambda x, y: x.at[np.array([2, 0])].subtract(y[:2]), (V, W))],
    "scatter-mul": [(lambda x, y: x.at[np.array([2, 0])].multiply(y[:2]), (V, W))],
    "scatter-min": [(lambda x, y: x.at[np.array([2, 0])].min(y[:2]), (V, W))],
    "scatter-max": [(lambda x, y: x.at[np.array([2, 0])].max(y[:2]), (V, W))],
    "reduce_sum": [
        unary(lambda x: x.sum(1), A),
        unary(jnp.sum, A),
        unary(lambda x: x.sum(0) + x[:0].sum(0), A),
    ],
    "reduce_prod": [unary(lambda x: x.prod(0), A)],
    "reduce_max": [unary(lambda x: x.max(1), A)],
    "reduce_min": [unary(jnp.min, A)],
    "reduce_and": [unary(lambda x: (x > -1).all(0), A)],
    "reduce_or": [unary(lambda x: (x > 1).any(0), A)],
    "cumsum": [unary(lambda x: jnp.cumsum(x, 1), A), unary(lambda x: lax.cumsum(x, 0, reverse=True), A)],
    "cumprod": [unary(lambda x: jnp.cumprod(x))],
    "cummax": [unary(lambda x: lax.cummax(x))],
    "cummin": [unary(lambda x: lax.cummin(x))],
    "argmin": [unary(lambda x: jnp.argmin(x, 1), A), unary(jnp.argmin, jnp.asarray([1.0, jnp.nan, -2.0]))],
    "argmax": [unary(lambda x: jnp.argmax(x, 0), A), unary(jnp.argmax, jnp.asarray([1.0, 1.0, jnp.inf]))],
    "sort": [
        unary(lambda x: x * jnp.sort(np.array([3.0, 1.0, 2.0], np.float32))),
        unary(jnp.sort),
        unary(lambda x: jnp.sort(x, 0), A),
        unary(jnp.sort, jnp.asarray([jnp.nan, 1.0, jnp.inf, jnp.nan, -jnp.inf])),
        unary(jnp.argsort, jnp.asarray([2.0, 1.0, 2.0, 1.0, 2.0])),
        (lambda x, y: lax.sort((x > 0, y, x), num_keys=2), (V, W)),
    ],
    "top_k": [
        unary(lambda x: lax.top_k(x, 2)),
        unary(lambda x: lax.top_k(x, 3), jnp.asarray([1.0, jnp.nan, 2.0, 1.0, 2.0])),
        unary(lambda x: lax.top_k(x, 2, axis=0), A),
    ],
    "dot_general": [
        (lambda x, y: x @ y, (A, A.T)),
        (jnp.dot, (V, W)),
        (lambda x, y: jnp.einsum("bij,bjk->bki", x, y), (jnp.stack([A, SPD]), jnp.stack([SPD, A]))),
        (lambda x: np.eye(3, dtype=np.float32) @ x @ np.ones((3, 1), np.float32), (A,)),
    ],
    "cholesky": [unary(jnp.linalg.cholesky, SPD), unary(jax.vmap(jnp.linalg.cholesky), jnp.stack([SPD, 2 * SPD]))],
    "triangular_solve": [
        (
            lambda a, b, kw=kw: lax.linalg.triangular_solve(a, b, **kw),
            (LOWER.T if not kw["lower"] else LOWER, A),
        )
        for kw in (
            {"left_side": left, "lower": lower, "transpose_a": transpose, "unit_diagonal": unit}
            for left in (True, False)
            for lower in (True, False)
            for transpose in (True, False)
            for unit in (True, False)
        )
    ],
    "jit": [unary(jax.jit(lambda x: x + 1))],
    "call_hi_primitive": [unary(lambda x: x[jnp.nonzero(_hidden(np.asarray(BOOL)), size=2)[0]])],
    "remat2": [unary(jax.checkpoint(lambda x: jnp.sin(x) + 1))],
    "custom_vjp_call": [unary(square_with_own_gradient())],
    "custom_jvp_call": [unary(jax.nn.relu), unary(jax.nn.silu)],
    "scan": [
        (lambda x: lax.scan(lambda c, y: (c * 0.5 + y, c), x[0], x), (V,)),
        (lambda x: lax.scan(lambda c, y: (c * 0.5 + y, c), x[0], x, reverse=True), (V,)),
        (lambda x: lax.fori_loop(0, 4, lambda i, c: c * 0.5 + i, x), (V,)),
    ],
    "while": [
        (lambda x: lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, c[1] * 2), (0, x))[1], (V,)),
        (lambda x: lax.while_loop(lambda c: c[0] < 3, lambda c: c + 1, x), (V,)),
        (lambda x: lax.while_loop(lambda c: (c[1] < 2) | (c[0] < 9), lambda c: (c[0] * 3, c[1] + 1), (x[2], 0)), (V,)),
    ],
    "cond": [
        (lambda x: lax.cond(x[0] > 0, jnp.sin, jnp.cos, x), (V,)),
        (lambda x: lax.cond(x[0] < 0, jnp.sin, jnp.cos, x), (V,)),
        (lambda x, i: lax.switch(i, [jnp.sin, jnp.cos, jnp.tan], x), (V, 2)),
        (lambda x: lax.cond(True, jnp.sin, jnp.cos, x), (V,)),
    ],
}
FUNCTIONS = [pytest.param(*case, id=f"{name}-{i}") for name, cases in CASES.items() for i, case in enumerate(cases)]


def agree(ours, theirs, tolerance=2e-6):
    for mine, true in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert mine.shape == true.shape
        assert mine.dtype == true.dtype
        np.testing.assert_allclose(mine, true, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize(("fn", "args"), FUNCTIONS)
def test_rule(fn, args):
    args = jax.tree.map(jnp.asarray, args)
    agree(jax.jit(scalarize(fn, *args))(*args), jax.jit(fn)(*args))


@pytest.mark.parametrize(("fn", "args"), FUNCTIONS)
def test_rule_on_constants(fn, args):
    """Nothing depends on the argument: everything is folded, by numpy."""
    args = jax.tree.map(jnp.asarray, args)
    with jax.ensure_compile_time_eval():
        constants = [np.asarray(arg) for arg in args]
    program = trace(lambda x: jax.tree.map(lambda y: y, fn(*map(_hidden, constants))), V)
    assert len(program) == 0
    agree(program.join(program.run(program.split([V]))), fn(*args))


def _hidden(constant):
    """The constant as jax sees one that was closed over, not as a Python value that jax.numpy computes with at once."""
    return (
        lax.add_p.bind(jnp.asarray(constant), jnp.zeros_like(constant))
        if constant.dtype != bool
        else jnp.asarray(constant)
    )


def test_every_rule_has_a_case():
    assert set(RULES) | set(CONTROL) == set(CASES)


def primitives(jaxpr):
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for parameter in jax.tree.leaves(equation.params, is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")):
            if hasattr(parameter, "eqns") or hasattr(parameter, "jaxpr"):
                yield from primitives(getattr(parameter, "jaxpr", parameter))


@pytest.mark.parametrize("name", CASES)
def test_cases_use_their_primitive(name):
    if name == "call_hi_primitive" and jax.__version_info__ < (0, 12):
        pytest.skip("new in jax 0.12")
    assert any(name in primitives(jax.make_jaxpr(fn)(*args).jaxpr) for fn, args in CASES[name])


@pytest.mark.parametrize(
    ("fn", "args", "name"),
    [
        (jnp.sort, (jnp.ones(65),), "sort"),
        (lambda x: lax.top_k(x, 2), (jnp.ones(65),), "top_k"),
        (lambda x, i: x[i], (jnp.ones(513), INT), "gather"),
        (lambda x, i: x.at[i, i].set(0.0), (jnp.ones((23, 23)), INT), "scatter"),
        (lambda x, i: lax.dynamic_slice(x, (i, i), (1, 1)), (jnp.ones((23, 23)), 1), "dynamic_slice"),
        (lambda x, i: lax.dynamic_update_slice(x, x[:1], (i,)), (jnp.ones(513), 1), "dynamic_update_slice"),
        (lambda x: lax.pad(x, np.float32(0), ((-1, 0, 0),)), (V,), "pad"),
        (lambda x: lax.linalg.svd(x), (A,), "svd"),
    ],
)
def test_what_has_no_scalar_form_is_named(fn, args, name):
    with pytest.raises(UnsupportedPrimitiveError, match=rf"^{name}: "):
        scalarize(fn, *args)


def test_arguments_and_results_are_pytrees():
    def fn(state, gain):
        return {"next": state["x"] * gain, "constant": jnp.ones((2, 0)), "one": jnp.ones(2)}

    ours = scalarize(fn, {"x": V}, W)
    agree(ours({"x": V}, W), fn({"x": V}, W))
    with pytest.raises(TypeError, match="expected arguments"):
        ours({"y": V}, W)


LEAVES = st.one_of(
    st.integers(0, 2).map(lambda i: lambda xs: xs[i]),
    st.sampled_from([0.0, 1.0, -1.0, 2.0, 0.5, -0.3]).map(lambda c: lambda xs: jnp.full((), c) + 0 * 1.0),
)


def grow(children):
    binary = st.sampled_from([lax.add, lax.sub, lax.mul, lax.max, lax.min])
    unary_ops = st.sampled_from([lax.neg, lax.sin, lax.cos, jnp.square, lambda x: 0.5 * x, lambda x: x * 0.0])
    return st.one_of(
        st.tuples(binary, children, children).map(lambda t: lambda xs: t[0](t[1](xs), t[2](xs))),
        st.tuples(unary_ops, children).map(lambda t: lambda xs: t[0](t[1](xs))),
        st.tuples(children, children, children).map(
            lambda t: lambda xs: lax.select(t[0](xs) > 0.1, t[1](xs), t[2](xs)),
        ),
    )


@pytest.mark.parametrize("reduce", [jnp.sum, jnp.prod, jnp.all, jnp.any, lambda x: x.sum(0).prod()])
@pytest.mark.parametrize("shape", [(0,), (0, 3), (3, 0)])
def test_reductions_of_no_elements_are_their_neutral_elements(reduce, shape):
    nothing = jnp.zeros(shape)
    found, expected = scalarize(reduce, nothing)(nothing), reduce(nothing)
    assert (found, found.dtype, found.shape) == (expected, expected.dtype, ())


@settings(deadline=None, max_examples=150)
@given(st.recursive(LEAVES, grow, max_leaves=25), st.integers(0, 2**32 - 1))
def test_simplification_keeps_the_value(expression, seed):
    """Random expressions of three variables in float64, with 0, 1, -1 and repeated parts among them: to 1e-9."""
    with jax.enable_x64(True):
        xs = jnp.asarray(np.random.default_rng(seed).uniform(-2, 2, 3))
        program = trace(expression, xs)
        (ours,) = program.join(program.run(program.split([xs])))
        np.testing.assert_allclose(ours, expression(xs), rtol=1e-9, atol=1e-9)


def test_equal_parts_are_computed_once():
    program = trace(lambda x: (x[0] * x[1]) * x[2] + (x[1] * x[0]) * x[2], V)
    assert len(program) == 3  # x0 x1, times x2, times 2


def test_a_nan_stays_a_nan():
    fn = scalarize(lambda x, y: x + 0.1 * jnp.clip(jnp.sin(x) * y, -1, 1), V, W)
    for place in range(3):
        bad = V.at[place].set(jnp.nan)
        assert np.isnan(fn(bad, W)).tolist() == [i == place for i in range(3)]
        assert np.isnan(fn(V, W.at[place].set(jnp.nan))).tolist() == [i == place for i in range(3)]


def test_gradients_through_vmap_and_scan():
    def fn(x, y):
        return x + 0.1 * jnp.sin(x) * y[::-1]

    def loss(step, x):
        return jnp.sum(lax.scan(lambda c, _: (jax.vmap(step)(c, c * c), None), x, length=20)[0] ** 2)

    ours, theirs = (jax.jit(jax.grad(lambda x, f=f: loss(f, x)))(A) for f in (scalarize(fn, V, W), fn))
    np.testing.assert_allclose(ours, theirs, rtol=1e-5)


@pytest.mark.optimized  # whose error at 1e5 is small thanks to fused multiply-adds
@pytest.mark.parametrize("limit", [1.0, 100.0, 1e5])
def test_sine_and_cosine(limit):
    """Within 2 units in the last place of 1 of the float64 values."""
    x = np.random.default_rng(0).uniform(-limit, limit, 100_000).astype(np.float32)
    x[:4] = [0.0, np.pi / 2, -np.pi, limit]
    sin, cos = jax.jit(sincos)(x)
    np.testing.assert_allclose(sin, np.sin(x.astype(float)), rtol=0, atol=2 * 2.0**-24)
    np.testing.assert_allclose(cos, np.cos(x.astype(float)), rtol=0, atol=2 * 2.0**-24)


def test_sine_and_cosine_at_the_ends():
    """NaN for what has no sine; never outside [-1, 1]; the gradient is the other function; float64 is XLA's own."""
    sin, cos = sincos(jnp.asarray([jnp.nan, jnp.inf, -jnp.inf, 1e9, 3e38], jnp.float32))
    assert np.isnan(sin).tolist() == np.isnan(cos).tolist() == [True, True, True, False, False]
    assert np.all(np.abs(np.stack([sin, cos])[:, 3:]) <= 1)
    np.testing.assert_array_equal(jax.vmap(jax.grad(lambda x: sincos(x)[0]))(V), sincos(V)[1])
    np.testing.assert_array_equal(jax.vmap(jax.grad(lambda x: sincos(x)[1]))(V), -sincos(V)[0])
    with jax.enable_x64(True):
        np.testing.assert_array_equal(sincos(jnp.asarray([1e9]))[0], jnp.sin(jnp.asarray([1e9])))


def test_stages_are_not_inlined():
    """The compiled program calls each stage: without the calls XLA repeats a step's work for each of its results.

    The mark that keeps XLA from inlining a call comes from an experimental module of jax; this notices when it goes.
    """
    step = envs.make("arm", num_substeps=1).physics_step
    arguments = [jnp.zeros((8, 2))] * 3
    compiled = jax.jit(jax.vmap(step)).lower(*arguments).compile().as_text()
    assert compiled.count(" call(") >= 5
