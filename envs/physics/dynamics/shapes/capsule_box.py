"""Contacts of a capsule with a box, by MuJoCo's method."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from envs.physics.dynamics.shapes.geometry import FAR, TINY, Contacts, Shape, join_contacts, touch_ball
from envs.physics.dynamics.shapes.spheres import find_face

# For each axis, the signs of the four edges along it; that along itself is 0.
EDGES = np.insert([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]], 0, 0, axis=1)[None].repeat(3, 0)
EDGES[1], EDGES[2] = EDGES[1][:, [1, 0, 2]], EDGES[2][:, [1, 2, 0]]


def touch_capsule_box(capsule: Shape, box: Shape, margin) -> Contacts:
    """Two contacts, of balls about two points of the capsule's axis: the closest to the box and one further along.

    The closest point is an end above a face, or inside, or the closest to an edge. The second is as far along the axis
    as this runs beside the box, from an end above a face, or if the axis leaves the first point along the box.
    """
    half = (capsule.rotation[:, 2] @ box.rotation) * capsule.size[1]
    middle = (capsule.position - box.position) @ box.rotation
    place, second, exists = find_places(middle, half, capsule.size[1], box.size)

    def touch_at(place):
        point = middle + place * half
        depth, normal = find_face(point, box.size)
        centre, radius = box.position + box.rotation @ point, capsule.size[0]
        return touch_ball(centre, radius, depth - radius, box.rotation @ normal)

    contact, other = touch_at(place), touch_at(place + second)
    return join_contacts(contact, other._replace(distance=jnp.where(exists, other.distance, FAR)))


def find_places(centre, half, half_length, size):
    """Where the balls are on the axis, in half lengths: the first, the second relative to it, and whether it exists."""
    ends = jnp.stack([centre - half, centre + half])
    outside = abs(ends) > size
    above = jnp.sum(outside, axis=1)
    excess = jnp.clip(ends, -size, size) - ends
    from_face = jnp.where(above <= 1, jnp.sum(excess * excess, axis=1), FAR)
    upper = from_face[1] < from_face[0]
    nearest_face = jnp.where(upper, from_face[1], from_face[0])
    best = _choose_edge(*_measure_edges(centre, half, half_length, size))
    at_edge = best["square"] < nearest_face - TINY
    sign = jnp.where(upper, 1.0, -1.0)
    place = jnp.where(at_edge, best["on_axis"], sign)
    lengths = jnp.where(half == 0, FAR, 2 * size / jnp.where(half == 0, 1.0, abs(half)))
    face_second, face_exists = _follow_face(ends, outside, half, size, sign, upper)
    corner_second, corner_exists = _follow_corner(best, half, half_length, lengths)
    edge_second, edge_exists = _follow_edge(best, half, lengths)
    middle = best["middle"]
    second = jnp.where(at_edge, jnp.where(middle, edge_second, corner_second), face_second)
    exists = jnp.where(at_edge, jnp.where(middle, edge_exists, corner_exists), face_exists)
    return place, second, exists


def _measure_edges(centre, half, half_length, size):
    """For each edge the squared distance of the axis, and where it is closest on the axis and on the edge, [3, 4].

    The last result is where MuJoCo takes it to be on the edge: at a corner if there it is for the endless axis, even
    if the end of the axis is beside the edge.
    """
    corners = jnp.asarray(EDGES, size.dtype) * size
    offset = corners - centre
    A, D = (size * size)[:, None], half_length * half_length
    B, U, V = -(size * half)[:, None], (size * centre)[:, None], offset @ half
    squares = half * half
    across = jnp.stack([squares[1] + squares[2], squares[2] + squares[0], squares[0] + squares[1]])
    determinant = A * across[:, None]
    aligned = determinant < TINY
    endless = jnp.clip((D * U - B * V) * (1 / jnp.where(aligned, 1.0, determinant)), -1, 1)
    y = jnp.clip((V - B * endless) * (1 / D), -1, 1)
    x = jnp.clip((U - B * y) * (1 / A), -1, 1)
    along = jnp.asarray(np.eye(3)[:, None], size.dtype) * (size[:, None] * x)[..., None]
    difference = offset - y[..., None] * half + along
    square = jnp.where(aligned, FAR, jnp.sum(difference * difference, axis=-1))
    return square, y, x, jnp.where(abs(x) < 1, endless, x)


def _choose_edge(squares, on_axis, on_edge, taken) -> dict[str, jax.Array]:
    """What the second contact depends on, for the closest edge, the first of equally close ones."""
    best = {}
    for axis in range(3):
        for edge in range(4):
            along, upper = np.arange(3) == axis, EDGES[axis, edge] > 0
            this = {
                "square": squares[axis, edge],
                "on_axis": on_axis[axis, edge],
                "on_edge": on_edge[axis, edge],
                "middle": abs(taken[axis, edge]) < 1,
                "corner": jnp.where(along, taken[axis, edge] >= 1, upper),
                "along": jnp.asarray(along),
            }
            closer = this["square"] < best["square"] - TINY if best else True
            best = {name: jnp.where(closer, this[name], best[name]) for name in this} if best else this
    return best


def _follow_face(ends, outside, half, size, sign, upper):
    """From an end above a face: to where the axis leaves the space above it."""
    end, above = jnp.where(upper, ends[1], ends[0]), jnp.where(upper, outside[1], outside[0])
    rate = jnp.where(half == 0, 1.0, -sign * half)
    exits = jnp.maximum((size - end) / rate, (-size - end) / rate)
    exits = jnp.where(above | (half == 0) | (exits <= 0), 2.0, exits)
    return -sign * jnp.minimum(2.0, jnp.min(exits)), jnp.any(above)


def _follow_corner(best, half, half_length, lengths):
    """From a corner: along the edge that the axis points along, or along the face between the other two."""
    inward = (half > 0) != best["corner"]
    x, y, z = inward
    odd = jnp.stack([(y == z) & (x != y), (x == z) & (x != y), (x == y) & (x != z)])
    direction = jnp.where(jnp.any(odd & inward), 1.0, -1.0)
    steep = jnp.any(odd & (half * half > 0.5 * half_length * half_length))
    edge = jnp.minimum(1 - direction * best["on_axis"], jnp.min(jnp.where(odd, lengths, FAR)))
    face = jnp.minimum(1 + direction * best["on_axis"], jnp.min(jnp.where(odd, FAR, lengths)))
    return direction * jnp.where(steep, edge, -face), jnp.any(odd)


def _follow_edge(best, half, lengths):
    """From the middle of an edge: across the face with which the axis makes the smaller angle."""
    inward = ((half > 0) != best["corner"]) & ~best["along"]
    x, y, z = inward
    exists = (x != y) != z  # one of two
    size = jnp.where(best["along"], -1.0, abs(half))
    a, b, c = size
    i, j, _ = best["along"]
    # of the other two axes the one that the capsule's axis is more along
    first = jnp.where(i, False, jnp.where(j, a >= c, a > b))
    second = jnp.where(j, False, jnp.where(i, b > c, b >= a))
    chosen = jnp.stack([first, second, ~first & ~second])
    forward = jnp.any(chosen & inward)
    direction = jnp.where(forward, 1.0, -1.0)
    along = jnp.any(best["along"] & (half > 0))
    rest = jnp.where(along == forward, 1 - best["on_edge"], 1 + best["on_edge"])
    reach = jnp.minimum(1 - direction * best["on_axis"], jnp.min(jnp.where(chosen, lengths, FAR)))
    return direction * jnp.minimum(reach, 0.5 * rest * jnp.min(jnp.where(best["along"], lengths, FAR))), exists
