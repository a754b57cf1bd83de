"""The mathematics of the page's scripts, evaluated by a real browser and compared with Python's."""

import browsers
import numpy as np
import pages
import pytest
import scipy.spatial
from browsers import computed


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
