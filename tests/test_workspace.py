"""Success over the workspace: goals where they were at the end, seen from above and from the side."""

import mujoco
import numpy as np
import pytest
from spatial import ARM

from envs.scenes import Scene
from jaxpg.watch.recording import Look, Recording
from jaxpg.watch.workspace import find_base, make_workspace

PLANAR = '<mujoco><worldbody><body><joint axis="0 1 0"/><geom size=".1"/></body></worldbody></mujoco>'


def record(goals, distances, radius=0.1, moving=0.0):
    """Episodes of 3 steps, but for the last one of 2, whose goals move along x from step to step."""
    number, length = len(goals), np.array([*[3] * (len(goals) - 1), 2])
    path = np.stack([np.array(goals) + moving * t * np.eye(3)[0] for t in range(4)])
    ends = np.tile(np.array(distances, float), (3, 1))
    metrics = {"distance": ends, "success": (ends < radius).astype(float)}
    empty = np.zeros((3, number))
    return Recording(
        Look(np.zeros((4, number, 2)), path, None),
        empty[..., None],
        empty,
        empty,
        length,
        metrics,
        np.zeros(number, bool),
    )


def test_a_goal_is_seen_from_above_and_from_the_side():
    """From the side: its distance from the vertical through the first hinge, and its height."""
    model = mujoco.MjModel.from_xml_string(ARM.replace('pos="0 0 .2"', 'pos=".5 1 .2"'))
    goals = [[0.8, 1.4, 0.3], [0.5, 0.9, 0.7], [np.nan, 0.0, 0.0]]
    data = make_workspace(Scene(model, None, goal_radius=0.1), [record(goals, [0.02, 0.4, 0.0])], shown=2)
    above, side = data["pictures"]
    assert above["points"][0] == [[0.8, 1.4, 0.02, 1.0], [0.5, 0.9, 0.4, 0.0]]
    assert side["points"][0] == [[0.5, 0.3, 0.02, 1.0], [pytest.approx(0.1), 0.7, 0.4, 0.0]]
    assert above["circle"] == [0.5, 1.0, pytest.approx(0.5)]
    assert above["chosen"] == [[[0.8, 1.4], [0.5, 0.9]]]
    assert (above["x"], above["y"], side["y"]) == ("x [m]", "y [m]", "z [m]")
    assert data["success_radius"] == 0.1
    for picture in data["pictures"]:
        for axis, name in enumerate(("x_range", "y_range")):
            low, high = picture[name]
            assert all(low < point[axis] < high for point in picture["points"][0])


def test_a_goal_that_moves_counts_where_it_is_at_the_end():
    model = mujoco.MjModel.from_xml_string(ARM)
    data = make_workspace(Scene(model, None), [record([[0.1, 0, 0.1], [0.2, 0, 0.2]], [1, 1], moving=0.1)], shown=2)
    assert [point[0] for point in data["pictures"][0]["points"][0]] == [pytest.approx(0.4), pytest.approx(0.4)]


def test_goals_on_the_ground_are_seen_from_above_only_and_planar_ones_in_their_plane():
    goals = [[0.3, 0.2, 0.0], [-0.4, 0.1, 0.0]]
    (above,) = make_workspace(Scene(mujoco.MjModel.from_xml_string(ARM), None), [record(goals, [1, 1])], 2)["pictures"]
    assert [point[:2] for point in above["points"][0]] == [[0.3, 0.2], [-0.4, 0.1]]
    flat = mujoco.MjModel.from_xml_string(PLANAR)
    (plane,) = make_workspace(Scene(flat, None), [record([[0.3, 0.0, 0.5], [0.1, 0.0, 0.2]], [1, 1])], 2)["pictures"]
    assert [point[:2] for point in plane["points"][0]] == [[0.3, 0.5], [0.1, 0.2]]
    assert (plane["x"], plane["y"]) == ("x [m]", "z [m]")


def test_the_base_is_where_the_first_hinge_is_and_the_origin_for_what_has_none():
    model = mujoco.MjModel.from_xml_string(ARM.replace('pos="0 0 .2"', 'pos=".5 1 .2"'))
    np.testing.assert_allclose(find_base(model), [0.5, 1.0, 0.2])
    free = '<mujoco><worldbody><body pos="1 2 3"><freejoint/><geom size=".1"/></body></worldbody></mujoco>'
    np.testing.assert_allclose(find_base(mujoco.MjModel.from_xml_string(free)), 0.0)
