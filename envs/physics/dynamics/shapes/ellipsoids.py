"""Contacts with an ellipsoid, at the one pair of points where the normals of both shapes are opposite.

MuJoCo approaches these points until it is within `ccd_tolerance` of the distance; here they are found to rounding. If
one shape is so deep in the other that their points of opposite normals are many, MuJoCo looks for the nearest way
out, and these functions may find another.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from envs.physics.dynamics.shapes.geometry import Contacts, Shape, cross, make_frame, normalize, touch_ball

ROUNDS, NEWTON_ROUNDS = 6, 5
CENTRAL = (1e-9, 1e-5)  # in float64 and float32; a point nearer to a plane of symmetry is moved off it, in half axes


def touch_sphere_ellipsoid(sphere: Shape, ellipsoid: Shape, margin) -> Contacts:
    """One contact: the ball about a point whose distance from the ellipsoid is known."""
    point = (sphere.position - ellipsoid.position) @ ellipsoid.rotation
    distance, outward = measure_distance(point, ellipsoid.size)
    normal = -(ellipsoid.rotation @ outward)
    return touch_ball(sphere.position, sphere.size[0], distance - sphere.size[0], normal)


def touch_capsule_ellipsoid(capsule: Shape, ellipsoid: Shape, margin) -> Contacts:
    """One contact, of the ball about the point of the capsule's axis that is next to the ellipsoid.

    Seen along the axis the ellipsoid is an ellipse. If the endless axis passes by it, the ellipse's point next to it
    tells how far along it is; if it pierces the ellipsoid, the middle of the chord is taken.
    """
    first, second, axis = capsule.rotation.T @ ellipsoid.rotation
    middle = (capsule.position - ellipsoid.position) @ ellipsoid.rotation
    squares, (first, second) = _find_outline(first, second, ellipsoid.size)
    gap, (x, y) = measure_distance(jnp.stack([first @ middle, second @ middle]), jnp.sqrt(squares))
    towards = ellipsoid.size * (x * first + y * second)
    touched = ellipsoid.size * towards / jnp.sqrt(towards @ towards)
    scaled = axis / ellipsoid.size
    chord = -(scaled @ (middle / ellipsoid.size)) / (scaled @ scaled)
    place = jnp.where(gap > 0, (touched - middle) @ axis, chord)
    point = middle + jnp.clip(place, -capsule.size[1], capsule.size[1]) * axis
    distance, outward = measure_distance(point, ellipsoid.size)
    centre, normal = ellipsoid.position + ellipsoid.rotation @ point, -(ellipsoid.rotation @ outward)
    return touch_ball(centre, capsule.size[0], distance - capsule.size[0], normal)


def _find_outline(first, second, half_axes):
    """The squared half axes of an ellipsoid's outline in the plane of two directions, and their directions."""
    a, b = first * half_axes, second * half_axes
    half, mixed, mean = 0.5 * (a @ a - b @ b), a @ b, 0.5 * (a @ a + b @ b)
    root = jnp.sqrt(half * half + mixed * mixed + (1e-8 * mean) ** 2)
    cosine = jnp.sqrt(0.5 + 0.5 * abs(half) / root)
    sine = 0.5 * jnp.where(half < 0, -mixed, mixed) / (root * cosine)
    split = jnp.where(half < 0, -root, root)
    return jnp.stack([mean + split, mean - split]), (cosine * first + sine * second, cosine * second - sine * first)


def measure_distance(point: jax.Array, half_axes: jax.Array) -> tuple[jax.Array, jax.Array]:
    """A point's distance from an ellipsoid, or ellipse, about the origin, negative inside, and the normal there.

    The nearest point is s^2 p / (t + s^2) for the largest t with sum (s p / (t + s^2))^2 = 1. Newton's method for
    1 / sqrt(sum) = 1, which is almost linear in t, comes from below.
    """
    least = half_axes * (CENTRAL[0] if point.dtype == jnp.float64 else CENTRAL[1])
    point = jnp.where(abs(point) < least, jnp.where(point < 0, -least, least), point)
    scaled, squares = half_axes * point, half_axes * half_axes
    t = jnp.max(abs(scaled) - squares)
    for _ in range(ROUNDS):
        inverse = 1 / (t + squares)
        terms = (scaled * inverse) ** 2
        total = jnp.sum(terms)
        t = t + total * (jnp.sqrt(total) - 1) / (terms @ inverse)
    gradient = point / (t + squares)
    length = jnp.sqrt(gradient @ gradient)
    return t * length, gradient / length


def touch_ellipsoid_ellipsoid(one: Shape, other: Shape, margin) -> Contacts:
    """One contact, along the unit normal n that maximises the separation n d - |S R' n| - |S' R'' n|.

    Newton's method on the sphere starts with the direction between the centres where the ellipsoids' sum is a ball.
    """
    offset = (other.position - one.position) @ one.rotation
    squares = one.size * one.size
    other_axes = (one.rotation.T @ other.rotation) * other.size
    other_squares = other_axes @ other_axes.T
    start, length = normalize(solve(jnp.diag(squares) + other_squares, offset))
    normal = jnp.where(length == 0, jnp.asarray([1.0, 0.0, 0.0], offset.dtype), start)
    for _ in range(NEWTON_ROUNDS):
        length, other_length, point, other_point = _support(normal, squares, other_squares)
        separation = normal @ offset - length - other_length
        slope = offset - point - other_point
        slope = slope - (slope @ normal) * normal
        curvature = (jnp.diag(squares) - jnp.outer(point, point)) / length
        curvature += (other_squares - jnp.outer(other_point, other_point)) / other_length
        curvature += jnp.diag(jnp.broadcast_to(separation, 3)) + length * jnp.outer(normal, normal)
        step = solve(curvature, slope)
        normal = normalize(normal + step / jnp.sqrt(1 + step @ step))[0]
    length, other_length, point, other_point = _support(normal, squares, other_squares)
    distance = normal @ offset - length - other_length
    position = one.position + one.rotation @ (0.5 * (point + offset - other_point))
    return Contacts(distance[None], position[None], make_frame(one.rotation @ normal)[None])


def _support(normal, squares, other_squares):
    """The support functions h(n) of both ellipsoids and their gradients, the furthest points along n."""
    along, other_along = squares * normal, other_squares @ normal
    length, other_length = jnp.sqrt(normal @ along), jnp.sqrt(normal @ other_along)
    return length, other_length, along / length, other_along / other_length


def solve(matrix, right) -> jax.Array:
    """The solution of symmetric equations for three numbers, 0 if they have none."""
    first, second, third = matrix
    cofactors = jnp.stack([cross(second, third), cross(third, first), cross(first, second)])
    determinant = first @ cofactors[0]
    return jnp.where(determinant == 0, 0.0, (cofactors @ right) / jnp.where(determinant == 0, 1.0, determinant))
