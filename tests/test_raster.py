"""Triangles as pixels: each pixel shows what a ray from the eye meets first, as bright as the light on it."""

import mujoco
import numpy as np
import pytest
from spatial import ARM

from jaxpg.watch import raster, solids, space
from jaxpg.watch.raster import Camera, Raster

SIZE = (60, 40)


def make_camera(azimuth=120.0, elevation=-20.0, distance=3.0, focal=60.0, center=(0.0, 0.0, 0.0)):
    axes = space.make_axes(azimuth, elevation)
    return Camera(np.array(center) + distance * axes[2], axes, focal, SIZE, 0.05)


def empty(size=SIZE):
    return Raster(np.zeros((size[1], size[0], 3)), np.zeros((size[1], size[0])))


def rays(camera):
    """The directions of the pixels' rays, which advance by 1 m in depth, `[H, W, 3]`."""
    x, y = np.meshgrid(np.arange(camera.size[0]) + 0.5, np.arange(camera.size[1]) + 0.5)
    right, up = (x - camera.size[0] / 2) / camera.focal, (camera.size[1] / 2 - y) / camera.focal
    return right[..., None] * camera.axes[0] + up[..., None] * camera.axes[1] - camera.axes[2]


def meet(camera, triangle):
    """Depth at which each ray meets a triangle, by Moeller and Trumbore; infinity where it does not; `[H, W]`."""
    a, b, c = triangle
    directions = rays(camera)
    across = np.cross(directions, c - a)
    determinant = across @ (b - a)
    u = across @ (camera.eye - a) / determinant
    other = np.cross(camera.eye - a, b - a)
    v = directions @ other / determinant
    inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (determinant > 0)  # from outside
    return np.where(inside, np.dot(other, c - a) / determinant, np.inf)


def paint_all(camera, scene, colors):
    picture = empty()
    for solid, color in zip(scene, colors, strict=True):
        corners, in_front = raster.list_corners(camera, solid.vertices, solid.triangles)
        lights = np.ones((len(corners), 3))
        raster.paint(picture, corners, lights, np.broadcast_to(color, (len(corners), 3)))
        assert in_front.all()
    return picture


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_each_pixel_shows_the_first_thing_that_its_ray_meets(seed):
    rng = np.random.default_rng(seed)
    scene = [solids.make_solid(rng.normal(scale=0.5, size=(12, 3)) + rng.normal(scale=0.4, size=3)) for _ in range(3)]
    camera, colors = make_camera(azimuth=rng.uniform(0, 360)), np.eye(3)
    picture = paint_all(camera, scene, colors)
    depths = np.stack([np.min([meet(camera, s.vertices[t]) for t in s.triangles], axis=0) for s in scene])
    first, nearest = depths.argmin(axis=0), depths.min(axis=0)
    expected = np.where(np.isfinite(nearest)[..., None], colors[first], 0.0)
    agrees = np.all(np.abs(picture.color - expected) < 1e-9, axis=-1)
    assert agrees.mean() > 0.995  # but for rays through an edge
    hit = agrees & np.isfinite(nearest)
    assert hit.sum() > 200
    np.testing.assert_allclose(1 / picture.nearness[hit], nearest[hit], rtol=1e-9)
    other = paint_all(camera, scene[::-1], colors[::-1])
    np.testing.assert_allclose(other.color, picture.color, atol=1e-9)  # in any order


def test_a_point_is_where_the_formula_of_a_pinhole_has_it():
    """x = W/2 + f (right . d) / depth, y = H/2 - f (up . d) / depth, with d from the eye."""
    camera, point = make_camera(azimuth=90.0, elevation=0.0, distance=2.0), np.array([0.3, 0.5, 0.2])
    x, y, depth = raster.project(camera, point)
    assert depth == pytest.approx(2.5)  # the eye is at y = -2
    assert (x, y) == (pytest.approx(30 + 60 * 0.3 / 2.5), pytest.approx(20 - 60 * 0.2 / 2.5))


def test_what_is_behind_the_camera_or_beside_the_picture_is_not_drawn():
    camera = make_camera()
    for place in (camera.eye + camera.axes[2], camera.eye, camera.axes[0] * 50):
        ball = solids.make_solid(np.array([place]), 0.3)
        picture = empty()
        corners, in_front = raster.list_corners(camera, ball.vertices, ball.triangles)
        raster.paint(picture, corners, np.ones((len(corners), 3)), np.ones((len(corners), 3)))
        assert not picture.color.any()
        assert len(corners) == in_front.sum()


def test_a_ball_covers_the_disc_that_it_is():
    """Its outline has the angle asin(r / D), so its radius is f tan of that; what is drawn is a little smaller."""
    camera = make_camera(elevation=0.0)
    picture = paint_all(camera, [solids.make_solid(np.zeros((1, 3)), 0.5)], np.ones((1, 3)))
    radius = 60 * np.tan(np.arcsin(0.5 / 3))
    assert 0.93 * np.pi * radius**2 < (picture.nearness > 0).sum() < 1.01 * np.pi * radius**2


def test_what_can_be_seen_through_is_mixed_once_and_hides_nothing():
    camera, picture = make_camera(), empty()
    ball = solids.make_solid(np.zeros((1, 3)), 0.5)
    corners, _ = raster.list_corners(camera, ball.vertices, ball.triangles)
    white = np.ones((len(corners), 3))
    raster.paint(picture, corners, white, white, opacity=0.25)
    assert set(np.unique(picture.color.round(9))) == {0.0, 0.25}
    assert not picture.nearness.any()


def test_normals_are_smooth_on_a_ball_and_sharp_on_a_box():
    ball, box = solids.make_solid(np.zeros((1, 3)), 2.0), solids.make_solid(np.array(list(np.ndindex(2, 2, 2)), float))
    cosines = np.einsum("tki,tki->tk", raster.find_normals(ball), ball.vertices[ball.triangles] / 2)
    assert cosines.min() > 0.98
    of_box = np.abs(raster.find_normals(box))
    np.testing.assert_allclose(of_box.max(axis=-1), 1.0)
    np.testing.assert_allclose(of_box.sum(axis=-1), 1.0, atol=1e-12)


def test_light_comes_from_the_viewers_side_and_from_above():
    camera = make_camera(elevation=0.0)
    towards, away, up, down = (
        float(raster.find_lights(camera, np.array(n))) for n in (camera.axes[2], -camera.axes[2], [0, 0, 1], [0, 0, -1])
    )
    assert raster.BRIGHTEST > towards > away > raster.DARKEST
    assert up > down


@pytest.fixture(scope="module")
def opengl():
    from jaxpg.watch import gl

    found = gl.find_backend({}, gl.is_working)
    return pytest.skip("needs OpenGL: apt-get install libegl1 libgl1-mesa-dri") if found is None else found


def test_a_sketch_is_mujocos_picture(opengl):
    """The same outline but for a rim of pixels, and the same parts in front: each colour covers the same place."""
    from jaxpg.watch.canvas import Canvas, Cell
    from jaxpg.watch.sketch import Sketch

    xml = ARM.replace('type="capsule"', 'type="capsule" rgba="1 0 0 1"').replace(
        'type="box"', 'type="box" rgba="0 0 1 1"'
    )
    model = mujoco.MjModel.from_xml_string(xml.replace('<geom type="plane" size="1 1 1" pos="0 0 -.1"/>', ""))
    parts, qpos = solids.make_parts(model), np.array([[0.3, 0.4], [2.0, 1.0], [-2.0, -0.5]])
    framing = space.make_framing(model, parts, [space.Look(qpos, None, None)])
    cells = [Cell(q, None, np.zeros(0), "") for q in qpos]
    with Canvas(model, opengl, (1, 3), (120, 120), framing=framing) as canvas:
        expected = canvas.draw(cells).astype(int)
    with Sketch(model, (1, 3), (120, 120), None, None, framing) as sketch:
        found = sketch.draw(cells).astype(int)
    for one, other in ((0, 2), (2, 0)):
        there, here = (image[..., one] > 1.5 * image[..., other] + 20 for image in (expected, found))
        assert there.sum() > 400
        assert (there & here).sum() / (there | here).sum() > 0.9
