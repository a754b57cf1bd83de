"""Contacts of a plane, the first shape, with another shape."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from envs.physics.dynamics.shapes.geometry import TINY, Contacts, Shape, make_frame, make_frame_along, measure


def touch_plane_sphere(plane: Shape, sphere: Shape, margin: jax.Array) -> Contacts:
    """One contact: d = n (c - p) - r."""
    distance = _measure_height(plane, sphere) - sphere.size[0]
    return _touch(plane, sphere.position - sphere.size[0] * _get_normal(plane), distance)


def touch_plane_capsule(plane: Shape, capsule: Shape, margin: jax.Array) -> Contacts:
    """Two contacts, of the balls at the capsule's ends: d = n (c +- h a - p) - r; the tangent is along the capsule."""
    normal, axis = _get_normal(plane), capsule.rotation[:, 2]
    (radius, half_length), signs = capsule.size[:2], jnp.asarray([1.0, -1.0], axis.dtype)
    height = _measure_height(plane, capsule) - radius
    distance = height + signs * (half_length * (axis @ normal))
    lowest = (capsule.position - radius * normal) + signs[:, None] * (half_length * axis)
    frame = make_frame_along(normal, axis)
    return _touch(plane, lowest, distance)._replace(frame=jnp.stack([frame, frame]))


def touch_plane_ellipsoid(plane: Shape, ellipsoid: Shape, margin: jax.Array) -> Contacts:
    """One contact, at the ellipsoid's lowest point c - R S^2 R' n / |S R' n|."""
    scaled = ellipsoid.size * (_get_normal(plane) @ ellipsoid.rotation)
    length = jnp.sqrt(scaled @ scaled)
    lowest = ellipsoid.position - ellipsoid.rotation @ (ellipsoid.size * scaled / length)
    return _touch(plane, lowest, _measure_height(plane, ellipsoid) - length)


def touch_plane_cylinder(plane: Shape, cylinder: Shape, margin: jax.Array) -> Contacts:
    """Four contacts: the lowest points of both discs, and two more that make a triangle on the lower disc.

    If the discs are parallel to the plane, the first point is on the cylinder's x axis.
    """
    x_axis, y_axis, axis = cylinder.rotation.T
    radius, half_length = cylinder.size[:2]
    normal = _get_normal(plane)
    nx, ny, nz = normal @ cylinder.rotation
    tilt, divisor = measure(nx * nx + ny * ny)
    x, y = jnp.where(tilt < TINY, -1.0, nx / divisor), jnp.where(tilt < TINY, 0.0, ny / divisor)
    out = -radius * (x * x_axis + y * y_axis)  # from the axis to the lowest point of a disc
    side = jnp.where(nz > 0, -1.0, 1.0)  # of the lower disc
    across = (radius * jnp.sqrt(0.75) * side) * (x * y_axis - y * x_axis)
    end, rise = (side * half_length) * axis, half_length * abs(nz)
    height, fall = _measure_height(plane, cylinder), radius * tilt
    low, high, more = height - rise - fall, height + rise - fall, height - rise + 0.5 * fall
    centre = cylinder.position + end
    points = [centre + out, cylinder.position - end + out, centre + across - 0.5 * out, centre - across - 0.5 * out]
    return _touch(plane, jnp.stack(points), jnp.stack([low, high, more, more]))


def touch_plane_box(plane: Shape, box: Shape, margin: jax.Array) -> Contacts:
    """Four contacts: of every two opposite corners the lower one."""
    signs = jnp.asarray([[-1, -1, -1], [1, -1, -1], [-1, 1, -1], [1, 1, -1]], box.size.dtype)
    edges = box.rotation * box.size
    heights = signs @ (_get_normal(plane) @ edges)
    lower = jnp.where(heights > 0, -1.0, 1.0)
    corners = box.position + lower[:, None] * (signs @ edges.T)
    return _touch(plane, corners, _measure_height(plane, box) - abs(heights))


def _touch(plane: Shape, points: jax.Array, distance: jax.Array) -> Contacts:
    """Contacts of points of the other shape at known distances from the plane."""
    points, distance = points.reshape(-1, 3), distance.reshape(-1)
    normal = _get_normal(plane)
    frame = make_frame(normal)
    return Contacts(distance, points - 0.5 * distance[:, None] * normal, jnp.stack([frame] * len(distance)))


def _get_normal(plane: Shape) -> jax.Array:
    return plane.rotation[:, 2]


def _measure_height(plane: Shape, other: Shape) -> jax.Array:
    return (other.position - plane.position) @ _get_normal(plane)
