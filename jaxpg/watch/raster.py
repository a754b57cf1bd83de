"""Triangles as pixels, by NumPy: each pixel shows the nearest triangle. The page's script `raster.js` does the same."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from jaxpg.watch.solids import Solid

CREASE = math.cos(math.radians(40))  # at a sharper edge the light changes at once
DARKEST, BRIGHTEST = 0.45, 1.1  # light of what faces away, and of what faces the light
LIGHT = np.array([-0.4, 0.5, 0.6])  # where it comes from, in the camera's axes: over the viewer's left shoulder


class Camera(NamedTuple):
    """A camera in perspective.

    Attributes:
      eye: where it is, `[3]` [m].
      axes: right, up and towards the viewer, `[3, 3]`.
      focal: pixels of a metre that is one metre away.
      size: width and height of its picture [pixels].
      near: nothing nearer is drawn [m].
    """

    eye: np.ndarray
    axes: np.ndarray
    focal: float
    size: tuple[int, int]
    near: float


class Raster(NamedTuple):
    """A picture under way.

    Attributes:
      color: red, green and blue in [0, 1], `[H, W, 3]`.
      nearness: 1 / depth of what is seen, 0 where nothing is, `[H, W]`.
    """

    color: np.ndarray
    nearness: np.ndarray


def project(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Pixels from the left and from the top, and the depth in front of the camera [m], of points `[..., 3]`."""
    right, up, back = np.moveaxis((points - camera.eye) @ camera.axes.T, -1, 0)
    (width, height), depth = camera.size, -back
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = camera.focal / depth
        return np.stack([width / 2 + scale * right, height / 2 - scale * up, depth], axis=-1)


def find_normals(solid: Solid) -> np.ndarray:
    """Unit normals at the corners of each triangle `[T, 3, 3]`: the mean of the faces that go on smoothly there.

    A face counts by its area, and goes on smoothly if it is turned by less than 40 degrees.
    """
    a, b, c = (solid.vertices[solid.triangles[:, k]] for k in range(3))
    faces = np.cross(b - a, c - a)
    units = faces / np.maximum(np.linalg.norm(faces, axis=1), 1e-300)[:, None]
    meets = np.zeros((len(solid.vertices), len(faces)))
    meets[solid.triangles.T, np.arange(len(faces))] = 1.0
    smooth = (units @ units.T > CREASE).astype(float)
    sums = np.stack([(meets[solid.triangles[:, k]] * smooth) @ faces for k in range(3)], axis=1)
    return sums / np.maximum(np.linalg.norm(sums, axis=-1), 1e-300)[..., None]


def find_lights(camera: Camera, normals: np.ndarray) -> np.ndarray:
    """How bright surfaces with these normals `[..., 3]` are: darkest where they face away from the light."""
    direction = LIGHT @ camera.axes + [0.0, 0.0, 0.3]
    facing = np.clip(normals @ (direction / np.linalg.norm(direction)), -1.0, 1.0)
    return DARKEST + (BRIGHTEST - DARKEST) * (0.5 + 0.5 * facing) ** 1.5


def paint(raster: Raster, corners: np.ndarray, lights: np.ndarray, color: np.ndarray, opacity: float = 1.0) -> None:
    """Paints triangles into a picture; those that face away, or do not lie in front of the camera, are left out.

    Light and 1 / depth are linear in the picture between the corners. What is not opaque is mixed with what is behind
    it, and hides nothing. It must be convex, so that a pixel shows it once.

    Args:
      raster: the picture, which is changed.
      corners: pixels from the left, from the top, and 1 / depth of the corners, `[T, 3, 3]`.
      lights: how bright the corners are, `[T, 3]`.
      color: of each triangle, `[T, 3]`.
      opacity: 1 hides what is behind, 0 is not seen.
    """
    height, width = raster.nearness.shape
    (ax, ay, _), (bx, by, _), (cx, cy, _) = np.moveaxis(corners, 0, -1)
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    low, high = corners[..., :2].min(axis=1), corners[..., :2].max(axis=1)
    first = np.maximum(np.ceil(low - 0.5), 0).astype(int)
    last = np.minimum(np.floor(high - 0.5), [width - 1, height - 1]).astype(int)
    number = np.where((area < 0) & (last >= first).all(axis=1), np.prod(np.maximum(last - first + 1, 0), axis=1), 0)
    owner = np.repeat(np.arange(len(corners)), number)
    offset = np.arange(len(owner)) - np.repeat(np.cumsum(number) - number, number)
    columns = (last - first + 1)[owner, 0]
    column, row = first[owner, 0] + offset % columns, first[owner, 1] + offset // columns
    x, y, size = column + 0.5 - ax[owner], row + 0.5 - ay[owner], area[owner]
    b = (x * (cy - ay)[owner] - y * (cx - ax)[owner]) / size
    c = (y * (bx - ax)[owner] - x * (by - ay)[owner]) / size
    weights = np.stack([1 - b - c, b, c], axis=-1)
    near = np.einsum("pk,pk->p", weights, corners[owner, :, 2])
    seen = (weights >= 0).all(axis=1) & (near > raster.nearness[row, column])
    order = np.flatnonzero(seen)[np.argsort(near[seen])]  # the nearest last: it stays
    owner, row, column, weights = owner[order], row[order], column[order], weights[order]
    shade = np.einsum("pk,pk->p", weights, lights[owner])[:, None] * color[owner]
    if opacity == 1.0:
        raster.nearness[row, column] = near[order]
    raster.color[row, column] += opacity * (np.minimum(shade, 1.0) - raster.color[row, column])


def list_corners(camera: Camera, points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners `[K, 3, 3]` for `paint` of triangles `[T, 3]` of points `[V, 3]`, and which are in front, `[T]`."""
    seen = project(camera, points)
    in_front = (seen[triangles, 2] > camera.near).all(axis=1)
    corners = seen[triangles[in_front]].copy()
    corners[..., 2] = 1 / corners[..., 2]
    return corners, in_front
