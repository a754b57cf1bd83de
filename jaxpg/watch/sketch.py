"""A grid of pictures without OpenGL: the same as `jaxpg.watch.canvas`, drawn by NumPy and Pillow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from PIL import Image, ImageDraw

from jaxpg.watch import marks, raster, solids, space
from jaxpg.watch.canvas import BACKDROP, BORDER, EMPTY, GRID, Cell, effort_color, effort_points, find_motors
from jaxpg.watch.drawing import CORNERS, find_camera, is_planar
from jaxpg.watch.raster import Camera, Raster
from jaxpg.watch.solids import Part, Solid
from jaxpg.watch.space import Framing

FINENESS = 2  # pixels that are drawn for each one that is shown, in both directions: smooths edges
NEAR = 0.02  # nothing nearer is drawn, times the radius of the picture
INK, BOX = (255, 255, 255), (90, 95, 102)  # of captions
CORNER, PADDING = (12, 10), 4  # of captions [pixels]
FARTHEST = 1e5  # a line that leads farther out of the picture is not drawn [pixels]
ARROW = 3  # width of an effort's line [pixels]


class Sketch:
    """Draws pictures side by side into one image; a context manager, like `Canvas`.

    Args:
      model: `mujoco.MjModel`, seen by the camera of `drawing.find_camera` if it has one.
      grid: number of rows and columns.
      size: width and height of one picture [pixels].
      goal_radius: radius of the sphere that marks the goal [m].
      site: index of the site whose frame should become the goal's.
      framing: how a model without a camera is seen, and how large the picture is.
    """

    def __init__(
        self,
        model: Any,
        grid: tuple[int, int],
        size: tuple[int, int],
        goal_radius: float | None,
        site: int | None,
        framing: Framing,
    ):
        self._model, self._data, self._grid, self._size = model, mujoco.MjData(model), grid, size
        self._goal_radius, self._site, self._framing = goal_radius, site, framing
        self._is_planar = is_planar(model)
        self._parts, self._motors = solids.make_parts(model), find_motors(model)
        self._normals = [raster.find_normals(part.solid) for part in self._parts]

    def __enter__(self) -> Sketch:
        return self

    def __exit__(self, *exception: object) -> None:
        pass

    def draw(self, cells: Sequence[Cell]) -> np.ndarray:
        """Image `[rows * height, columns * width, 3]`: the first picture is at the top left, the next to its right."""
        (rows, columns), (width, height) = self._grid, self._size
        image = np.full((rows * height, columns * width, 3), round(255 * EMPTY[0]), np.uint8)
        for i, cell in enumerate(cells):
            top, left = height * (i // columns), width * (i % columns)
            image[top : top + height, left : left + width] = self._draw(cell)
        image[height::height] = BORDER
        image[:, width::width] = BORDER
        return image

    def _draw(self, cell: Cell) -> np.ndarray:
        """One picture, `[height, width, 3]`."""
        model, data, shift = self._model, self._data, np.zeros(3) if cell.shift is None else cell.shift
        data.qpos = cell.qpos
        mujoco.mj_fwdPosition(model, data)
        camera = make_camera(model, data, self._framing, shift, (FINENESS * self._size[0], FINENESS * self._size[1]))
        picture = Raster(self._draw_background(camera, shift), np.zeros(camera.size[::-1]))
        for part, normals in zip(self._parts, self._normals, strict=True):
            _paint_part(picture, camera, data, part, normals)
        if cell.goal is not None:
            self._draw_goal(picture, camera, cell.goal, cell.rotation)
        image = Image.fromarray(np.rint(255 * picture.color).astype(np.uint8)).resize(self._size, Image.Resampling.BOX)
        shown = camera._replace(size=self._size, focal=camera.focal / FINENESS)
        pen = ImageDraw.Draw(image)
        for motor in self._motors:
            self._draw_effort(pen, shown, motor, float(np.clip(cell.efforts[motor], -1, 1)))
        if cell.caption:
            left, top, right, bottom = pen.textbbox(CORNER, cell.caption)
            pen.rectangle((left - PADDING, top - PADDING, right + PADDING, bottom + PADDING), fill=BOX)
            pen.text(CORNER, cell.caption, fill=INK)
        return np.asarray(image)

    def _draw_background(self, camera: Camera, shift: np.ndarray) -> np.ndarray:
        """Something light, with a grid on the ground unless the robot is planar, `[H, W, 3]` in [0, 1]."""
        image = Image.new("RGB", camera.size, tuple(round(255 * x) for x in BACKDROP))
        pen = ImageDraw.Draw(image)
        if not self._is_planar:
            for ends in space.list_grid(self._framing, self._framing.center + shift):
                _draw_line(pen, camera, np.stack(ends))
        return np.asarray(image) / 255.0

    def _draw_goal(self, picture: Raster, camera: Camera, place: np.ndarray, rotation: np.ndarray | None) -> None:
        """A sphere that can be seen through; with an orientation also the axes of the goal's frame and the site's."""
        radius = self._goal_radius or marks.DOT * float(self._model.stat.extent)
        for frame in marks.list_frames(self._data, place, rotation, self._site, self._framing.radius, radius):
            _paint_axes(picture, camera, frame)
        ball = solids.make_solid(place[None], radius)
        _paint_solid(picture, camera, ball, raster.find_normals(ball), np.array(marks.GOAL[:3]), marks.GOAL[3])

    def _draw_effort(self, pen: Any, camera: Camera, motor: int, effort: float) -> None:
        points = effort_points(self._model, self._data, motor, effort, camera.eye, camera.axes[1])
        if points is None:
            return
        seen = raster.project(camera, points)
        if (seen[:, 2] > camera.near).all():
            color = tuple(round(255 * x) for x in effort_color(effort)[:3])
            pen.line([(float(x), float(y)) for x, y, _ in seen], fill=color, width=ARROW, joint="curve")
            _draw_head(pen, seen[-2:, :2], color)


def make_camera(model: Any, data: Any, framing: Framing, shift: np.ndarray, size: tuple[int, int]) -> Camera:
    """The model's own camera, or one that sees the framing moved by a shift; pictures that are upright see no less."""
    number, near = find_camera(model), NEAR * framing.radius
    fovy = math.radians(model.vis.global_.fovy if number is None else model.cam_fovy[number])
    focal = min(size) / 2 / math.tan(fovy / 2)
    if number is not None:
        return Camera(data.cam_xpos[number].copy(), data.cam_xmat[number].reshape(3, 3).T.copy(), focal, size, near)
    axes = space.make_axes(framing.azimuth, framing.elevation)
    eye = framing.center + shift + framing.radius / math.sin(fovy / 2) * axes[2]
    return Camera(eye, axes, focal, size, near)


def _draw_line(pen: Any, camera: Camera, ends: np.ndarray) -> None:
    """What the camera sees of a line of the grid with the ends `[2, 3]`."""
    seen = raster.project(camera, _clip_line(camera, ends))
    if np.isfinite(seen).all() and np.abs(seen[:, :2]).max() < FARTHEST:
        line = [(float(x), float(y)) for x, y, _ in seen]
        pen.line(line, fill=tuple(round(255 * x) for x in GRID[:3]), width=FINENESS)


def _clip_line(camera: Camera, ends: np.ndarray) -> np.ndarray:
    """What lies in front of the camera of a line `[2, 3]`; NaN if nothing does."""
    depth = (camera.eye - ends) @ camera.axes[2] - camera.near
    if (depth <= 0).all():
        return np.full((2, 3), np.nan)
    if (depth > 0).all():
        return ends
    crossing = ends[0] + depth[0] / (depth[0] - depth[1]) * (ends[1] - ends[0])
    return np.where(depth[:, None] > 0, ends, crossing)


def _paint_part(picture: Raster, camera: Camera, data: Any, part: Part, normals: np.ndarray) -> None:
    turn = data.xmat[part.body].reshape(3, 3)
    placed = part.solid._replace(vertices=part.solid.vertices @ turn.T + data.xpos[part.body])
    color = np.array([int(part.color[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    _paint_solid(picture, camera, placed, normals @ turn.T, color)


def _paint_solid(
    picture: Raster, camera: Camera, solid: Solid, normals: np.ndarray, color: np.ndarray, opacity: float = 1.0
) -> None:
    corners, in_front = raster.list_corners(camera, solid.vertices, solid.triangles)
    lights = raster.find_lights(camera, normals[in_front])
    raster.paint(picture, corners, lights, np.broadcast_to(color, (len(corners), 3)), opacity)


def _paint_axes(picture: Raster, camera: Camera, frame: marks.Frame) -> None:
    for i, color in enumerate(marks.AXES):
        half = np.full(3, frame.width / 2)
        half[i] = frame.length / 2
        middle = frame.place + frame.length / 2 * frame.rotation[:, i]
        bar = solids.make_solid(middle + CORNERS * half @ frame.rotation.T)
        _paint_solid(picture, camera, bar, raster.find_normals(bar), np.array(color[:3]))


def _draw_head(pen: Any, ends: np.ndarray, color: tuple[int, ...]) -> None:
    """An arrow's head at the second of two points in the picture."""
    way = ends[1] - ends[0]
    length = float(np.linalg.norm(way))
    if length < 1e-6:
        return
    ahead = way / length * 2 * ARROW
    sideways = np.array([-ahead[1], ahead[0]]) * 0.6
    tip = ends[1] + ahead
    pen.polygon([tuple(map(float, p)) for p in (tip, ends[1] + sideways, ends[1] - sideways)], fill=color)
