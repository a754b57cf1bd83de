"""Fixed features of observations, for policies and values that are linear in them.

The functions take arrays `[..., n]` of observations with mean 0 and standard deviation 1, as the normalizer returns
them. There is no constant feature, as the layer above has a bias.
"""

from __future__ import annotations

import itertools
import math

import jax
import jax.numpy as jnp

BOUND = 3.0  # Fourier and radial features cover [-3, 3]^n: 99.7 % of a normalized Gaussian on each axis


def identity(x: jax.Array, order: int = 1) -> jax.Array:
    """phi(x) = x; the order is not used.

    Source: the lesson, section 7.
    """
    return x


def polynomial(x: jax.Array, order: int) -> jax.Array:
    """All monomials of degree 1 to `order`.

        phi_c(x) = prod_i x_i^{c_i},    1 <= sum_i c_i <= order

    Args:
      x: `[..., n]`.
      order: highest degree, at least 1.

    Returns:
      `[..., (n + order)! / (n! order!) - 1]`, by degree.

    Source: Sutton and Barto, Reinforcement Learning, 2nd edition, section 9.5.1.

    >>> polynomial(jnp.array([2.0, 3.0]), 2).tolist()
    [2.0, 3.0, 4.0, 6.0, 9.0]
    """
    return jnp.stack([math.prod(x[..., i] for i in c) for c in monomials(x.shape[-1], order)], axis=-1)


def monomials(size: int, order: int) -> list[tuple[int, ...]]:
    """The factors of each of the `polynomial` features, as indices into the observation.

    >>> monomials(2, 2)
    [(0,), (1,), (0, 0), (0, 1), (1, 1)]
    """
    degrees = range(1, order + 1)
    return [c for degree in degrees for c in itertools.combinations_with_replacement(range(size), degree)]


def fourier(x: jax.Array, order: int) -> jax.Array:
    """Cosines with all frequencies up to `order` along each axis.

        phi_c(x) = cos(pi c . z),    z = (clip(x, -3, 3) + 3) / 6 in [0, 1]^n,    c in {0, ..., order}^n, c != 0

    Args:
      x: `[..., n]`.
      order: highest frequency on each axis, at least 1.

    Returns:
      `[..., (order + 1)^n - 1]`.

    Source: Konidaris, Osentoski and Thomas, AAAI 2011.

    >>> fourier(jnp.array([[-3.0], [0.0], [3.0]]), 1)[:, 0].round(3).tolist()
    [1.0, -0.0, -1.0]
    """
    z = (jnp.clip(x, -BOUND, BOUND) + BOUND) / (2 * BOUND)
    frequencies = list(itertools.product(range(order + 1), repeat=x.shape[-1]))[1:]
    return jnp.cos(jnp.pi * z @ jnp.array(frequencies, x.dtype).T)


def radial(x: jax.Array, order: int) -> jax.Array:
    """Gaussian bumps on a grid, normalized to sum 1.

        phi_j(x) proportional to exp(-|x - c_j|^2 / (2 h^2)),    c_j on the grid of `order` points per axis in [-3, 3]^n

    with h the distance between neighbours. Outside the grid the nearest bumps dominate.

    Args:
      x: `[..., n]`.
      order: grid points on each axis, at least 2.

    Returns:
      `[..., order^n]`.

    Source: Sutton and Barto, Reinforcement Learning, 2nd edition, section 9.5.5; Doya, Neural Computation 12(1), 2000.

    >>> radial(jnp.zeros(2), 2).tolist()
    [0.25, 0.25, 0.25, 0.25]
    """
    axis = jnp.linspace(-BOUND, BOUND, order, dtype=x.dtype)
    width = 2 * BOUND / (order - 1)
    # |x - c|^2 is a sum over the axes, so each bump is a product of one-dimensional bumps.
    bumps = jnp.ones((*x.shape[:-1], 1), x.dtype)
    for i in range(x.shape[-1]):
        axis_bumps = jax.nn.softmax(-(((x[..., i : i + 1] - axis) / width) ** 2) / 2, axis=-1)
        bumps = (bumps[..., :, None] * axis_bumps[..., None, :]).reshape(*x.shape[:-1], -1)
    return bumps
