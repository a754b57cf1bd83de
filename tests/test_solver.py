"""The solver finds the minimum of the convex problem from any start, and its derivative, in few rounds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from envs.physics.dynamics import solver
from envs.physics.dynamics.cones import Ellipse, Pyramid
from envs.physics.dynamics.linear_algebra import solve as solve_linear
from envs.physics.dynamics.rows import Rows
from envs.physics.dynamics.solver import minimise
from envs.physics.interpreter import trace
from envs.physics.numeric import evaluate

NV, NUM_ROWS, NUM_CONES = 5, 8, 3


class Cones:
    """Contacts with dense Jacobians, as a group of constraints."""

    def __init__(self, jacobian, reference, cone):
        self.jacobian, self.reference, self.cone = jacobian, reference, cone  # [n, k, nv], [n, k]

    def apply(self, velocity):
        return self.jacobian @ velocity

    def pull(self, forces):
        return jnp.einsum("nkv,nk->v", self.jacobian, forces)

    def value(self, u):
        return jnp.sum(jax.vmap(type(self.cone).value)(self.cone, u))

    def slope(self, u):
        return jax.vmap(type(self.cone).slope)(self.cone, u)

    def slope_along(self, u, v):
        first, second = jax.vmap(type(self.cone).slope_along)(self.cone, u, v)
        return jnp.sum(first), jnp.sum(second)

    def stiffen(self, u):
        curvature = jax.vmap(type(self.cone).curvature)(self.cone, u)
        return jnp.einsum("nkv,nkl,nlw->vw", self.jacobian, curvature, self.jacobian)


def draw(seed, stiffest=1e3, dtype=float):
    """Numbers of a random problem: with equal rows, rows of zeros, rows that do not act, of all kinds."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(NV, NV))
    J = rng.normal(size=(NUM_ROWS, NV))
    J[1], J[2], J[3] = J[0], -J[0], 0.0
    D = 10 ** rng.uniform(-2, np.log10(stiffest), NUM_ROWS)
    D[rng.random(NUM_ROWS) < 0.2] = 0.0
    kinds, loss = rng.integers(0, 3, NUM_ROWS), rng.uniform(0.1, 3, NUM_ROWS)
    problem = {
        "mass": root @ root.T + 0.1 * np.eye(NV),
        "force": 10 * rng.normal(size=NV),
        "jacobian": J,
        "reference": 5 * rng.normal(size=NUM_ROWS),
        "stiffness": D,
        "low": np.choose(kinds, (-np.inf, -np.inf, -loss)),
        "high": np.choose(kinds, (np.inf, 0.0, loss)),
        "cone_jacobian": rng.normal(size=(NUM_CONES, 3, NV)),
        "cone_reference": 5 * rng.normal(size=(NUM_CONES, 3)),
        "regularization": 10 ** rng.uniform(-np.log10(stiffest), 0, NUM_CONES),
        "friction": rng.uniform(0.1, 1.5, (NUM_CONES, 2)),
        "start": 10 * rng.normal(size=NV),
    }
    return {name: np.asarray(value, dtype) for name, value in problem.items()}


def make_groups(problem, kind):
    rows = Rows(*(problem[name] for name in ("jacobian", "reference", "stiffness", "low", "high")))
    active = np.array([True] * (NUM_CONES - 1) + [False])
    cone = jax.vmap(kind.make, (0, 0, 0, None))(problem["regularization"], problem["friction"], active, 1.0)
    return [rows, Cones(problem["cone_jacobian"], problem["cone_reference"], cone)]


def solve(problem, kind, differentiable=False):
    groups = make_groups(problem, kind)
    mass, force = problem["mass"], problem["force"]
    return minimise(mass, force, groups, solve_linear(mass, force), problem["start"], differentiable)


def find_gradient(problem, kind, a):
    """M a - f + sum J' s'(J a - r), and the size of its terms."""
    groups = make_groups(problem, kind)
    parts = [problem["mass"] @ a, -problem["force"], *(c.pull(c.slope(c.apply(a) - c.reference)) for c in groups)]
    return sum(parts), sum(jnp.abs(part).max() for part in parts)


PROGRAMS = {}


def solve_all(problems, kind):
    """(a, forces) of several problems by scalar equations in numpy."""
    names = list(problems[0])
    key = kind, problems[0]["mass"].dtype
    if key not in PROGRAMS:
        PROGRAMS[key] = trace(lambda *x: solve(dict(zip(names, x, strict=True)), kind), *problems[0].values())
    return evaluate(PROGRAMS[key], [np.stack([problem[name] for problem in problems]) for name in names])


kinds = pytest.mark.parametrize("kind", [Pyramid, Ellipse])


@pytest.fixture(autouse=True)
def in_float64():
    with jax.enable_x64(True):
        yield


@kinds
@pytest.mark.parametrize("stiffest", [1e1, 1e4])
def test_the_gradient_is_zero_at_the_solution(kind, stiffest):
    """Up to the rounding of its terms; and the force is what the constraints pull with."""
    problems = [draw(seed, stiffest) for seed in range(100)]
    for problem, a, force in zip(problems, *solve_all(problems, kind), strict=True):
        gradient, size = find_gradient(problem, kind, a)
        assert np.abs(gradient).max() < 1e-11 * size * max(1, stiffest / 1e3)
        np.testing.assert_allclose(force, problem["mass"] @ a - problem["force"], atol=1e-11 * size)


@kinds
def test_the_solution_is_that_of_another_method(kind):
    """BFGS on the function itself, whose slope is integrated numerically: c(a) has no smaller value nearby either."""

    def cost(problem, a):
        """By integration of the gradient on the line from 0, with 2000 midpoints."""
        t = (np.arange(2000) + 0.5) / 2000
        return np.mean(jax.vmap(lambda t: find_gradient(problem, kind, t * a)[0] @ a)(t))

    problems = [draw(seed, 10.0) for seed in range(3)]
    for problem, a in zip(problems, solve_all(problems, kind)[0], strict=True):
        gradient = jax.jit(lambda x, problem=problem: find_gradient(problem, kind, x)[0])
        found = minimize(
            lambda x, problem=problem: cost(problem, x), np.zeros(NV), jac=gradient, options={"gtol": 1e-4}
        )
        np.testing.assert_allclose(a, found.x, atol=2e-3 * np.abs(a).max())


@kinds
def test_the_start_does_not_matter(kind):
    problems = [draw(seed) for seed in range(100)]
    expected = solve_all(problems, kind)[0]
    for start in (0.0, 1e4):
        moved = [problem | {"start": start * problem["start"]} for problem in problems]
        size = np.abs(expected).max(1, keepdims=True)
        np.testing.assert_allclose(solve_all(moved, kind)[0] / size, expected / size, atol=1e-9)


@pytest.fixture
def counted(monkeypatch):
    """How often the solver makes a round, of the outer and of the inner loop."""
    counts = []
    loop = solver.lax.while_loop

    def count(condition, body, state):
        end = loop(condition, body, state)
        counts.append(end[-1])
        return end

    monkeypatch.setattr(solver.lax, "while_loop", count)
    return counts


@kinds
@pytest.mark.parametrize(("stiffest", "most"), [(1e2, 15), (1e4, 35)])
def test_rounds_are_few(kind, stiffest, most, counted):
    """Far fewer than `MAX_ROUNDS`, so that the bound itself never ends the search."""

    def count(*values):
        counted.clear()
        solve(dict(zip(names, values, strict=True)), kind)
        return counted[-1]

    problems = [draw(seed, stiffest) for seed in range(100)]
    names = list(problems[0])
    program = trace(count, *problems[0].values())
    (rounds,) = evaluate(program, [np.stack([problem[name] for problem in problems]) for name in names])
    assert rounds.max() <= most, np.bincount(rounds.astype(int))
    assert rounds.min() >= 1


def test_hardly_a_round_at_the_solution(counted):
    problem = draw(0)
    problem["start"] = np.asarray(solve(problem, Pyramid)[0])
    solve(problem, Pyramid)
    assert counted[-1] <= 1


@kinds
def test_equations_are_the_function(kind):
    """As scalars and as arrays."""
    problem = draw(3)
    for mine, true in zip(solve_all([problem], kind), jax.jit(lambda p: solve(p, kind))(problem), strict=True):
        np.testing.assert_allclose(mine[0], true, rtol=1e-9, atol=1e-9)


@kinds
def test_float32(kind):
    """To 1e-6 of the largest acceleration in the median, and in 99 % of the problems to 1e-4."""
    exact = [draw(seed) for seed in range(300)]
    single = [{name: value.astype(np.float32) for name, value in problem.items()} for problem in exact]
    rounded = [{name: value.astype(float) for name, value in problem.items()} for problem in single]
    expected = solve_all(rounded, kind)[0]
    with jax.enable_x64(False):
        found = solve_all(single, kind)[0]
    errors = np.abs(found - expected).max(1) / np.abs(expected).max(1)
    assert np.isfinite(found).all()
    assert np.median(errors) < 1e-6
    assert np.quantile(errors, 0.99) < 1e-4, np.quantile(errors, [0.9, 0.99, 0.999, 1])


@kinds
@settings(deadline=None, max_examples=2, derandomize=True)
@given(seed=st.integers(0, 2**31))
def test_derivatives_of_the_solution(kind, seed):
    """By all numbers of the problem, against differences; the start has none."""
    problem = draw(seed, 30.0)
    for name in ("low", "high"):
        problem[name] = np.clip(problem[name], -1e9, 1e9)
    rng = np.random.default_rng(seed)
    direction = {name: rng.normal(size=np.shape(value)) * 0.1 for name, value in problem.items()}
    direction["mass"] += direction["mass"].T
    for name in ("stiffness", "regularization", "friction"):
        direction[name] *= problem[name]

    def at(t):
        return {name: value + t * direction[name] for name, value in problem.items()}

    value, derivative, back = differentiate(problem, direction, kind)
    steps = solve_all([at(t) for t in (1e-6, -1e-6)], kind)
    for mine, true, ahead in zip(derivative, value, steps, strict=True):
        np.testing.assert_allclose(mine, (ahead[0] - ahead[1]) / 2e-6, atol=1e-5 * (1 + np.abs(true).max()))
    np.testing.assert_allclose(
        sum(np.sum(back[name] * direction[name]) for name in problem), sum(np.sum(x**2) for x in derivative), rtol=1e-8
    )
    assert not np.any(back["start"])


def differentiate(problem, direction, kind):
    """(x, J d, J' J d) of the solution x and its derivatives J by the numbers of the problem, in the direction d."""

    def find(problem, direction):
        def find_solution(problem):
            return solve(problem, kind, differentiable=True)

        value, derivative = jax.jvp(find_solution, (problem,), (direction,))
        return value, derivative, jax.vjp(find_solution, problem)[1](derivative)[0]

    if ("derivatives", kind) not in PROGRAMS:
        PROGRAMS["derivatives", kind] = trace(find, problem, direction)
    program = PROGRAMS["derivatives", kind]
    results = evaluate(program, [x[None] for x in jax.tree.leaves((problem, direction))])
    return jax.tree.unflatten(program.output_structure, [x[0] for x in results])


def test_derivative_by_the_force_is_the_inverse_hessian():
    """da = H^-1 df, with the pieces in which the solution lies: here of one spring that pulls."""
    rows = Rows(jnp.ones((1, 2)), jnp.zeros(1), jnp.array([7.0]), jnp.array([-jnp.inf]), jnp.zeros(1))
    mass, force = jnp.array([[2.0, 0.3], [0.3, 1.0]]), jnp.array([-3.0, -1.0])

    def accelerate(force):
        return minimise(mass, force, [rows], solve_linear(mass, force), differentiable=True)[0]

    np.testing.assert_allclose(jax.jacfwd(accelerate)(force), np.linalg.inv(mass + 7.0), rtol=1e-12)
    np.testing.assert_allclose(jax.jacrev(accelerate)(force), np.linalg.inv(mass + 7.0), rtol=1e-12)
    np.testing.assert_allclose(jax.jacfwd(accelerate)(-force), np.linalg.inv(mass), rtol=1e-12)


def test_a_nan_ends_the_search():
    """And is the result."""
    problem = draw(0)
    problem["force"] = np.full(NV, np.nan)
    a, force = solve(problem, Pyramid)
    assert np.isnan(a).any()
    assert np.isnan(force).any()


def test_value_of_rows():
    """Its derivative is the slope, and it is 0 at 0: between and beyond the bounds, and of a row that does not act."""
    rows = Rows(
        jnp.eye(4),
        jnp.zeros(4),
        jnp.array([2.0, 3.0, 5.0, 0.0]),
        *np.array([[-np.inf, -1, -np.inf, -1], [np.inf, 1, 0, 1]]),
    )
    for u in np.random.default_rng(0).normal(size=(50, 4)):
        np.testing.assert_allclose(
            jax.grad(rows.value)(jnp.asarray(u)), rows.slope(jnp.asarray(u)), rtol=1e-12, atol=1e-12
        )
    assert rows.value(jnp.zeros(4)) == 0


def test_a_guess_is_taken_where_it_is_better():
    """At the solution nothing is left to do; far away the method starts without it, and ends at the same place."""
    problem = draw(5)
    groups = make_groups(problem, Pyramid)
    mass, force = problem["mass"], problem["force"]
    free = solve_linear(mass, force)
    best, _ = minimise(mass, force, groups, free)
    for guess in (best, 1e3 * problem["start"]):
        np.testing.assert_allclose(minimise(mass, force, groups, free, guess)[0], best, rtol=1e-9, atol=1e-9)
