"""Robots in space: their surfaces, from where they are seen, and what is in the picture."""

import itertools
import math

import mujoco
import numpy as np
import pytest
from spatial import ARM, RUNNER

from jaxpg.watch import drawing, solids, space
from jaxpg.watch.recording import Look

MESH = '<asset><mesh name="wedge" vertex="0 0 0  1 0 0  0 1 0  0 0 1  .1 .1 .1"/></asset>'


def model(geoms, assets=""):
    return mujoco.MjModel.from_xml_string(f"<mujoco>{assets}<worldbody><body>{geoms}</body></worldbody></mujoco>")


def volume(solid):
    """By the divergence theorem: sum over triangles of a . (b x c) / 6; positive if they go around outwards."""
    a, b, c = (solid.vertices[solid.triangles[:, k]] for k in range(3))
    return float(np.einsum("ti,ti->", a, np.cross(b, c)) / 6)


# --- surfaces ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("geom", "expected", "error"),
    [
        ('<geom type="box" size=".4 .2 .1"/>', 0.8 * 0.4 * 0.2, 1e-9),
        ('<geom type="sphere" size=".3"/>', 4 / 3 * np.pi * 0.3**3, 0.09),
        ('<geom type="capsule" size=".1 .4"/>', np.pi * 0.1**2 * 0.8 + 4 / 3 * np.pi * 0.1**3, 0.05),
        ('<geom type="cylinder" size=".2 .5"/>', np.pi * 0.2**2 * 1.0, 0.03),
        ('<geom type="ellipsoid" size=".5 .3 .2"/>', 4 / 3 * np.pi * 0.5 * 0.3 * 0.2, 0.09),
        ('<geom type="mesh" mesh="wedge"/>', 1 / 6, 1e-6),
    ],
    ids=lambda value: value.split('"')[1] if isinstance(value, str) else "",
)
def test_a_surface_is_closed_and_has_the_volume_of_its_geom(geom, expected, error):
    (part,) = solids.make_parts(model(geom, MESH))
    sides = [tuple(t[[i, (i + 1) % 3]]) for t in part.solid.triangles for i in range(3)]
    assert len(set(sides)) == len(sides)
    assert {(b, a) for a, b in sides} == set(sides)
    assert volume(part.solid) == pytest.approx(expected, rel=error)
    assert volume(part.solid) <= expected * (1 + 1e-6)


def test_a_surface_is_where_its_geom_is_in_the_frame_of_its_body():
    (part,) = solids.make_parts(model('<geom type="box" size=".4 .2 .1" pos="1 2 3" euler="0 0 90"/>'))
    assert part.body == 1
    np.testing.assert_allclose(part.solid.vertices.min(axis=0), [0.8, 1.6, 2.9], atol=1e-9)
    np.testing.assert_allclose(part.solid.vertices.max(axis=0), [1.2, 2.4, 3.1], atol=1e-9)


@pytest.mark.parametrize("points", [[[0, 0, 0]], [[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]])
def test_what_is_flat_has_a_surface_all_the_same(points):
    solid = solids.make_solid(np.array(points, float))
    assert 0 < volume(solid) < 0.01
    np.testing.assert_allclose(np.ptp(solid.vertices, axis=0), np.ptp(points, axis=0), atol=0.01)


def test_geoms_without_a_colour_are_told_apart_and_others_have_theirs():
    body = '<body><joint/><geom size=".1"/>{}</body>'
    bodies = body.format(body.format('<geom size=".1" rgba="1 0 0 1"/>'))
    tree = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    first, second, red = (part.color for part in solids.make_parts(tree))
    assert first != second
    assert red == "#ff0000"


# --- planar or not ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("joint", "is_planar"),
    [
        ('axis="0 1 0"', True),
        ('axis="0 -1 0.1"', True),
        ('axis="0 0 1"', False),
        ('axis="0 1 1"', False),
        ('type="slide" axis="1 0 1"', True),
        ('type="slide" axis="0 1 0"', False),
        ('type="ball"', False),
        ('type="free"', False),
    ],
)
def test_a_robot_is_planar_if_nothing_leads_out_of_the_picture(joint, is_planar):
    """Seen along y, as there is no camera."""
    inside = '<body><joint axis="0 1 0"/><geom size=".1" pos=".3 0 0"/></body>'
    xml = f'<mujoco><worldbody><body><joint {joint}/><geom size=".1"/>{inside}</body></worldbody></mujoco>'
    assert drawing.is_planar(mujoco.MjModel.from_xml_string(xml)) == is_planar


def test_the_camera_on_a_wrist_is_not_the_pictures():
    wrist, world = '<camera name="wrist"/>', '<camera name="top" pos="0 0 3" xyaxes="1 0 0 0 1 0"/>'
    for cameras, found in [((wrist, ""), None), (("", world), 0), ((wrist, world), 1)]:
        xml = f'<mujoco><worldbody><body><joint axis="0 0 1"/><geom size=".1"/>{cameras[0]}</body></worldbody></mujoco>'
        own = mujoco.MjModel.from_xml_string(xml.replace("</worldbody>", f"{cameras[1]}</worldbody>"))
        order = [own.camera(i).name for i in range(own.ncam)]
        expected = None if found is None else order.index("top")
        assert drawing.find_camera(own) == expected


# --- the camera -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("azimuth", "elevation"), [(90, 0), (120, -20), (-75, -89), (300, 10)])
def test_angles_are_mujocos(azimuth, elevation):
    """As `mjv_updateCamera` of a free camera has it."""
    own = model('<geom size=".1"/>')
    data, camera, scene = mujoco.MjData(own), mujoco.MjvCamera(), mujoco.MjvScene(own, maxgeom=10)
    mujoco.mj_forward(own, data)
    camera.azimuth, camera.elevation, camera.distance = azimuth, elevation, 2.0
    everything = mujoco.mjtCatBit.mjCAT_ALL.value
    mujoco.mjv_updateScene(own, data, mujoco.MjvOption(), None, camera, everything, scene)
    right, up, back = space.make_axes(azimuth, elevation)
    np.testing.assert_allclose(scene.camera[0].forward, -back, atol=1e-6)
    np.testing.assert_allclose(scene.camera[0].up, up, atol=1e-6)
    np.testing.assert_allclose(right, np.cross(up, back), atol=1e-12)
    np.testing.assert_allclose(
        np.mean([scene.camera[i].pos for i in range(2)], axis=0) - camera.lookat, 2 * back, atol=1e-6
    )


@pytest.mark.parametrize(
    ("xml", "angles"),
    [
        ("", (space.AZIMUTH, space.ELEVATION)),
        ('<visual><global azimuth="30" elevation="-10"/></visual>', (30, -10)),
        ('<worldbody><camera pos="0 -3 0" xyaxes="1 0 0 0 0 1"/></worldbody>', (90, 0)),
        ('<worldbody><camera pos="3 0 3" xyaxes="0 1 0 -1 0 1"/></worldbody>', (180, -45)),
    ],
)
def test_a_model_that_says_from_where_it_is_seen_is_seen_from_there(xml, angles):
    own = mujoco.MjModel.from_xml_string(f'<mujoco>{xml}<worldbody><geom size=".1"/></worldbody></mujoco>')
    np.testing.assert_allclose(space.find_angles(own), angles, atol=1e-6)


def look_at(qpos, goal=None):
    qpos = np.array(qpos, float)
    return Look(qpos, None if goal is None else np.tile(np.array(goal, float), (len(qpos), 1)), None)


def vertices_of(own, parts, qpos):
    data = mujoco.MjData(own)
    data.qpos = qpos
    mujoco.mj_kinematics(own, data)
    placed = [p.solid.vertices @ data.xmat[p.body].reshape(3, 3).T + data.xpos[p.body] for p in parts]
    return np.concatenate(placed)


def test_all_that_happens_is_within_the_sphere_that_is_seen():
    own = mujoco.MjModel.from_xml_string(ARM)
    parts, rng = solids.make_parts(own), np.random.default_rng(0)
    looks = [look_at(rng.uniform(-2, 2, (20, 2)), goal) for goal in ([0.5, 0.0, 1.4], [-0.6, 0.2, 0.0])]
    framing = space.make_framing(own, parts, looks)
    points = [vertices_of(own, parts, q) for look in looks for q in look.qpos] + [look.goal for look in looks]
    distances = np.linalg.norm(np.concatenate(points) - framing.center, axis=1)
    assert distances.max() <= framing.radius
    assert framing.radius < 1.6 * distances.max()  # each part counts as its sphere
    assert not framing.follows
    assert framing.ground == pytest.approx(-0.1)


def test_a_robot_that_runs_is_followed_and_one_with_a_goal_nearby_is_not():
    """A picture of a run of 5 m is as large as the robot; of 1 m with a goal it holds all."""
    own = mujoco.MjModel.from_xml_string(RUNNER)
    parts = solids.make_parts(own)

    def run(length, goal=None):
        qpos = np.tile(own.qpos0, (50, 1))
        qpos[:, 0], qpos[:, 1] = np.linspace(0, length, 50), np.linspace(0, -0.3 * length, 50)
        return space.make_framing(own, parts, [look_at(qpos, goal)]), qpos

    followed, qpos = run(5.0)
    assert followed.follows
    assert followed.radius < 0.6
    shifts = space.find_shifts(own, parts, qpos, followed)
    moving = [part for part in parts if part.body]
    for q, shift in zip(qpos[::7], shifts[::7], strict=True):
        distances = np.linalg.norm(vertices_of(own, moving, q) - followed.center - shift, axis=1)
        assert distances.max() <= followed.radius
    near, qpos = run(1.0, goal=(1.0, 0.0, 0.0))
    assert not near.follows
    assert space.find_shifts(own, parts, qpos, near) is None


@pytest.mark.parametrize("joint", ['axis="0 1 0"', 'type="slide" axis="1 0 0"'])
def test_a_robot_of_a_single_part_is_not_followed_where_it_only_swings(joint):
    own = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body><joint {joint}/><geom type="capsule" fromto="0 0 0 0 0 1" size=".05"/></body>'
        "</worldbody></mujoco>"
    )
    framing = space.make_framing(own, solids.make_parts(own), [look_at(np.linspace(-2, 2, 20)[:, None])])
    assert not framing.follows


def test_a_body_without_a_shape_is_a_rod_to_the_next_body_where_others_have_shapes():
    """As where mesh files are missing: from the first body to the second, and of the last to its centre of mass."""
    last = '<body pos="0 0 .2"><joint/><inertial pos=".1 0 0" mass="1" diaginertia="1 1 1"/></body>'
    middle = f'<body pos=".3 0 0"><joint/><geom size=".05"/>{last}</body>'
    first = f'<body pos="0 0 1"><joint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>{middle}</body>'
    own = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{first}</worldbody></mujoco>")
    assert [bone.body for bone in solids.find_bones(own)] == [1, 3]
    ball, *rods = solids.make_parts(own)
    assert [part.body for part in (ball, *rods)] == [2, 1, 3]
    for rod, reach in zip(rods, (0.3, 0.1), strict=True):
        radius = -rod.solid.vertices[:, 0].min()
        assert rod.solid.vertices[:, 0].max() == pytest.approx(reach + radius)
        assert radius < 0.4 * reach
    nothing = first.replace('<geom size=".05"/>', '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>')
    bare = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{nothing}</worldbody></mujoco>")
    assert not solids.find_bones(bare)


def test_what_cannot_be_drawn_of_positions_is_tamed():
    """No gaps, no flips of a quaternion's sign, and no robot farther away than a hundred times its size."""
    own = mujoco.MjModel.from_xml_string(RUNNER)
    qpos = np.tile(own.qpos0, (6, 1))
    half = np.linspace(0, 3, 6) / 2
    qpos[:, 3:7] = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1)
    expected = qpos.copy()
    qpos[[1, 3, 4], 3:7] *= -1
    qpos[2] = np.nan
    qpos[5, 0] = 1e12
    expected[2], expected[5, 0] = expected[1], 100 * max(own.stat.extent, 1.0)
    np.testing.assert_allclose(space.tame(own, qpos), expected, atol=1e-9)


def test_the_ground_is_the_floor_or_height_0_or_the_lower_end_of_a_picture_far_from_both():
    for xml, ground in [
        ('<geom type="plane" size="1 1 1" pos="0 0 -.4"/>', -0.4),
        ('<geom type="plane" size="1 1 1" euler="90 0 0"/>', 0.0),
        ("", 0.0),
    ]:
        own = mujoco.MjModel.from_xml_string(
            f'<mujoco><worldbody>{xml}<body pos="0 0 .2"><joint/><geom size=".1"/></body></worldbody></mujoco>'
        )
        assert space.make_framing(own, solids.make_parts(own), [look_at([[0.0]])]).ground == pytest.approx(ground)
    high = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body pos="0 0 5"><joint/><geom size=".1"/></body></worldbody></mujoco>'
    )
    found = space.make_framing(high, solids.make_parts(high), [look_at([[0.0]])])
    assert found.ground == pytest.approx(found.center[2] - found.radius)


def test_the_grid_is_level_round_and_wider_than_what_is_seen():
    framing = space.Framing(np.array([0.33, -0.21, 0.5]), 0.9, 120.0, -20.0, -0.05, False)
    lines = np.array(space.list_grid(framing, framing.center))
    assert (lines[..., 2] == -0.05).all()
    mesh = space.find_mesh(1.8)
    np.testing.assert_allclose(lines[..., :2] / mesh, np.round(lines[..., :2] / mesh), atol=1e-9)
    for axis, sign in itertools.product((0, 1), (-1, 1)):
        assert (sign * (lines[..., axis] - framing.center[axis])).max() >= framing.radius


@pytest.mark.parametrize("span", [1e-3, 0.3, 1.0, 7.9, 8.1, 250.0])
def test_a_mesh_is_1_2_or_5_times_a_power_of_ten_and_at_most_8_fit(span):
    mesh = space.find_mesh(span)
    assert min(abs(mesh / 10 ** math.floor(math.log10(mesh * 1.0001)) - f) for f in (1, 2, 5)) < 1e-6
    assert 8 / 2.5 - 1e-6 <= span / mesh <= 8 + 1e-6
