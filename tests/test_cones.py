"""The functions of friction cones: convex, smooth, with forces inside the cone, and the derivatives of each other."""

import jax
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.physics import numeric
from envs.physics.dynamics.cones import Ellipse, Pyramid
from envs.physics.interpreter import trace

NUMBER = 200  # vectors u of a cone, at once
SIZES = {Pyramid: (1, 3, 4, 6), Ellipse: (3, 4, 6)}
CASES = [(kind, size) for kind, sizes in SIZES.items() for size in sizes]
cones = pytest.mark.parametrize(("kind", "size"), CASES, ids=lambda x: getattr(x, "__name__", x))
seeds = st.integers(0, 2**31)


@pytest.fixture(autouse=True, scope="module")
def in_float64():
    with jax.enable_x64(True):
        yield


# --- s, written in numpy ----------------------------------------------------------------------------------------------


def pyramid(D, m, u):
    """D / 2 sum over the edges of min(u_0 +- m_j u_j, 0)^2."""
    edges = [u[0] + sign * m[j] * u[j + 1] for j in range(len(m)) for sign in (1, -1)] or [u[0]]
    return sum(D / 2 * min(edge, 0.0) ** 2 for edge in edges)


def ellipse(D, m, ratio, u):
    N, T = ratio * u[0], np.linalg.norm(m * u[1:])
    if ratio * T <= N:
        return 0.0
    if ratio * N + T <= 0:
        return sum(D * u**2) / 2
    return D[0] / (2 * ratio**2 * (1 + ratio**2)) * (N - ratio * T) ** 2


def energy(cone, u):
    return pyramid(*cone, u) if isinstance(cone, Pyramid) else ellipse(*cone, u)


def differentiate(function, u, step):
    """The derivative of a function of one vector, by central differences of fourth order."""
    parts = []
    for e in np.eye(len(u)):
        one, two = ((function(u + k * step * e) - function(u - k * step * e)) / (2 * k * step) for k in (1, 2))
        parts.append((4 * one - two) / 3)
    return np.stack(parts, -1)


# --- what is tested ---------------------------------------------------------------------------------------------------


def draw(kind, size, seed):
    """A cone of a contact, and vectors u in all of its zones."""
    rng = np.random.default_rng(seed)
    friction = 10 ** rng.uniform(-1.5, 0.5, size - 1)
    cone = kind.make(np.array(10 ** rng.uniform(-2, 1)), friction, True, rng.choice([1.0, 0.3, 8.0]))
    u = rng.normal(size=(NUMBER, size))
    u[:, 1:] /= friction
    u[:, 0] = u[:, 0] * 2
    return type(cone)(*map(np.asarray, cone)), u


@jax.jit
def evaluate(cone, u, v):
    """slope, curvature and slope_along of each u."""

    def single(u, v):
        return cone.slope(u), cone.curvature(u), *cone.slope_along(u, v)

    return jax.vmap(single)(u, v)


def is_smooth_near(cone, u, step):
    """Whether u is so far from the borders of the zones that s is smooth within the reach of a difference."""
    if isinstance(cone, Pyramid):
        edges = [u[0] + sign * f * x for f, x in zip(cone.friction, u[1:], strict=True) for sign in (1, -1)] or [u[0]]
        return min(map(abs, edges)) > 20 * step
    N, T = cone.ratio * u[0], np.linalg.norm(cone.friction * u[1:])
    reach = 20 * step * (np.sum(cone.friction) + cone.ratio) * (1 + cone.ratio)
    return min(abs(N - cone.ratio * T), abs(cone.ratio * N + T), T) > reach


@cones
@settings(deadline=None, max_examples=5, derandomize=True)
@given(seed=seeds)
def test_slope_and_curvature_are_derivatives(kind, size, seed):
    """Of s, and of the slope; and those along a line are s' v and v' s'' v."""
    cone, u = draw(kind, size, seed)
    v = np.random.default_rng(seed).normal(size=u.shape)
    slope, curvature, first, second = map(np.asarray, evaluate(cone, u, v))
    step, scale = 3e-5, np.max(cone.stiffness) * (1 + np.sum(cone.friction**2))
    checked = [i for i in range(NUMBER) if is_smooth_near(cone, u[i], step)]
    assert len(checked) > 5
    for i in checked[:12]:
        s = differentiate(lambda x: energy(cone, x), u[i], step)
        np.testing.assert_allclose(slope[i], s, rtol=1e-6, atol=1e-7 * scale)
        h = differentiate(lambda x: differentiate(lambda y: energy(cone, y), x, step), u[i], step)
        np.testing.assert_allclose(curvature[i], h, rtol=1e-4, atol=1e-4 * scale)
    np.testing.assert_allclose(first, np.sum(slope * v, 1), rtol=1e-9, atol=1e-9 * scale)
    np.testing.assert_allclose(second, np.einsum("ni,nij,nj->n", v, curvature, v), rtol=1e-9, atol=1e-9 * scale)


@cones
@settings(deadline=None, max_examples=5, derandomize=True)
@given(seed=seeds)
def test_s_is_convex(kind, size, seed):
    """s'' has no negative eigenvalue, and the slope is monotone: (s'(u) - s'(w)) (u - w) >= 0."""
    cone, u = draw(kind, size, seed)
    slope, curvature, *_ = map(np.asarray, evaluate(cone, u, u))
    scale = np.abs(curvature).max()
    assert np.linalg.eigvalsh(curvature).min() > -1e-12 * scale
    np.testing.assert_allclose(curvature, curvature.swapaxes(1, 2), atol=1e-12 * scale)
    growth = np.einsum("abi,abi->ab", slope[:, None] - slope, u[:, None] - u)
    assert growth.min() > -1e-9 * np.abs(growth).max()


@cones
@settings(deadline=None, max_examples=5, derandomize=True)
@given(seed=seeds)
def test_forces_are_in_the_cone(kind, size, seed):
    """The normal force only pushes, and friction is at most its share: by components summed up, or by their norm."""
    cone, u = draw(kind, size, seed)
    force = -np.asarray(evaluate(cone, u, u)[0])
    assert force[:, 0].min() >= 0
    assert (force[:, 0] > 0).any()
    assert (force[:, 0] == 0).any()
    shares = force[:, 1:] / cone.friction
    used = np.abs(shares).sum(1) if kind is Pyramid else np.linalg.norm(shares, axis=1)
    assert (used <= force[:, 0] * (1 + 1e-9)).all()


@pytest.mark.parametrize("size", SIZES[Ellipse])
def test_slope_is_continuous_at_the_borders_of_the_zones(size):
    """Of an elliptic cone; the curvature is not."""
    cone, u = draw(Ellipse, size, 0)
    length = np.linalg.norm(cone.friction * u[:, 1:], axis=1)
    for border in (length, -length / cone.ratio**2):  # of separation and sliding, of sliding and sticking
        u[:, 0] = border
        sides = [np.asarray(evaluate(cone, u + shift * np.eye(size)[0], u)[0]) for shift in (-1e-9, 1e-9)]
        np.testing.assert_allclose(*sides, atol=1e-6 * np.max(cone.stiffness))
        bends = [np.asarray(evaluate(cone, u + shift * np.eye(size)[0], u)[1]) for shift in (-1e-9, 1e-9)]
        assert np.abs(bends[0] - bends[1]).max() > 1e-2 * np.max(cone.stiffness)


@cones
def test_what_is_not_active_does_nothing(kind, size):
    cone, u = draw(kind, size, 0)
    zero = cone._replace(stiffness=0 * cone.stiffness)
    idle = kind.make(np.array(0.3), cone.friction, False, 1.0)
    for other in (zero, type(idle)(*map(np.asarray, idle))):
        assert not any(np.any(part) for part in evaluate(other, u, u))


@cones
def test_nothing_is_nan_at_rest(kind, size):
    """Neither values nor their derivatives, where components of u are 0."""
    cone, _ = draw(kind, size, 0)
    us = np.array([x * np.eye(size)[i] for x in (0.0, 1.0, -1.0) for i in range(size)])

    def single(cone, u):
        return cone.slope(u), cone.curvature(u), *cone.slope_along(u, u)

    program = trace(lambda *given: (single(*given), jax.jacobian(single, argnums=(0, 1))(*given)), cone, us[0])
    numbers = [np.broadcast_to(x, (len(us), *np.shape(x))) for x in cone]
    assert all(np.isfinite(part).all() for part in numeric.evaluate(program, [*numbers, us]))


@pytest.mark.parametrize("size", SIZES[Ellipse])
def test_without_sliding_the_cones_are_one_spring(size):
    """-D min(u_0, 0), D of the normal force alone; at 2 (k - 1) edges for the pyramid."""

    @jax.jit
    def pull(u):
        ellipse = Ellipse.make(np.array(0.5), np.ones(size - 1), True, 1.0)
        pyramid = Pyramid.make(0.5, np.ones(size - 1), True, 1.0)
        return -ellipse.slope(u), -pyramid.slope(u)[0], pyramid.stiffness

    for u in (0.7, -0.7):
        force, normal_force, stiffness = pull(u * np.eye(size)[0])
        np.testing.assert_allclose(force, np.eye(size)[0] * max(-u, 0) / 0.5)
        np.testing.assert_allclose(normal_force, 2 * (size - 1) * stiffness * max(-u, 0))


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize("size", [3, 4, 6])
def test_stiffness_is_mujocos(cone, size):
    """D of a ball that presses on the ground, by `efc_D` and the regularisation of its normal force alone."""
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option cone="{cone}" impratio="3"/><worldbody>
    <geom type="plane" size="1 1 1" condim="{size}" friction=".7 .2 .1"/>
    <body pos="0 0 .08"><freejoint/><geom size=".1" friction=".6 .3 .05"/></body></worldbody></mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    impedance = data.efc_KBIP[0, 2]
    regularization = model.body_invweight0[1, 0] * (1 - impedance) / impedance
    kind = Ellipse if cone == "elliptic" else Pyramid
    ours = kind.make(np.array(regularization), data.contact.friction[0, : size - 1], True, 3.0)
    np.testing.assert_allclose(np.broadcast_to(ours.stiffness, len(data.efc_D)), data.efc_D, rtol=1e-12)
    if cone == "elliptic":
        np.testing.assert_allclose(ours.ratio, data.contact.mu, rtol=1e-12)


@cones
def test_value_is_the_function(kind, size):
    """In all zones; the solver compares two points by it."""
    cone, u = draw(kind, size, 3)
    ours = jax.jit(jax.vmap(lambda u: type(cone).value(cone, u)))(u)
    np.testing.assert_allclose(ours, [energy(cone, x) for x in u], rtol=1e-12, atol=1e-300)
