"""Loops that run as long as the data say are loops of the scalar equations, and compute what jax's loops compute."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax

from envs.physics import kernels, stages, tiles
from envs.physics.interpreter import trace
from envs.physics.loops import find_loop, is_result
from envs.physics.stages import find_loops
from envs.physics.storage import from_text, to_text
from envs.physics.tiles import TILE, make_tiled

SIZE = 4


@pytest.fixture(autouse=True)
def always_in_tiles(monkeypatch):
    """Small programs too."""
    monkeypatch.setattr(tiles, "FEW_LOOPS", 0)


def step_of(program):
    """The program as a function of one environment, in tiles under `vmap`."""
    return make_tiled(
        program, lambda parts: lambda *arrays: tuple(program.join(program.run(program.split(arrays), parts)))
    )


def scalar(fn, *args):
    return step_of(trace(fn, *args))


def agree(ours, theirs, tolerance):
    for mine, true in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert mine.shape == true.shape
        assert mine.dtype == true.dtype
        np.testing.assert_allclose(mine, true, rtol=tolerance, atol=tolerance)


def equal(ours, theirs):
    for mine, true in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_array_equal(mine, true)


def states(batch, *, seed=0):
    """x, y (SIZE numbers each) and the rounds of two loops, of each environment."""
    random = np.random.default_rng(seed)
    x, y = (jnp.asarray(random.uniform(-1, 1, (batch, SIZE)), float) for _ in range(2))
    return x, y, jnp.asarray(random.integers(0, 6, (batch, 2)))


def loops(program):
    return find_loops(program.equations())


X, Y, ROUNDS = (x[0] for x in states(1))


# --- random loops -----------------------------------------------------------------------------------------------------
# What a round makes of one number; j and k are places in x and y, i is the number of the round. All are bounded and
# continuous, so that rounding stays small.

PARTS = {
    "unchanged": lambda x, y, i, at, j, k: x[at],
    "other": lambda x, y, i, at, j, k: x[j],
    "constant": lambda x, y, i, at, j, k: jnp.zeros(()),
    "captured": lambda x, y, i, at, j, k: y[k],
    "counted": lambda x, y, i, at, j, k: 0.1 * i + 0.5 * x[j],
    "mixed": lambda x, y, i, at, j, k: jnp.tanh(x[at] - 0.7 * x[j] * y[k] + 0.2),
    "chosen": lambda x, y, i, at, j, k: jnp.where(x[j] > y[k], x[j] - y[k], 0.5 * (y[k] - x[j])),
    "at an index": lambda x, y, i, at, j, k: jnp.tanh(0.5 * x[i % SIZE] + x[at] * y[i % 3]),
    "stopped": lambda x, y, i, at, j, k: jnp.sin(lax.stop_gradient(x[j]) * x[at]),
}
PLACE = st.integers(0, SIZE - 1)
BODY = st.lists(st.tuples(st.sampled_from(list(PARTS)), PLACE, PLACE), min_size=SIZE, max_size=SIZE)
ZEROS = st.lists(st.booleans(), min_size=SIZE, max_size=SIZE)


def make_function(body, inner, zeros, used):
    """x after as many rounds of `body` as rounds[0] says, with a loop of rounds[1] rounds of `inner` in each."""

    def advance(parts, x, y, i):
        return jnp.stack([PARTS[name](x, y, i, at, j, k) for at, (name, j, k) in enumerate(parts)])

    def function(x, y, rounds):
        def outer_round(carry):
            i, x, total, dead = carry
            x = advance(body, x, y, i)
            if inner is not None:
                count, x = lax.while_loop(
                    lambda c: c[0] < rounds[1], lambda c: (c[0] + 1, advance(inner, c[1], x + y, c[0])), (0, x)
                )
                i += 0 * count
            return i + 1, x, total + x[0], dead + total

        x = jnp.where(np.asarray(zeros), 0.0, x)
        results = lax.while_loop(lambda c: c[0] < rounds[0], outer_round, (0, x, y[0], y[1]))
        return tuple(results[place] for place in used)

    return function


FUNCTIONS = st.builds(
    make_function, BODY, st.none() | BODY, ZEROS, st.lists(st.integers(0, 2), min_size=1, max_size=3, unique=True)
)


@settings(deadline=None, max_examples=8)
@given(FUNCTIONS, st.booleans(), st.sampled_from([1, 17, TILE + 3, 2 * TILE + 100]))
def test_random_loops(function, is_double, batch):
    with jax.enable_x64(is_double):
        arguments = states(batch)
        program = trace(function, *(x[0] for x in arguments))
        ours = jax.jit(jax.vmap(step_of(program)))(*arguments)
        agree(ours, jax.jit(jax.vmap(function))(*arguments), 1e-12 if is_double else 1e-5)
        again = from_text(to_text(program))
        assert to_text(again) == to_text(program)
        assert len(again) == len(program)
        equal(jax.jit(jax.vmap(step_of(again)))(*arguments), ours)


@settings(deadline=None, max_examples=5)
@given(FUNCTIONS, st.tuples(st.integers(0, 5), st.integers(0, 5)))
def test_random_loops_of_one_environment(function, rounds):
    arguments = X, Y, jnp.asarray(rounds)
    agree(jax.jit(scalar(function, *arguments))(*arguments), function(*arguments), 1e-5)


@settings(deadline=None, max_examples=5)
@given(FUNCTIONS)
def test_random_loops_have_forward_derivatives(function):
    x, y, rounds = states(3)

    def of(step):
        def numbers(x, y, rounds):
            return [1.0 * z for z in step(x, y, rounds)]

        return jax.vmap(lambda x, y, rounds: jax.jvp(lambda x, y: numbers(x, y, rounds), (x, y), (y, x)))

    ours = jax.jit(of(scalar(function, X, Y, ROUNDS)))(x, y, rounds)
    agree(ours, of(function)(x, y, rounds), 1e-4)


@settings(deadline=None, max_examples=5)
@given(FUNCTIONS)
def test_random_loops_behind_stop_gradient(function):
    """What a loop returns is a constant of the derivatives if what goes into it is."""
    x, y, rounds = states(3)

    def of(step):
        def loss(x, y, rounds):
            numbers = jnp.concatenate([jnp.ravel(1.0 * z) for z in step(x, y, rounds)])
            return jnp.sum(jnp.square(numbers))

        return jax.vmap(jax.grad(loss, argnums=(0, 1)))

    def around(x, y, rounds):
        results = function(*map(lax.stop_gradient, (jnp.sin(x), x * y)), rounds)
        return [jnp.sum(x * y) * z + jnp.cos(x[0]) for z in results]

    ours = jax.jit(of(scalar(around, X, Y, ROUNDS)))(x, y, rounds)
    agree(ours, of(around)(x, y, rounds), 1e-4)


# --- a solver ---------------------------------------------------------------------------------------------------------

DIMENSION, ROWS = 4, 4
_RANDOM = np.random.default_rng(3)
JACOBIAN = _RANDOM.normal(size=(ROWS, DIMENSION))
WEIGHTS = _RANDOM.uniform(1, 30, ROWS)


def solve(matrix, vector):
    """matrix^-1 vector by elimination: some releases of jaxlib can hang in LAPACK under `vmap`."""
    system = jnp.concatenate([matrix, vector[:, None]], 1)
    for i in range(len(vector)):
        row = system[i] / system[i, i]
        system = jnp.where((jnp.arange(len(vector)) == i)[:, None], row, system - system[:, i, None] * row)
    return system[:, -1]


def minimise(start, bounds):
    """argmin |a - start|^2 / 2 + sum_i D_i min(J_i a - b_i, 0)^2 / 2 by Newton's method with halved steps."""
    jacobian, weights = JACOBIAN.astype(start.dtype), WEIGHTS.astype(start.dtype)

    def derivatives(a):
        violation = jnp.minimum(jacobian @ a - bounds, 0)
        active = weights * (violation < 0)
        cost = 0.5 * jnp.sum((a - start) ** 2) + 0.5 * jnp.sum(weights * violation**2)
        return cost, a - start + jacobian.T @ (weights * violation), active

    def newton(carry):
        i, a, cost, gradient, active = carry
        step = solve(jnp.eye(DIMENSION) + jacobian.T @ (active[:, None] * jacobian), gradient)
        length = lax.while_loop(
            lambda t: (derivatives(a - t * step)[0] > cost) & (t > 1e-3), lambda t: 0.5 * t, jnp.ones((), a.dtype)
        )
        return i + 1, a - length * step, *derivatives(a - length * step)

    def is_far(carry):
        return (carry[0] < 30) & (jnp.sum(carry[3] ** 2) > 1e-8)

    rounds, a, *_ = lax.while_loop(is_far, newton, (0, start, *derivatives(start)))
    return a, rounds


def problems(batch):
    random = np.random.default_rng(0)
    scale = random.uniform(0, 3, (batch, 1))
    return jnp.asarray(random.normal(size=(batch, DIMENSION)), float), jnp.asarray(
        scale * random.normal(size=(batch, ROWS)), float
    )


@pytest.fixture(scope="module")
def solver():
    start, bounds = problems(1)
    return trace(minimise, start[0], bounds[0])


def test_a_solver(solver):
    arguments = problems(300)
    solution, rounds = jax.jit(jax.vmap(step_of(solver)))(*arguments)
    true, true_rounds = jax.jit(jax.vmap(minimise))(*arguments)
    agree(solution, true, 1e-4)
    assert np.mean(rounds != true_rounds) < 0.02  # where rounding decides
    assert len(np.unique(rounds)) > 2


def test_a_solver_in_double_precision():
    with jax.enable_x64(True):
        arguments = problems(150)
        ours = jax.jit(jax.vmap(scalar(minimise, *(x[0] for x in arguments))))(*arguments)
        agree(ours, jax.jit(jax.vmap(minimise))(*arguments), 1e-12)


def test_environments_do_not_depend_on_each_other(solver):
    """The same bits in another batch, at another place, next to others that take longer or never finish."""
    start, bounds = problems(2 * TILE + 70)
    step = jax.jit(jax.vmap(step_of(solver)))
    alone = step(start, bounds)
    order = np.random.default_rng(1).permutation(len(start))
    equal(step(start[order], bounds[order]), [x[order] for x in alone])
    for size in (TILE - 16, TILE + 32):
        equal(step(start[:size], bounds[:size]), [x[:size] for x in alone])
    broken = step(start.at[::7].set(jnp.nan), bounds)
    keep = np.arange(len(start)) % 7 != 0
    equal([x[keep] for x in broken], [x[keep] for x in alone])


@pytest.mark.parametrize("known", [(0,), (1,), (0, 1)])
def test_constants_of_the_compiled_program(solver, known):
    """Arguments that XLA knows, and would fold into the kernel with the loop."""
    arguments = problems(150)

    def some(*others):
        others = iter(others)
        return jax.vmap(step_of(solver))(*(arguments[i] if i in known else next(others) for i in range(2)))

    ours = jax.jit(some)(*(x for i, x in enumerate(arguments) if i not in known))
    agree(ours[0], jax.vmap(minimise)(*arguments)[0], 1e-4)


def list_kernels(step, *arguments):
    executable = jax.jit(jax.vmap(step)).lower(*arguments).compile().runtime_executable()
    assert executable
    return set(re.findall(rb"[\w.]+_kernel\b", executable.serialize()))


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="tiles are for CPUs")
def test_a_loop_is_compiled_whole(solver):
    """With the loop inside it: XLA calls one kernel in a tile. jax gives no promise about where its name is read."""
    assert len(list_kernels(step_of(solver), *problems(TILE))) == 1


def test_a_loop_around_several_parts(solver, monkeypatch):
    """A loop that is too large for one kernel has kernels in it."""
    whole = jax.jit(jax.vmap(step_of(solver)))(*problems(200))
    monkeypatch.setattr(kernels, "KERNEL", 150)
    step = step_of(solver)
    assert len(list_kernels(step, *problems(TILE))) > 3
    agree(jax.jit(jax.vmap(step))(*problems(200)), whole, 1e-5)


def test_a_scan_around_a_loop(solver):
    """As substeps are."""

    def repeat(step):
        return lambda start, bounds: lax.scan(lambda a, _: (step(a, bounds)[0], None), start, length=3)[0]

    program = jax.jit(jax.vmap(repeat(step_of(solver))))
    agree(program(*problems(200)), jax.vmap(repeat(minimise))(*problems(200)), 1e-4)


def test_who_does_not_take_part_makes_no_rounds():
    """A loop inside a loop, or in a branch, does not go on for an environment whose result is not used."""

    def count(limit):
        return lax.while_loop(lambda i: (i != limit) & (i < 1000), lambda i: i + 1, 0)

    def fn(x, y, rounds):
        first, second = rounds
        nested = lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, c[1] + count(3 - c[0])), (first, 0))[1]
        return nested, lax.cond(second > 2, lambda: count(second - 3), lambda: count(2 - second))

    x, y, rounds = states(20)
    program = trace(fn, X, Y, ROUNDS)
    nested, branch = jax.jit(jax.vmap(step_of(program)))(x, y, rounds)
    first, second = np.asarray(rounds).T
    np.testing.assert_array_equal(nested, [sum(range(1, 4 - i)) for i in first])
    np.testing.assert_array_equal(branch, np.where(second > 2, second - 3, 2 - second))

    tests = {x.args[0] for x in program.equations() if is_result(x)}  # before the first round
    assert [str(test.op) for test in sorted(tests, key=lambda x: x.index)] == ["lt", "and", "and"]
    outer = next(loop for loop in loops(program) if any(map(is_result, stages.sort_equations(loop.outputs()))))
    (inner,) = filter(is_result, stages.sort_equations(outer.outputs()))
    assert outer.carried[0] in inner.args[0].args


# --- what is left of a loop -------------------------------------------------------------------------------------------


def test_constants_stay_constants():
    """A zero that no round changes is a zero of the equations; one that a round changes is not."""

    def fn(x, y, rounds):
        def body(carry):
            i, a, b = carry
            return i + 1, a @ jnp.diag(y), b + a[0, 1]

        return lax.while_loop(lambda c: c[0] < rounds[0], body, (0, jnp.diag(x), x[0]))

    program = trace(fn, X, Y, ROUNDS)
    (loop,) = loops(program)
    assert len(loop.carried) == 2 + SIZE  # whether and how often, and the diagonal; b + 0 is b
    assert [bool(x) for x in program.outputs[1].flat] == np.eye(SIZE, dtype=bool).ravel().tolist()
    assert program.outputs[2].item() is program.inputs[0][0]


def test_what_nobody_needs_is_not_carried():
    def fn(x, y, rounds):
        def body(carry):
            i, a, b, c, count = carry
            return i + 1, a + 1, b + a, c + b, count + 2 * i

        return lax.while_loop(lambda c: c[0] < rounds[0], body, (0, x[0], x[1], x[2], 0))[2]

    (loop,) = loops(trace(fn, X, Y, ROUNDS))
    assert len(loop.carried) == 4  # whether, how often, a and b
    assert len(loop.captured) == 1


def test_the_results_of_a_loop_are_computed_together():
    program = trace(make_function([("mixed", 1, 2)] * SIZE, None, [False] * SIZE, [1, 2]), X, Y, ROUNDS)
    results = [x for x in program.equations() if is_result(x)]
    assert len({find_loop(x)[0] for x in results}) == 1
    assert [stage.outputs for stage in program.stages if stage.body] == [results]


def test_a_loop_inside_a_loop_is_counted_once():
    """However often the loop around it is evaluated while it is traced."""
    mixed, zeros = [("mixed", 1, 2)] * SIZE, [False] * SIZE
    program = trace(make_function(mixed, mixed, zeros, [1]), X, Y, ROUNDS)
    outer, inner = loops(program)[::-1]
    assert len(program) == len(program.equations()) + sum(
        len(stages.sort_equations(loop.outputs())) for loop in (outer, inner)
    )


def test_rounds_that_are_known_are_written_out():
    def fn(x, y, rounds):
        return lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, c[1] * y), (0, x))[1]

    assert loops(trace(fn, X, Y, ROUNDS)) == []
    assert len(trace(fn, X, Y, ROUNDS)) == 3 * SIZE


def test_a_loop_of_known_length_may_hide_it():
    """From the equations, which are then those of one round."""

    def fn(x, y, rounds):
        is_nan = jnp.any(x != x)
        return lax.while_loop(lambda c: c[0] < 3 + is_nan, lambda c: (c[0] + 1, jnp.sin(c[1]) * y), (0, x))[1]

    program = trace(fn, X, Y, ROUNDS)
    assert len(loops(program)) == 1
    agree(step_of(program)(X, Y, ROUNDS)[0], fn(X, Y, ROUNDS), 1e-6)


def test_an_integer_has_no_derivative():
    program = trace(lambda i: lax.stop_gradient(i) + 1, jnp.arange(3))
    assert {x.op for x in program.equations()} == {"add"}
