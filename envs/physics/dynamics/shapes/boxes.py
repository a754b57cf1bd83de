"""Contacts of two boxes, by MuJoCo's method: separating axes, then the overlap of two faces or two crossing edges."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from envs.physics.dynamics.shapes.geometry import FAR, TINY, Contacts, Shape, make_frame, measure

# Tolerances of float64 and float32. SLACK: of a separation, relative to the sizes. SINE: squared, below which edges are
# parallel. SHORT: of a side of the overlap, relative to the side it is a part of. ALONG: of a slope.
SLACK, SINE, SHORT, ALONG = (1e-13, 1e-6), (1e-16, 1e-7), (1e-7, 1e-5), (1e-12, 1e-6)
BIAS = 1e-6  # by which a crossing of edges must be less deep than a face, relative to its depth


def touch_box_box(one: Shape, other: Shape, margin) -> Contacts:
    """Eight contacts: the corners of the overlap of two faces, or one, between two edges.

    Of the 15 axes that may separate the boxes, the 6 normals of their faces and the 9 vector products of their edges,
    the one of least overlap decides. Faces that touch along a line without overlap, to the last digit, have one contact
    there, where MuJoCo has two.
    """
    turn = one.rotation.T @ other.rotation
    offset = (other.position - one.position) @ one.rotation
    back = (one.position - other.position) @ other.rotation
    face_gap, face = _find_largest(_measure_faces(turn, offset, back, one.size, other.size))
    gaps = _measure_crossings(turn, offset, one.size, other.size)
    edge_gap, first, second, exists = _find_crossing(gaps, face_gap)
    edge = _cross_edges(turn, offset, one.size, other.size, first, second)
    # a crossing along almost the normal of the face is not worth the face's many contacts
    cosine = abs(_select(face, jnp.concatenate([edge["normal"], edge["normal"] @ turn])))
    crossing = exists & ~((cosine > 0.99) & (edge_gap < face_gap + 0.05 * abs(face_gap) + TINY))
    distance, points, normal = _overlap_faces(one, other, turn, offset, back, face)
    distance = jnp.where(crossing, jnp.full(8, FAR, turn.dtype).at[0].set(edge["distance"]), distance)
    points = points.at[0].set(jnp.where(crossing, one.position + one.rotation @ edge["point"], points[0]))
    frame = make_frame(jnp.where(crossing, one.rotation @ edge["normal"], normal))
    slack = margin + _pick(SLACK, turn) * (jnp.sum(one.size) + jnp.sum(other.size))
    apart = jnp.maximum(face_gap, gaps.max()) > slack
    return Contacts(jnp.where(apart, FAR, distance), points, jnp.stack([frame] * 8))


def _pick(tolerances: tuple[float, float], like: jax.Array) -> float:
    return tolerances[0] if like.dtype == jnp.float64 else tolerances[1]


def _find_largest(values) -> tuple[jax.Array, jax.Array]:
    """The largest number and which one it is, [n] of booleans, the first of equal ones."""
    largest, which = values[0], 0
    for k in range(1, len(values)):
        larger = values[k] > largest
        largest, which = jnp.where(larger, values[k], largest), jnp.where(larger, k, which)
    return largest, jnp.equal(which, np.arange(len(values)))


def _select(which, values):
    """The values of the one that is chosen."""
    result = values[-1]
    for k in reversed(range(len(values) - 1)):
        result = jnp.where(which[k], values[k], result)
    return result


def _measure_faces(turn, offset, back, size, other_size) -> jax.Array:
    """The separations along the normals of the first box's faces and the second's, [6]."""
    absolute = abs(turn)
    first = abs(offset) - size - absolute @ other_size
    return jnp.concatenate([first, abs(back) - other_size - size @ absolute])


def _measure_crossings(turn, offset, size, other_size) -> jax.Array:
    """The separations along e_i x r_j, for the edges e_i of the first box and r_j of the second, at 3 i + j."""
    absolute, square = abs(turn), turn * turn
    ahead, behind = np.roll(np.arange(3), -1), np.roll(np.arange(3), 1)
    gaps = []
    for i, k, m in zip(range(3), ahead, behind, strict=True):
        across = abs(offset[m] * turn[k] - offset[k] * turn[m])
        reach = size[k] * absolute[m] + size[m] * absolute[k]
        other_reach = other_size[ahead] * absolute[i, behind] + other_size[behind] * absolute[i, ahead]
        sine = square[k] + square[m]
        parallel = sine < _pick(SINE, turn)
        gap = (across - reach - other_reach) / jnp.sqrt(jnp.where(parallel, 1.0, sine))
        gaps.append(jnp.where(parallel, -FAR, gap))
    return jnp.concatenate(gaps)


def _find_crossing(gaps, face_gap) -> tuple[jax.Array, ...]:
    """The largest separation if it is above the faces', its edge of either box, [3], and whether there is one."""
    largest, which = face_gap, -1
    for k, gap in enumerate(gaps):
        better = (gap - BIAS * abs(gap) > largest) & (gap > face_gap)
        largest, which = jnp.where(better, gap, largest), jnp.where(better, k, which)
    row = jnp.where(which < 3, 0, jnp.where(which < 6, 1, 2))
    return largest, jnp.equal(row, np.arange(3)), jnp.equal(which - 3 * row, np.arange(3)), jnp.greater_equal(which, 0)


def _cross_edges(turn, offset, size, other_size, first, second) -> dict[str, jax.Array]:
    """The contact of the edge e_i of the first box with the edge r_j of the second, in the first box's frame."""
    x, y, z = direction = _select(second, turn.T)
    zero = jnp.zeros_like(x)
    rows = [jnp.stack(row) for row in ([zero, -z, y], [z, zero, -x], [-y, x, zero])]
    normal = _select(first, rows)
    normal = normal / measure(normal @ normal)[1]
    normal = jnp.where(normal @ offset < 0, -normal, normal)
    corner = jnp.where(first, 0.0, jnp.where(normal >= 0, size, -size))
    other_corner = jnp.where(second, 0.0, jnp.where(normal @ turn >= 0, -other_size, other_size))
    gap = offset + turn @ other_corner - corner
    along, other_along, cosine = _select(first, gap), direction @ gap, _select(first, direction)
    reach, other_reach = _select(first, size), _select(second, other_size)
    sine = 1 - cosine * cosine
    place = (along - cosine * other_along) / jnp.where(sine < TINY, 1.0, sine)
    other_place = jnp.clip(cosine * jnp.clip(place, -reach, reach) - other_along, -other_reach, other_reach)
    place = jnp.clip(along + cosine * other_place, -reach, reach)
    start = corner + jnp.where(first, place, 0.0)
    end = corner + gap + other_place * direction
    return {"normal": normal, "distance": (end - start) @ normal, "point": 0.5 * (start + end)}


def _overlap_faces(one, other, turn, offset, back, face):
    """Distances and points of the overlap's corners, and the normal.

    The reference face is that of the deepest axis, the incident face the other box's that is most opposed to it. In
    the frame of the reference face x and y are along it and z is the height above it.
    """
    of_first = face[0] | face[1] | face[2]
    axis = face[:3] | face[3:]
    size, extent = (jnp.where(of_first, a, b) for a, b in ((one.size, other.size), (other.size, one.size)))
    columns = jnp.where(of_first, one.rotation, other.rotation).T
    axes, middle = jnp.where(of_first, turn, turn.T), jnp.where(of_first, offset, back)
    size, columns, axes, middle = (_roll(axis, x) for x in (size, columns, axes, middle))
    side = jnp.where(middle[2] >= 0, 1.0, -1.0)
    above = jnp.stack([jnp.ones_like(side), jnp.ones_like(side), side])
    opposed = _find_largest(abs(axes[2]))[1]
    u, v, w = _roll(opposed, axes.T) * above * _roll(opposed, extent)[:, None]
    centre = middle * above + jnp.where(w[2] > 0, -w, w) - size * np.array([0, 0, 1])
    corners, exists = _list_corners(centre, u, v, size)
    x, y, z = corners.T
    points = jnp.stack([x, y, side * (size[2] + 0.5 * z)], axis=1) @ columns
    position = jnp.where(of_first, one.position, other.position)
    return jnp.where(exists, z, FAR), position + points, columns[2] * jnp.where(of_first, side, -side)


def _list_corners(centre, u, v, size):
    """The corners of the part of the face c + a u + b v, |a|, |b| <= 1, above the rectangle, [8, 3], and which exist.

    A corner is where a side of the part begins, going around, and a side is a part of a side of one of the two.
    """
    area = u[0] * v[1] - u[1] * v[0]
    v, area = jnp.where(area < 0, -v, v), jnp.where(area == 0, 1.0, abs(area))
    places, exist = _clip_sides(centre[:2], u[:2], v[:2], size[:2], 1.0)
    corners = centre + places[:, :1] * u + places[:, 1:] * v
    # the rectangle's sides, in the face's coordinates (a, b)
    invert = jnp.stack([jnp.stack([v[1], -v[0]]), jnp.stack([-u[1], u[0]])]) / area
    right, upward, origin = invert[:, 0] * size[0], invert[:, 1] * size[1], -(invert @ centre[:2])
    places, others_exist = _clip_sides(origin, right, upward, jnp.ones_like(right), -1.0)
    rise = jnp.stack([u[2], v[2]])
    height = centre[2] + origin @ rise + places @ jnp.stack([right @ rise, upward @ rise])
    others = jnp.concatenate([places * size[:2], height[:, None]], axis=1)
    return jnp.concatenate([corners, others]), jnp.concatenate([exist, others_exist])


def _roll(which, values):
    """The values in cyclic order, so that the chosen one is the last."""
    values = list(values)
    return jnp.stack([_select(which, [values[(k + n + 1) % 3] for k in range(3)]) for n in range(3)])


def _clip_sides(centre, u, v, half, closed):
    """Where the sides of the parallelogram c + a u + b v, |a|, |b| <= 1, begin in the rectangle |x| <= half.

    Returns (a, b), [4, 2], and whether any part of the side is in the rectangle, [4]; one along the rectangle's side
    counts as in it if `closed` is 1, not if it is -1. The sides go around counterclockwise.
    """
    low, high, exists = _clip_lines(centre, u, v, half, closed)
    low_v, high_v, exists_v = _clip_lines(centre, v, u, half, closed)
    minus, plus = -jnp.ones_like(low[0]), jnp.ones_like(low[0])
    begins = [[low[0], minus], [plus, low_v[1]], [high[1], plus], [minus, high_v[0]]]
    return jnp.stack([jnp.stack(place) for place in begins]), jnp.stack(
        [exists[0], exists_v[1], exists[1], exists_v[0]]
    )


def _clip_lines(centre, along, across, half, closed):
    """The interval of t in which c + t u - v, and c + t u + v, |t| <= 1, are in the rectangle, and whether there is."""
    base = centre + jnp.asarray([[-1.0], [1.0]], centre.dtype) * across
    flat = abs(along) < _pick(ALONG, along) * half
    inverse = 1 / jnp.where(flat, 1.0, along)
    reach = jnp.where(
        flat, jnp.where(abs(base) <= half * (1 + closed * _pick(ALONG, along)), 2.0, -2.0), half * abs(inverse)
    )
    middle = jnp.where(flat, 0.0, -base * inverse)
    low, high = middle - reach, middle + reach
    low = jnp.maximum(jnp.maximum(low[:, 0], low[:, 1]), -1.0)
    high = jnp.minimum(jnp.minimum(high[:, 0], high[:, 1]), 1.0)
    return low, high, high - low > _pick(SHORT, along)
