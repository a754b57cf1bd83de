"""Where rays meet shapes, and whether points are inside of them, as C MuJoCo's mju_rayGeom and mju_insideGeom."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from envs.physics.dynamics.numbers import SMALL
from envs.physics.dynamics.rotations import rotate_back

MISS = np.inf  # the distance of what a ray does not meet


def find_distance(shape: str, position, axes, size, origin, direction) -> Any:
    """How far a ray goes until it meets a shape from outside or, from within, leaves it; `MISS` if it does not.

    Args:
      shape: its name, as in `pairs.SHAPES`, of those in `SHAPES`.
      position, axes: of the shape, whose axes are columns, `[3]`, `[3, 3]`.
      size: MuJoCo's, `[3]`.
      origin, direction: of the ray, `[3]`; the direction has the length 1.
    """
    return SHAPES[shape][0](size, rotate_back(axes, origin - position), rotate_back(axes, direction))


def is_inside(shape: str, position, axes, size, point) -> Any:
    """Whether a point is inside of a shape; arguments as of `find_distance`."""
    return SHAPES[shape][1](size, rotate_back(axes, point - position))


def _solve(a, b, c) -> tuple[Any, Any]:
    """The solutions of a x^2 + 2 b x + c = 0, smaller first; `MISS` if there are none."""
    square = b * b - a * c
    is_real = (square >= 0) & (a >= SMALL)
    root = jnp.sqrt(jnp.where(is_real & (square > 0), square, 1.0)) * (square > 0)
    divisor = jnp.where(is_real, a, 1.0)
    return jnp.where(is_real, (-b - root) / divisor, MISS), jnp.where(is_real, (-b + root) / divisor, MISS)


def _meet_ball(radius, p, v) -> tuple[Any, Any]:
    """Where p + x v is on the surface of a ball."""
    return _solve((v * v).sum(), (v * p).sum(), (p * p).sum() - radius**2)


def _find_first(distances, accepted) -> Any:
    """The smallest distance that is not negative and accepted."""
    first = jnp.full((), MISS)
    for x, is_accepted in zip(distances, accepted, strict=True):
        first = jnp.minimum(first, jnp.where((x >= 0) & is_accepted, x, MISS))
    return first


def _at(x, p, v, i: int) -> Any:
    """Coordinate i of the ray at a distance, which may be `MISS`."""
    return p[i] + jnp.where(x < MISS, x, 0.0) * v[i]


def _reach_flat(half, p, v, i: int) -> list[Any]:
    """The distances at which coordinate i is -half and half."""
    moves = jnp.abs(v[i]) > SMALL
    speed = jnp.where(moves, v[i], 1.0)
    return [jnp.where(moves, (side * half - p[i]) / speed, MISS) for side in (-1.0, 1.0)]


def _meet_plane(size, p, v) -> Any:
    approaches = v[2] <= -SMALL
    x = -p[2] / jnp.where(approaches, v[2], 1.0)
    within = [(size[i] <= 0) | (jnp.abs(_at(x, p, v, i)) <= size[i]) for i in (0, 1)]
    return _find_first([x], [approaches & within[0] & within[1]])


def _meet_sphere(size, p, v) -> Any:
    return _find_first(_meet_ball(size[0], p, v), (True, True))


def _meet_capsule(size, p, v) -> Any:
    up = np.array([0.0, 0.0, 1.0]) * size[1]
    round_side = _solve(*(((x * y)[:2]).sum() - r for x, y, r in ((v, v, 0.0), (v, p, 0.0), (p, p, size[0] ** 2))))
    top, bottom = _meet_ball(size[0], p - up, v), _meet_ball(size[0], p + up, v)
    accepted = [jnp.abs(_at(x, p, v, 2)) <= size[1] for x in round_side]
    accepted += [_at(x, p, v, 2) >= size[1] for x in top] + [_at(x, p, v, 2) <= -size[1] for x in bottom]
    return _find_first((*round_side, *top, *bottom), accepted)


def _meet_ellipsoid(size, p, v) -> Any:
    return _meet_sphere(np.ones(3), p / size, v / size)


def _meet_cylinder(size, p, v) -> Any:
    round_side = _solve(*(((x * y)[:2]).sum() - r for x, y, r in ((v, v, 0.0), (v, p, 0.0), (p, p, size[0] ** 2))))
    flat = _reach_flat(size[1], p, v, 2)
    accepted = [jnp.abs(_at(x, p, v, 2)) <= size[1] for x in round_side]
    accepted += [_at(x, p, v, 0) ** 2 + _at(x, p, v, 1) ** 2 <= size[0] ** 2 for x in flat]
    return _find_first((*round_side, *flat), accepted)


def _meet_box(size, p, v) -> Any:
    distances, accepted = [], []
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        for x in _reach_flat(size[i], p, v, i):
            distances.append(x)
            accepted.append((jnp.abs(_at(x, p, v, j)) <= size[j]) & (jnp.abs(_at(x, p, v, k)) <= size[k]))
    return _find_first(distances, accepted)


def _is_in_capsule(size, p) -> Any:
    beyond = p[2] - jnp.clip(p[2], -size[1], size[1])
    return p[0] ** 2 + p[1] ** 2 + beyond**2 < size[0] ** 2


# For each shape: where a ray p + x v in its frame meets it, and whether p is inside.
SHAPES = {
    "plane": (_meet_plane, lambda size, p: p[2] < 0),
    "sphere": (_meet_sphere, lambda size, p: (p * p).sum() < size[0] ** 2),
    "capsule": (_meet_capsule, _is_in_capsule),
    "ellipsoid": (_meet_ellipsoid, lambda size, p: ((p / size) ** 2).sum() < 1),
    "cylinder": (
        _meet_cylinder,
        lambda size, p: (jnp.abs(p[2]) < size[1]) & (p[0] ** 2 + p[1] ** 2 < size[0] ** 2),
    ),
    "box": (_meet_box, lambda size, p: (jnp.abs(p) < size).all()),
}
