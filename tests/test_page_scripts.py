"""The mathematics of the page's scripts, evaluated by a real browser and compared with Python's."""

import browsers
import mujoco
import numpy as np
import pages
import pytest
import scipy.spatial
from browsers import computed

from envs.scenes import Scene
from jaxpg.watch import raster
from jaxpg.watch.clips import Clip
from jaxpg.watch.recording import Look
from jaxpg.watch.space import make_axes
from jaxpg.watch.stage_in_space import make_stage


@pytest.fixture(scope="module")
def tab():
    """An empty tab."""
    with browsers.launched() as browser:
        yield browser.new_page()


def test_packed_numbers_are_read_as_they_were_written(tab):
    values = np.array([-(2**15), 2**15 - 1, 0, 1, -1, 255, 256, -256, 12345])
    assert computed(tab, ["numbers"], "[...unpack(argument)]", pages.packed(values)) == values.tolist()


def test_ticks_are_round_even_and_within_the_range(tab):
    for low, high in [(-1234.5, 17), (0, 1e6), (0, 491_520), (-1e-3, 2e-3), (0.94, 0.99), (3e9, 8e9), (-7.0, -6.0)]:
        ticks = computed(tab, ["numbers"], "ticks(argument, 6)", [low, high])
        values = np.array([tick["value"] for tick in ticks])
        assert 2 <= len(values) <= 7
        assert low <= values[0] <= values[-1] <= high
        np.testing.assert_allclose(np.diff(values), values[1] - values[0], rtol=1e-9)
        units = {"k": "e3", "M": "e6"}
        texts = [tick["text"].replace("\u2212", "-") for tick in ticks]
        np.testing.assert_allclose([float(t[:-1] + units.get(t[-1], t[-1])) for t in texts], values, atol=1e-12)


@pytest.mark.parametrize("number", [3, 4, 8, 40])
def test_an_outline_is_the_convex_hull(tab, number):
    points = np.random.default_rng(number).normal(size=(number, 2))
    corners = np.array(computed(tab, ["outline"], "hull(argument)", points.tolist()))
    expected = points[scipy.spatial.ConvexHull(points).vertices]
    np.testing.assert_allclose(corners[np.lexsort(corners.T)], expected[np.lexsort(expected.T)])


def test_an_outline_of_one_point_two_or_equal_ones_is_those(tab):
    assert computed(tab, ["outline"], "hull(argument)", [[1, 2]]) == [[1, 2], [1, 2]]
    assert computed(tab, ["outline"], "hull(argument)", [[1, 2], [0, 1], [1, 2]]) == [[0, 1], [1, 2]]


def test_a_map_is_read_between_its_points(tab):
    """A bilinear function is reproduced exactly."""
    x, y = np.meshgrid(np.arange(5.0), np.arange(4.0))
    values = (1 + 2 * x - y + 0.5 * x * y).ravel().tolist()
    for column, row in [(0, 0), (0.5, 0), (3.25, 2.5), (4, 3), (9, -1)]:
        c, r = min(column, 4), max(row, 0)
        found = computed(tab, ["portrait"], f"bilinear(argument, 5, 4, {column}, {row})", values)
        assert found == pytest.approx(1 + 2 * c - r + 0.5 * c * r)


def test_the_colours_of_a_map_get_lighter_all_the_way(tab):
    table = np.array(computed(tab, ["palette"], "SHADE_TABLE")) / 255
    linear = np.where(table <= 0.04045, table / 12.92, ((table + 0.055) / 1.055) ** 2.4)
    luminance = linear @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(luminance[::4]) > 0).all()
    assert luminance[-1] > 10 * luminance[0]


def test_contours_lie_where_the_value_is(tab):
    x, y = np.meshgrid(np.arange(9.0), np.arange(7.0))
    plane = {"values": (2 * x - y).ravel().tolist(), "level": 3.3}  # linear, as between points of the grid
    segments = computed(tab, ["contours"], "contour(argument.values, 9, 7, argument.level)", plane)
    assert len(segments) > 6
    np.testing.assert_allclose(np.array(segments) @ [2, -1], 3.3)


# --- in space ---------------------------------------------------------------------------------------------------------

EVERY_JOINT = """<mujoco><compiler angle="radian"/><worldbody>
  <body pos="1 0 0" quat="1 .2 .3 0"><freejoint/><geom size=".1"/>
    <body pos="0 .2 .1" quat="0 1 0 1"><joint type="hinge" axis="1 2 0" pos=".1 0 .3" ref=".4"/><geom size=".1"/>
      <body pos=".3 0 0"><joint type="slide" axis="0 1 1"/><joint type="hinge" axis="0 0 1"/><geom size=".1"/>
        <site pos=".1 .2 .3" euler=".1 .2 .3"/></body></body></body>
  <body pos="0 -1 0"><joint type="ball" pos="0 0 .2"/><geom type="box" size=".1 .2 .3"/><body euler="1 1 1"/></body>
</worldbody></mujoco>"""


def random_poses(model, number):
    """Joint positions `[number, nq]` with unit quaternions, where every joint has moved."""
    qpos = np.random.default_rng(1).normal(size=(number, model.nq))
    for joint, first in enumerate(model.jnt_qposadr):
        begin = {0: first + 3, 1: first}.get(int(model.jnt_type[joint]))
        if begin is not None:
            qpos[:, begin : begin + 4] /= np.linalg.norm(qpos[:, begin : begin + 4], axis=1, keepdims=True)
    return qpos


def test_bodies_are_where_mujoco_has_them(tab):
    model = mujoco.MjModel.from_xml_string(EVERY_JOINT)
    scene = Scene(model, None, site=0)
    qpos, data = random_poses(model, 4), mujoco.MjData(model)
    clip = Clip(Look(qpos, None, None), {}, np.zeros(4), 0.1, 0.0, None)
    common, ((episode,),) = make_stage(scene, [[clip]])
    for frame, q in enumerate(qpos):
        data.qpos = q
        mujoco.mj_kinematics(model, data)
        found = computed(
            tab,
            ["kinematics", "numbers"],
            """(({space, episode, frame}) => {
              const count = episode.units.length;
              const row = episode.units.map((unit, i) => unpack(episode.qpos)[frame * count + i] * unit);
              const poses = bodyPoses(space, row);
              return [...poses, poseOn(poses, space.site)].map(({ place, turn }) => [...place, ...turn]);
            })(argument)""",
            {"space": common["space"], "episode": episode, "frame": frame},
        )
        places, turns = np.vstack([data.xpos, data.site_xpos]), np.vstack([data.xmat, data.site_xmat])
        np.testing.assert_allclose(found, np.hstack([places, turns]), atol=2e-3)  # numbers are rounded for the page


@pytest.mark.parametrize(("azimuth", "elevation"), [(120, -20), (90, 0), (-30, -80)])
def test_the_page_sees_points_where_the_formula_has_them(tab, azimuth, elevation):
    points = np.random.default_rng(2).uniform(-1, 1, (20, 3))
    looking = {"center": [0.1, 0.2, 0.3], "radius": 2.0, "azimuth": azimuth, "elevation": elevation}
    found = computed(
        tab,
        ["camera"],
        "argument.points.map((point) => project(makeCamera(argument.looking, 300, 200), point))",
        {"looking": looking, "points": points.tolist()},
    )
    axes, half = make_axes(azimuth, elevation), np.deg2rad(17.5)
    eye = np.array(looking["center"]) + 2.0 / np.sin(half) * axes[2]
    camera = raster.Camera(eye, axes, 100 / np.tan(half), (300, 200), 0.1)
    np.testing.assert_allclose(found, raster.project(camera, points), rtol=1e-9)
    x, y, _ = np.transpose(found)
    assert 0 < x.min() < x.max() < 300
    assert 0 < y.min() < y.max() < 200


def test_a_line_is_cut_where_it_comes_before_the_camera(tab):
    """From far ahead to behind the eye, along the line of sight: its end is at the nearest distance that is drawn."""
    code = """(() => {
      const camera = makeCamera({ center: [0, 0, 0], radius: 1, azimuth: 90, elevation: 0 }, 100, 100);
      const [x, y, z] = [0, camera.eye[1] - 5, 0];
      return [projectLine(camera, [0.1, 9, 0], [x, y, z]), projectLine(camera, [x, y, z], [x, y - 1, z]), camera.near];
    })()"""
    cut, behind, near = computed(tab, ["camera"], code)
    assert behind is None
    assert cut[1][2] == pytest.approx(near)


def test_the_pages_pixels_are_those_of_the_other_rasterizer(tab):
    """Random triangles in any order; a pixel shows the nearest, in the light between the corners."""
    rng = np.random.default_rng(3)
    corners = np.concatenate([rng.uniform(-5, 45, (30, 3, 2)), rng.uniform(0.2, 1.0, (30, 3, 1))], axis=-1)
    lights, colors = rng.uniform(0.3, 1.0, (30, 3)), rng.integers(40, 255, (30, 3))
    found = computed(
        tab,
        ["raster"],
        """(() => {
          const raster = makeRaster(40, 30);
          clearRaster(raster);
          const { lights, colors } = argument;
          argument.corners.forEach((one, i) => paintTriangle(raster, one.flat(), lights[i], colors[i]));
          return [...raster.image.data];
        })()""",
        {"corners": corners.tolist(), "lights": lights.tolist(), "colors": colors.tolist()},
    )
    expected = raster.Raster(np.zeros((30, 40, 3)), np.zeros((30, 40)))
    raster.paint(expected, corners, lights, colors / 255)
    image = np.reshape(found, (30, 40, 4))
    np.testing.assert_allclose(image[..., :3], 255 * expected.color, atol=1.0)
    np.testing.assert_array_equal(image[..., 3], np.where(expected.nearness > 0, 255, 0))
    assert (expected.nearness > 0).mean() > 0.5


def test_what_can_be_seen_through_lets_half_of_what_is_behind_through(tab):
    code = """(() => {
      const raster = makeRaster(4, 4);
      clearRaster(raster);
      const [near, far] = [1, 0.5].map((w) => [-9, -9, w, -9, 20, w, 20, -9, w]);
      paintTriangle(raster, far, [1, 1, 1], [200, 0, 0]);
      paintTriangle(raster, near, [1, 1, 1], [0, 100, 0], 0.5);
      return [...raster.image.data.slice(0, 4)];
    })()"""
    assert computed(tab, ["raster"], code) == [100, 50, 0, 255]


def test_a_ball_of_the_page_has_its_normals_outwards_and_its_vertices_at_1(tab):
    mesh = computed(
        tab,
        ["meshes"],
        """(({ vertices, triangles, normals }) => [[...vertices], [...triangles], [...normals]])(globe())""",
    )
    vertices, triangles, normals = (np.array(one) for one in mesh)
    corners = vertices.reshape(-1, 3)[triangles.reshape(-1, 3)]
    np.testing.assert_allclose(np.linalg.norm(corners, axis=-1), 1.0)
    assert np.einsum("tki,tki->tk", corners, normals.reshape(-1, 3, 3)).min() > 0.98
    a, b, c = (corners[:, k] for k in range(3))
    assert np.einsum("ti,ti->t", a, np.cross(b, c)).min() > 0


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_bar_lies_along_its_axis_and_is_closed(tab, axis):
    mesh = computed(
        tab, ["meshes"], f"(({{ vertices, triangles }}) => [[...vertices], [...triangles]])(barMesh({axis}, 2, 0.1))"
    )
    vertices, triangles = np.reshape(mesh[0], (-1, 3)), np.reshape(mesh[1], (-1, 3))
    low, high = np.full(3, -0.05), np.full(3, 0.05)
    low[axis], high[axis] = 0.0, 2.0
    np.testing.assert_allclose([vertices.min(axis=0), vertices.max(axis=0)], [low, high])
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    assert np.einsum("ti,ti->", a, np.cross(b, c)) / 6 == pytest.approx(2 * 0.1**2)
