"""Features against their formulas; linear, state-dependent and unsquashed policies."""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpg.distributions import GAUSSIAN, SQUASHED_GAUSSIAN, gaussian_log_prob
from jaxpg.features import fourier, polynomial, radial
from jaxpg.networks import linear_networks, mlp_networks, state_dependent
from jaxpg.program.networks import FEATURES, NUM_FEATURES, SIGMAS

X = 2 * np.random.default_rng(0).normal(size=(20, 2))  # some beyond 3, where Fourier features end


def test_polynomial_is_every_monomial():
    found = np.asarray(polynomial(jnp.asarray(X), 3))
    powers = [(i, j) for i in range(4) for j in range(4) if 1 <= i + j <= 3]
    expected = np.stack([X[:, 0] ** i * X[:, 1] ** j for i, j in powers], axis=1)
    order = np.argsort(expected[0])
    np.testing.assert_allclose(found[:, np.argsort(found[0])], expected[:, order], rtol=1e-5)


def test_fourier_is_every_frequency():
    z = (np.clip(X, -3, 3) + 3) / 6
    expected = [np.cos(np.pi * (z @ c)) for c in itertools.product(range(4), repeat=2)][1:]
    np.testing.assert_allclose(fourier(jnp.asarray(X), 3), np.stack(expected, axis=1), atol=1e-5)


def test_radial_is_a_normalized_grid_of_bumps():
    centres = np.array(list(itertools.product(np.linspace(-3, 3, 4), repeat=2)))
    bumps = np.exp(-((X[:, None] - centres) ** 2).sum(-1) / (2 * 2.0**2))
    expected = bumps / bumps.sum(1, keepdims=True)
    np.testing.assert_allclose(radial(jnp.asarray(X), 4), expected, atol=1e-6)


@pytest.mark.parametrize("name", FEATURES)
@pytest.mark.parametrize(("size", "order"), [(1, 2), (2, 3), (4, 2)])
def test_number_of_features(name, size, order):
    """As many as said, and none of them is a combination of the others."""
    with jax.enable_x64(True):
        found = FEATURES[name](jnp.asarray(np.random.default_rng(0).normal(size=(500, size))), order)
    assert found.shape == (500, NUM_FEATURES[name](size, order))
    assert np.linalg.matrix_rank(found) == found.shape[1]


@pytest.mark.parametrize("sigma", SIGMAS)
@pytest.mark.parametrize("make", [mlp_networks, linear_networks])
def test_sigma_begins_as_asked_and_is_learned_as_asked(make, sigma):
    """The gradient of log pi in the parameters that sigma has of its own is that in log sigma."""
    networks = make(2, 3, sigma=SIGMAS[sigma](0.7), distribution=GAUSSIAN)
    params = networks.init(jax.random.key(0))["actor"]
    obs = jnp.asarray(X, jnp.float32)
    mean, log_std = networks.policy(params, obs)
    np.testing.assert_allclose(jnp.exp(log_std), 0.7, rtol=0.05)
    assert log_std.shape == ((20, 3) if sigma == "state" else (3,))
    u = mean + 0.3

    def log_prob(params):
        return gaussian_log_prob(u, *networks.policy(params, obs)).sum()

    of_sigma = [
        np.abs(leaf).max()
        for path, leaf in jax.tree_util.tree_leaves_with_path(jax.grad(log_prob)(params))
        if "log_std" in jax.tree_util.keystr(path) or "MLP_1" in jax.tree_util.keystr(path)
    ]
    assert (
        len(of_sigma) == {"fixed": 0, "learned": 1, "scheduled": 1, "state": 2 if make is linear_networks else 6}[sigma]
    )
    assert all(size > 0 for size in of_sigma)


def test_sigma_of_the_state_has_bounds():
    """Within e^-3 and e^3 of the first value, however large the network's output is; near it sigma is exp of that."""
    networks = linear_networks(2, 1, sigma=state_dependent(0.5), distribution=GAUSSIAN)
    params = networks.init(jax.random.key(0))["actor"]
    kernel = params["params"]["MLP_1"]["Dense_0"]["kernel"]
    params["params"]["MLP_1"]["Dense_0"]["kernel"] = jnp.ones_like(kernel)
    obs = jnp.array([[1e4, 1e4], [-1e4, -1e4], [0.01, 0.02]])
    _, log_std = networks.policy(params, obs)
    expected = [0.5 * np.exp(3), 0.5 * np.exp(-3), 0.5 * np.exp(0.03)]
    np.testing.assert_allclose(np.exp(log_std[:, 0]), expected, rtol=1e-4)


def test_linear_networks_are_linear():
    """mu = W phi + b and V = w' phi + c: zero at first; second differences along any line in phi vanish."""
    networks = linear_networks(2, 1, features=partial(polynomial, order=2))
    params = networks.init(jax.random.key(0))
    assert all((leaf == 0).all() for leaf in jax.tree.leaves(params["critic"]))
    random = iter(jax.random.split(jax.random.key(1), 10))
    params = jax.tree.map(lambda x: jax.random.normal(next(random), x.shape), params)
    phi = np.asarray(polynomial(jnp.asarray(X, jnp.float32), 2))
    for found, layer in (
        (
            networks.policy(params["actor"], jnp.asarray(X, jnp.float32))[0],
            params["actor"]["params"]["MLP_0"]["Dense_0"],
        ),
        (networks.value(params["critic"], jnp.asarray(X, jnp.float32))[:, None], params["critic"]["params"]["Dense_0"]),
    ):
        np.testing.assert_allclose(
            found, phi @ np.asarray(layer["kernel"]) + np.asarray(layer["bias"]), rtol=1e-4, atol=1e-5
        )


def test_mlps_see_the_features():
    """An MLP of features is the MLP of identity, of as many observations, where these are the features."""
    phi = polynomial(jnp.asarray(X, jnp.float32), 2)
    of_features = mlp_networks(2, 1, (8,), features=partial(polynomial, order=2))
    plain = mlp_networks(phi.shape[-1], 1, (8,))
    params = plain.init(jax.random.key(0))
    assert jax.tree.map(jnp.shape, of_features.init(jax.random.key(1))) == jax.tree.map(jnp.shape, params)
    obs = jnp.asarray(X, jnp.float32)
    np.testing.assert_array_equal(of_features.value(params["critic"], obs), plain.value(params["critic"], phi))
    mean, _ = of_features.policy(params["actor"], obs)
    np.testing.assert_array_equal(mean, plain.policy(params["actor"], phi)[0])
    assert (mean != plain.policy(params["actor"], phi**2)[0]).any()


def test_actions_of_both_distributions():
    u = jnp.array([-3.0, 0.2, 2.0])
    np.testing.assert_array_equal(GAUSSIAN.action(u), u)
    np.testing.assert_allclose(SQUASHED_GAUSSIAN.action(u), np.tanh(u), rtol=1e-6)


@pytest.mark.parametrize("log_std", [-1.0, 0.0, 1.0])
def test_entropy_of_the_squashed_policy(log_std):
    """The sample's estimate against quadrature, and its gradient against finite differences of that."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(100)
    weights = weights / weights.sum()

    def exact(mean, log_std):
        u = mean + np.exp(log_std) * nodes
        log_jacobian = 2 * (np.log(2) - u - np.logaddexp(0, -2 * u))
        return log_std + 0.5 * np.log(2 * np.pi * np.e) + weights @ log_jacobian

    epsilon = jax.random.normal(jax.random.key(0), (200_000, 1))

    def estimates(mean, log_std):
        mean = jnp.full((200_000, 1), mean)
        u = jax.lax.stop_gradient(mean + jnp.exp(log_std) * epsilon)
        return SQUASHED_GAUSSIAN.entropy(u, mean, jnp.full(1, log_std))

    found = np.asarray(estimates(0.4, log_std), np.float64)
    assert abs(found.mean() - exact(0.4, log_std)) < 4 * found.std() / np.sqrt(len(found))
    in_mean, in_log_std = jax.grad(lambda *x: estimates(*x).mean(), argnums=(0, 1))(0.4, log_std)
    h = 1e-5
    np.testing.assert_allclose(in_mean, (exact(0.4 + h, log_std) - exact(0.4 - h, log_std)) / (2 * h), atol=0.01)
    np.testing.assert_allclose(in_log_std, (exact(0.4, log_std + h) - exact(0.4, log_std - h)) / (2 * h), atol=0.02)
