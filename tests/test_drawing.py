"""A robot in the plane: every kind of geom is drawn as what it is, and the axes are those of the picture."""

import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from jaxpg.watch import drawing
from jaxpg.watch.attempts import DrawingError

MESH = """<asset><mesh name="wedge" vertex="0 0 0  1 0 0  0 1 0  0 0 1  .1 .1 .1"/></asset>"""


def model(geoms, more="", assets=""):
    body = f'<body><joint type="hinge" axis="0 -1 0"/>{geoms}</body>'
    return mujoco.MjModel.from_xml_string(f"<mujoco>{assets}<worldbody>{more}{body}</worldbody></mujoco>")


def silhouette(picture, frames, part=0):
    """Corners of the hull of a part in the first frame, in order of their angle, `[K, 2]`."""
    points = frames.place[0, part] + picture.parts[part].points @ frames.turn[0, part].T
    return points[ConvexHull(points).vertices]


def area(corners):
    x, y = corners.T
    return abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))) / 2


@pytest.mark.parametrize("angle", [0.0, 0.6, np.pi / 2])
def test_a_box_has_its_corners(angle):
    """Turned by the hinge about the line of sight: a rectangle, turned as much; no pill."""
    picture = drawing.make_picture(model('<geom type="box" size=".4 .2 .1"/>'))
    corners = silhouette(picture, drawing.draw(picture, np.array([[angle]])))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    expected = np.array([(x, z) for x in (-0.4, 0.4) for z in (-0.1, 0.1)]) @ turn.T
    assert len(corners) == 4
    np.testing.assert_allclose(
        corners[np.lexsort(corners.T.round(6))], expected[np.lexsort(expected.T.round(6))], atol=1e-9
    )
    assert picture.parts[0].radius == 0


@pytest.mark.parametrize(
    ("geom", "expected", "error"),
    [
        ('<geom type="cylinder" size=".2 .5"/>', 0.4 * 1.0, 0.01),  # from the side: a rectangle
        ('<geom type="cylinder" size=".2 .5" euler="90 0 0"/>', np.pi * 0.2**2, 0.03),  # from its end: a disc
        ('<geom type="ellipsoid" size=".5 .3 .2"/>', np.pi * 0.5 * 0.2, 0.12),
        ('<geom type="mesh" mesh="wedge"/>', 0.5, 1e-6),  # the triangle with the corners 0, x and z
    ],
)
def test_a_geom_covers_what_it_covers(geom, expected, error):
    picture = drawing.make_picture(model(geom, assets=MESH))
    assert area(silhouette(picture, drawing.draw(picture, np.zeros((1, 1))))) == pytest.approx(expected, rel=error)


def test_a_capsule_and_a_sphere_are_points_with_a_rim():
    picture = drawing.make_picture(
        model('<geom type="capsule" fromto="0 0 0 .5 0 0" size=".03"/><geom size=".2" pos="1 0 0"/>')
    )
    assert [(len(part.points), part.radius) for part in picture.parts] == [(2, 0.03), (1, 0.2)]
    np.testing.assert_allclose(drawing.draw(picture, np.zeros((1, 1))).place[0, 1], [1, 0])


def test_what_is_nearer_is_drawn_over_what_is_farther():
    """The camera looks along +y."""
    picture = drawing.make_picture(
        model('<geom name="near" size=".1" pos="0 -1 0"/><geom name="far" size=".1" pos="0 1 0"/>')
    )
    assert [part.number for part in picture.parts] == [1, 0]


def test_a_robot_of_collision_geoms_alone_is_drawn_of_them():
    shown = drawing.make_picture(model('<geom size=".1" group="3"/>'))
    both = drawing.make_picture(model('<geom size=".1" group="3"/><geom size=".2" group="2"/>'))
    assert [part.radius for part in shown.parts] == [0.1]
    assert [part.radius for part in both.parts] == [0.2]


def test_a_body_without_geoms_is_drawn_as_the_box_that_has_its_inertia():
    """I = m/12 (b^2 + c^2, a^2 + c^2, a^2 + b^2) of a box with sides a, b, c."""
    a, b, c, mass = 0.8, 0.4, 0.2, 3.0
    inertia = mass / 12 * np.array([b**2 + c**2, a**2 + c**2, a**2 + b**2])
    inertial = f'<inertial pos=".3 0 0" mass="{mass}" diaginertia="{inertia[0]} {inertia[1]} {inertia[2]}"/>'
    picture = drawing.make_picture(model(inertial))
    corners = silhouette(picture, drawing.draw(picture, np.zeros((1, 1))))
    np.testing.assert_allclose(corners.min(axis=0), [0.3 - a / 2, -c / 2], atol=1e-6)
    np.testing.assert_allclose(corners.max(axis=0), [0.3 + a / 2, c / 2], atol=1e-6)


def test_of_a_model_without_anything_it_is_said():
    with pytest.raises(DrawingError, match="no geoms and no bodies"):
        drawing.make_picture(
            mujoco.MjModel.from_xml_string('<mujoco><worldbody><geom type="plane" size="1 1 1"/></worldbody></mujoco>')
        )


def test_where_a_position_is_no_number_the_robot_stays_where_it_was():
    picture = drawing.make_picture(model('<geom type="capsule" fromto="0 0 0 .5 0 0" size=".03"/>'))
    qpos = np.array([[np.nan], [0.3], [np.nan], [np.inf], [1.0]])
    frames = drawing.draw(picture, qpos)
    expected = drawing.draw(picture, np.array([[0.0], [0.3], [0.3], [0.3], [1.0]]))
    for found, wanted in zip(frames[:3], expected[:3], strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_a_robot_that_flies_off_does_not_make_the_rest_invisible():
    """A slide that passes 1e9 m: the picture is no larger than some tens of the robot's size."""
    xml = '<mujoco><worldbody><body><joint type="slide" axis="0 0 1"/><geom size=".1"/></body></worldbody></mujoco>'
    picture = drawing.make_picture(mujoco.MjModel.from_xml_string(xml))
    frames = drawing.draw(picture, np.array([[0.0], [0.5], [1e9], [1e12]]))
    _, y_min, _, y_max = drawing.extent(picture, [frames], margin=0.1)
    assert -10 < y_min < -0.1
    assert 0.6 < y_max < 100


@pytest.mark.parametrize(
    ("xyaxes", "labels"),
    [
        (None, ("x [m]", "z [m]")),
        ("1 0 0 0 1 0", ("x [m]", "y [m]")),
        ("0 1 0 0 0 1", ("y [m]", "z [m]")),
        ("0 -1 0 0 0 1", ("\u2212y [m]", "z [m]")),
        ("1 0 0 0 .6 .8", ("x [m]", "upwards [m]")),
        ("1 1 0 0 0 1", ("to the right [m]", "z [m]")),
    ],
)
def test_the_axes_of_the_picture_are_named_as_what_the_camera_sees(xyaxes, labels):
    camera = f'<camera pos="0 0 3" xyaxes="{xyaxes}"/>' if xyaxes else ""
    assert drawing.axis_labels(drawing.camera_axes(model('<geom size=".1"/>', more=camera))) == labels
