"""The page of a run in a real browser: it shows what the data says, and no request leaves it."""

import functools
import math
import re

import browsers
import mujoco
import numpy as np
import pages
import pytest
import scipy.ndimage
from browsers import frame_of, pixel, scrub, seen, stage_pixel

from jaxpg.watch import raster, solids
from jaxpg.watch.page import make_page
from jaxpg.watch.space import make_axes


@pytest.fixture(scope="module")
def tab_with():
    """`tab_with(color_scheme="dark")`: the one tab of all tests that has such options."""
    with browsers.launched() as browser:
        yield functools.cache(functools.partial(browsers.new_tab, browser))


@pytest.fixture
def show(tab_with, tmp_path):
    """`show(data, ...)` opens its page; in the end nothing was wrong and nothing but the file was asked for."""
    path, used = tmp_path / "page.html", []

    def opened(data, **options):
        path.write_text(make_page(data), encoding="utf-8")
        used.append(tab_with(**options))
        used[-1].page.set_viewport_size({"width": 1280, "height": 900})
        used[-1].page.goto(path.as_uri())
        used[-1].page.wait_for_selector(".scrubbed, .curve svg", state="attached")
        return used[-1].page

    yield opened
    wrong = [text for tab in used for text in tab.wrong]
    asked = {url for tab in used for url in tab.asked}
    for tab in used:
        tab.wrong.clear()
        tab.asked.clear()
    assert wrong == []
    assert asked - {"data:,"} == {path.as_uri()}


def test_the_player_plays_by_the_clock_and_pauses(show):
    tab = show(pages.pendulum(), clock=True)
    assert frame_of(tab) == 0
    for speed, frames in [("1", 20), ("4", 80), ("0.25", 5)]:
        scrub(tab, 0)
        tab.select_option("#speed", speed)
        tab.click("#play")
        tab.clock.run_for(1000)
        tab.click("#play")
        assert abs((at := frame_of(tab)) - frames) <= 2
        tab.clock.run_for(1000)
        assert frame_of(tab) == at


def test_the_player_stops_at_the_end_and_begins_again(show):
    tab = show(pages.pendulum(), clock=True)
    scrub(tab, 95)
    tab.click("#play")
    tab.clock.run_for(1000)
    assert (frame_of(tab), tab.get_attribute("#play", "aria-label")) == (100, "play")
    tab.click("#play")
    tab.clock.run_for(500)
    assert 5 < frame_of(tab) < 15


def test_scrubbing_moves_every_view(show):
    data = pages.pendulum()
    tab = show(data)
    before = [seen(tab, part) for part in ("#stage", ".map", ".panels")]
    scrub(tab, 40)
    assert all(seen(tab, part) != old for part, old in zip(("#stage", ".map", ".panels"), before, strict=True))
    assert tab.inner_text("#time") == "2.00 / 5.00 s"
    episode = data["player"]["policies"][1]["episodes"][0]
    so_far, torque = sum(episode["series"]["reward"][:40]), episode["series"]["torque [N m]"][40]
    assert f"so far {so_far:.1f} of {episode['return']:.1f}".replace("-", "\u2212") in tab.inner_text("#so-far")
    assert tab.text_content(".panels text.strong") == f"{torque:.2f}".replace("-", "\u2212")


def test_pointing_in_the_panels_scrubs(show):
    tab = show(pages.pendulum())
    box = tab.locator(".scrubbed").bounding_box()
    tab.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 60)
    tab.mouse.down()
    middle = frame_of(tab)
    tab.mouse.move(box["x"] + 2 * box["width"], box["y"] + 60)
    tab.mouse.up()
    assert 30 < middle < 70
    assert frame_of(tab) == 100


def test_the_keyboard_moves_the_player(show):
    tab = show(pages.pendulum())
    moves = [("ArrowRight", 1), ("Shift+ArrowRight", 11), ("ArrowLeft", 10), ("End", 100), ("Shift+ArrowLeft", 90)]
    for key, frame in [*moves, ("Home", 0), ("ArrowLeft", 0)]:
        tab.keyboard.press(key)
        assert frame_of(tab) == frame, key
    tab.keyboard.press("]")
    assert tab.is_checked("#episode label:nth-of-type(2) input")
    tab.keyboard.press("[")
    tab.keyboard.press("[")
    assert tab.is_checked("#episode label:nth-of-type(3) input")
    tab.keyboard.press("p")
    assert tab.is_checked("#policy label:nth-of-type(1) input")
    tab.keyboard.press("Space")
    assert tab.get_attribute("#play", "aria-label") == "pause"
    tab.keyboard.press("Space")
    assert tab.get_attribute("#play", "aria-label") == "play"


def test_every_control_is_reached_by_tab_with_a_visible_focus(show):
    tab = show(pages.pendulum())
    reached = []
    for _ in range(10):
        tab.keyboard.press("Tab")
        code = """() => {
          const at = document.activeElement;
          const shown = at.type === "radio" ? at.nextSibling : at;
          return [at.id || at.name || at.className || at.localName, getComputedStyle(shown).outlineStyle];
        }"""
        reached.append(tab.evaluate(code))
    names = ["theme", "scrolled", "policy", "episode", "ghost", "stage", "play", "scrub", "speed", "curve"]
    assert reached == [[name, "solid"] for name in names]


@pytest.mark.parametrize("part", ["#policy label:nth-of-type(1)", "#episode label:nth-of-type(3)", ".ghost"])
@pytest.mark.parametrize("data", [pages.pendulum, pages.arm, pages.turner])
def test_a_choice_changes_what_is_drawn(show, data, part):
    tab = show(data())
    scrub(tab, 30)
    before = seen(tab, "#stage"), seen(tab, ".panels")
    tab.click(part)
    assert frame_of(tab) == 30
    assert seen(tab, "#stage") != before[0]
    assert seen(tab, ".panels") != before[1]


def test_parts_are_drawn_where_they_are(show):
    data = pages.arm()
    tab = show(data)
    for frame in (0, 25, 100):
        scrub(tab, frame)
        share = 1 - math.exp(-2 * frame * pages.DT)
        upper, fore = 0.6 * share, 1.7 * share
        middles = 0.25 * np.exp(1j * upper), 0.5 * np.exp(1j * upper) + 0.25 * np.exp(1j * fore)
        for middle, part in zip(middles, data["player"]["parts"], strict=True):
            expected = tuple(bytes.fromhex(part["color"][1:]))
            assert stage_pixel(tab, data, middle.real, middle.imag) == expected


@pytest.mark.parametrize(("torque", "sign"), [(2.0, 1), (1.2, 1), (-0.6, 1), (-2.0, 1), (0.6, -1)])
def test_torques_are_arcs_from_the_top_counter_clockwise_if_positive(show, torque, sign):
    """Three quarters of a turn at the limit of 2 N m; looked for half way between up, left, down and right."""
    data = pages.pendulum()
    data["player"]["motors"][0]["sign"] = sign
    for episode in (one for policy in data["player"]["policies"] for one in policy["episodes"]):
        episode["series"]["torque [N m]"] = [torque] * 100
    tab = show(data)
    scrub(tab, 60)  # the rod points upwards
    for turn in (45, 135, 225, 315):
        place = 0.09 * 2.5 * 1j * np.exp(1j * np.radians(turn) * np.sign(torque * sign))
        is_drawn = stage_pixel(tab, data, place.real, place.imag) == (194, 78, 0)
        assert is_drawn == (turn < 270 * abs(torque) / 2.0)


def looked_at(data, frame, size, azimuth=0.0, elevation=0.0):
    """The same picture by NumPy: which part each pixel shows, 0 for none, `[H, W]`; its camera; where the site is."""
    space, model = data["player"]["space"], mujoco.MjModel.from_xml_string(pages.TURNER)
    axes = make_axes(space["azimuth"] + azimuth, space["elevation"] + elevation)
    half = math.radians(17.5)
    eye = np.array(space["center"]) + space["radius"] / math.sin(half) * axes[2]
    camera = raster.Camera(eye, axes, min(size) / 2 / math.tan(half), size, 0.1)
    picture = raster.Raster(np.zeros((size[1], size[0], 3)), np.zeros((size[1], size[0])))
    state = mujoco.MjData(model)
    state.qpos = frame * pages.DT * np.array([0.5, 0.4])
    mujoco.mj_kinematics(model, state)
    for number, part in enumerate(solids.make_parts(model), start=1):
        placed = part.solid.vertices @ state.xmat[part.body].reshape(3, 3).T + state.xpos[part.body]
        corners, _ = raster.list_corners(camera, placed, part.solid.triangles)
        raster.paint(picture, corners, np.ones((len(corners), 3)), np.full((len(corners), 3), number / 2))
    return np.rint(2 * picture.color[..., 0]).astype(int), camera, state.site_xpos[0]


def assert_shows(tab, data, frame, azimuth=0.0, elevation=0.0):
    """The stage shows the red column and the blue beam where they are; edges and axes are not looked at."""
    box = tab.locator("#stage").bounding_box()
    size = round(box["width"]) - 2, round(box["height"]) - 2
    parts, camera, tip = looked_at(data, frame, size, azimuth, elevation)
    goal = data["player"]["policies"][1]["episodes"][0]["goals"][0]
    rows, columns = np.indices(parts.shape)
    sure = scipy.ndimage.minimum_filter(parts, 7) == scipy.ndimage.maximum_filter(parts, 7)
    for x, y, _ in raster.project(camera, np.array([goal, tip])):
        sure &= np.hypot(columns - x, rows - y) > 90
    rng = np.random.default_rng(frame)
    for part in (1, 2):
        places = np.argwhere(sure & (parts == part))
        assert len(places) > 200
        for row, column in rng.choice(places, 12):
            red, _, blue = pixel(tab, "#stage", (column + 1) / size[0], (row + 1) / size[1])
            assert (red > 1.5 * blue, blue > 1.5 * red) == (part == 1, part == 2)


def test_a_robot_in_space_is_drawn_where_it_is_and_what_is_nearer_hides_what_is_farther(show):
    data = pages.turner()
    tab = show(data)
    for frame in (0, 25, 60):
        scrub(tab, frame)
        assert_shows(tab, data, frame)


def test_dragging_turns_the_robot_and_does_not_play(show):
    """Half a degree for each pixel: to the right its front goes to the right, down one looks from above."""
    data = pages.turner()
    tab = show(data)
    scrub(tab, 25)
    box = tab.locator("#stage").bounding_box()
    tab.mouse.move(box["x"] + 300, box["y"] + 200)
    tab.mouse.down()
    for step in range(1, 5):
        tab.mouse.move(box["x"] + 300 - 30 * step, box["y"] + 200 + 15 * step)
    tab.mouse.up()
    assert tab.get_attribute("#play", "aria-label") == "play"
    assert_shows(tab, data, 25, azimuth=60, elevation=-30)
    tab.mouse.click(box["x"] + 300, box["y"] + 200)
    assert tab.get_attribute("#play", "aria-label") == "pause"
    assert tab.eval_on_selector("#stage", "(e) => getComputedStyle(e).touchAction") == "pan-y"  # a finger can scroll


def test_a_key_changes_from_where_it_is_seen(show):
    data = pages.turner()
    tab = show(data)
    scrub(tab, 25)
    first = {name: data["player"]["space"][name] for name in ("azimuth", "elevation")}
    for azimuth, elevation in [(90, 0), (180, 0), (90, -89.9), tuple(first.values())]:
        tab.keyboard.press("v")
        assert_shows(tab, data, 25, azimuth - first["azimuth"], elevation - first["elevation"])
    tab.keyboard.press("Control+v")  # pastes
    assert_shows(tab, data, 25)


def test_a_goal_that_is_turned_is_drawn_with_its_axes(show):
    """Red, green and blue are x, y and z; looked for half way along them, from where the robot hides none."""
    data = pages.turner()
    tab = show(data)
    scrub(tab, 0)
    box = tab.locator("#stage").bounding_box()
    size = round(box["width"]) - 2, round(box["height"]) - 2
    parts, camera, _ = looked_at(data, 0, size)
    episode = data["player"]["policies"][1]["episodes"][0]
    place, turn = np.array(episode["goals"][0]), np.reshape(episode["turns"][0], (3, 3))
    for axis in range(3):
        x, y, _ = raster.project(camera, place + 0.75 * 3 * pages.GOAL_RADIUS * turn[:, axis])
        assert parts[round(y), round(x)] == 0
        colours = np.array([pixel(tab, "#stage", (x + dx) / size[0], (y + dy) / size[1]) for dx, dy in NEARBY])
        assert (np.argmax(colours, axis=1) == axis).any()


NEARBY = [(x, y) for x in (0, 1, 2) for y in (0, 1, 2)]


def test_a_robot_that_runs_is_followed(show):
    """The column on a base that goes 50 m: it is in the middle of the picture at the end as at the beginning."""
    data = pages.turner()
    space = data["player"]["space"]
    for body in space["bodies"]:
        body["parent"] += 1
    moving = {"kind": "slide", "body": 1, "first": 2, "position": [0, 0, 0], "axis": [1, 0, 0], "reference": 0}
    space["bodies"].insert(0, {"parent": 0, "position": [0, 0, 0], "turn": [1, 0, 0, 0]})
    for one in (*space["joints"], *space["parts"], space["site"]):
        one["body"] += 1
    space["joints"].append(moving)
    for episode in (one for policy in data["player"]["policies"] for one in policy["episodes"]):
        path = np.linspace(0, pages.INT16, episode["frames"])
        qpos = np.zeros((episode["frames"], 3))
        qpos[:, 2] = path
        episode |= {"qpos": pages.packed(qpos), "units": [1.0, 1.0, 50 / pages.INT16], "goals": None, "turns": None}
        shifts = np.column_stack([path, 0 * path])
        episode |= {"shifts": pages.packed(shifts), "shift_units": [50 / pages.INT16, 1.0]}
    tab = show(data)
    for frame in (0, 30, 60):
        scrub(tab, frame)
        data_at_rest = {"player": {**data["player"], "policies": [None, {"episodes": [{"goals": [[9, 9, 9]]}]}]}}
        assert_shows(tab, data_at_rest, 0)


def test_a_box_is_drawn_with_its_corners(show):
    """Eight corners of 1.2 x 0.6 m: a pill within them would leave its corners free."""
    data = pages.pendulum()
    corners = [[x, y, z] for x in (-0.6, 0.6) for y in (-0.3, 0.3) for z in (-0.1, 0.1)]
    data["player"]["parts"] = [{"points": corners, "radius": 0.0, "color": "#4d66cc"}]
    for one in (one for policy in data["player"]["policies"] for one in policy["episodes"]):
        still = pages.rod(0, 0, np.zeros(one["frames"]))
        one |= {"parts": pages.packed(still * pages.INT16), "scale": 1 / pages.INT16}
        one["series"]["torque [N m]"] = [0.0] * (one["frames"] - 1)
    tab = show(data)
    for x in (-0.57, 0.57):
        for y in (-0.27, 0.27):
            assert stage_pixel(tab, data, x, y) == (77, 102, 204)
            assert stage_pixel(tab, data, 1.12 * x, 1.2 * y) != (77, 102, 204)


def test_an_instant_has_one_value(show):
    """Beside the map stands what the panel shows at that time, though the map is as coarse as its grid."""
    data = pages.pendulum()
    tab = show(data)
    for frame in (0, 13, 40, 99):
        scrub(tab, frame)
        shown = data["player"]["policies"][1]["episodes"][0]["series"]["value"][frame]
        words = f"{shown:.2f}".replace("-", "\u2212")
        assert tab.inner_text(".map + .reading").endswith(f": value {words}")
        assert tab.locator(".panels text.strong").last.text_content() == words


def test_a_path_over_an_axis_that_wraps_does_not_cross_the_picture(show):
    tab = show(pages.pendulum())
    tab.click("#policy label:nth-of-type(1)")  # turns over and over
    pieces = tab.get_attribute(".pale-path", "d").split("M")[1:]
    width = tab.eval_on_selector(".map clipPath rect", "(e) => Number(e.getAttribute('width'))")
    assert len(pieces) > 2
    for piece in pieces:
        x = [float(point.split()[0]) for point in piece.split("L")]
        assert np.abs(np.diff(x)).max() < 0.1 * width


@pytest.mark.parametrize("axis", [0, 1])
def test_the_map_is_lightest_where_the_value_is_highest(show, axis):
    """Values that rise along x, or y, from 0 to 1."""
    data = pages.pendulum()
    rising = np.moveaxis(np.tile(np.linspace(0, 1, 41), (41, 1)), 1, 1 - axis)
    grid = {"low": 0.0, "high": 1.0, "data": pages.packed(rising * pages.INT16)}
    data["portrait"]["values"] = [grid, grid]
    tab = show(data)
    ends = [(0.02, 0.5), (0.98, 0.5)] if axis == 0 else [(0.5, 0.98), (0.5, 0.02)]  # from the top left corner
    low, high = (sum(browsers.pixel(tab, ".map canvas:nth-of-type(2)", *end)) for end in ends)
    assert high > low + 300
    box = tab.locator(".map canvas:nth-of-type(2)").bounding_box()
    for share, end in zip((0.02, 0.98), ends, strict=True):
        tab.mouse.move(box["x"] + end[0] * box["width"], box["y"] + end[1] * box["height"])
        assert float(tab.inner_text(".map + .reading").split()[-1]) == pytest.approx(share, abs=0.02)


def test_the_workspace_counts_what_it_draws(show):
    tab = show(pages.arm())
    for policy, reached in [(2, 117), (1, 3)]:
        tab.click(f"#policy label:nth-of-type({policy})")
        assert tab.locator(".workspace .success").count() == reached
        assert tab.locator(".workspace .failure").count() == 120 - reached
        assert f"{reached} of 120" in tab.inner_text(".counts .strong")


def test_the_workspace_of_a_robot_in_space_is_seen_from_above_and_from_the_side(show):
    """Side by side; every goal is in both; a metre is as long in all directions."""
    data = pages.turner()
    tab = show(data)
    pictures = tab.locator(".workspace svg")
    assert [pictures.nth(i).locator(".success").count() for i in range(2)] == [10, 10]
    assert [pictures.nth(i).locator(".failure").count() for i in range(2)] == [10, 10]
    boxes = [pictures.nth(i).bounding_box() for i in range(2)]
    assert boxes[0]["y"] == boxes[1]["y"]
    assert boxes[0]["x"] + boxes[0]["width"] <= boxes[1]["x"]
    circle = pictures.nth(0).locator(".limit").bounding_box()
    assert circle["width"] == pytest.approx(circle["height"], rel=0.02)
    assert "10 of 20" in tab.inner_text(".counts .strong")


def test_curves_are_read_by_keyboard_and_by_pointing(show):
    data = pages.comparison()
    tab = show(data)
    first = tab.locator(".curve").first
    first.focus()
    tab.keyboard.press("Home")
    tab.keyboard.press("ArrowRight")
    mean = data["curves"][0]["series"][0]["mean"][1]
    read = f"at 40,000 environment steps: ppo {mean:.1f}".replace("-", "\u2212")
    assert first.get_attribute("aria-valuetext").startswith(read)
    first.hover()
    assert first.get_attribute("aria-valuenow") in ("11", "12", "13")


def test_references_are_lines_where_there_is_room_and_words_elsewhere(show):
    tab = show(pages.pendulum())
    first = tab.locator(".curve").first
    assert first.locator(".reference").count() == 1
    assert "best possible \u2212137.4" in first.text_content()
    assert tab.get_by_text("outside the picture").inner_text().endswith("far away \u2212100,000")


def test_the_head_says_what_the_policies_are_worth_and_the_foot_how_to_get_them(show):
    tab = show(pages.pendulum(notes=["no workspace: there is none"]))
    assert tab.locator(".facts + .scrolled td").first.inner_text() == "before training"
    assert tab.inner_text(".remarks li") == "no workspace: there is none"
    assert tab.inner_text("pre") == "python -m jaxpg.train env=pendulum env.mass=2.0"
    assert tab.inner_text("summary >> nth=0") == "Configuration (3, 1 not the default)"
    assert tab.locator(".differs").all_text_contents() == ["env.mass2.0 default 1.0"]


@pytest.mark.parametrize("page_of", [pages.pendulum, pages.comparison])
def test_on_a_phone_the_return_is_seen_without_scrolling(show, page_of):
    tab = show(page_of())
    tab.set_viewport_size({"width": 360, "height": 800})
    table = tab.locator("table").first
    header = table.locator("th").filter(has_text="return")
    assert header.count() == 1
    for cell in [header, table.locator("tbody tr:first-child td:nth-child(2)")]:
        box = cell.bounding_box()
        assert box["x"] + box["width"] <= 360


def test_too_few_seeds_are_neither_bold_nor_shaded(show):
    """Though each run of the one is better than each of the other."""
    data = pages.comparison()
    for row, column, p in [(0, 1, 1.0), (1, 0, 0.0)]:
        data["improvement"]["probability"][row][column] = p
        data["improvement"]["low"][row][column] = data["improvement"]["high"][row][column] = None
    tab = show(data)
    cell = tab.locator(".matrix tbody tr:nth-child(1) td").nth(1)
    assert cell.inner_text().split("\n") == ["1.00", "too few seeds"]
    assert cell.locator("b").count() == 0
    assert cell.get_attribute("class") == "number"
    sure = tab.locator(".matrix tbody tr:nth-child(1) td").nth(2)
    assert sure.locator("b").count() == 1


def test_a_part_that_fails_takes_nothing_else_with_it(tab_with, tmp_path):
    data = pages.pendulum()
    data["portrait"]["values"] = None
    path = tmp_path / "broken.html"
    path.write_text(make_page(data), encoding="utf-8")
    tab = tab_with().page.context.new_page()
    tab.goto(path.as_uri())
    tab.wait_for_selector(".curve svg", state="attached")
    assert "This part could not be drawn" in tab.locator("section").first.inner_text()
    assert tab.locator("h2").all_inner_texts()[:2] == ["Rollout", "Learning"]
    assert tab.locator("details").count() == 2
    tab.close()


def test_dark_differs_from_light_and_the_button_overrides(show):
    light, dark = (show(pages.pendulum(), color_scheme=scheme) for scheme in ("light", "dark"))
    night = seen(dark, "#stage")
    assert seen(light, "#stage") != night
    light.click("#theme")
    assert light.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(20, 23, 27)"
    assert seen(light, "#stage") == night
    assert light.inner_text("#theme") == "light"


def test_paper_is_white_and_the_screen_stays_dark(show):
    tab = show(pages.pendulum(), color_scheme="dark")
    before = seen(tab, "#stage")
    tab.emulate_media(media="print")
    assert tab.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    printed = seen(tab, "#stage")
    assert len(tab.pdf()) > 10_000
    tab.emulate_media(media="screen")
    assert printed != before
    assert seen(tab, "#stage") == before


@pytest.mark.parametrize("data", [pages.pendulum, pages.arm, pages.turner, pages.comparison])
def test_the_page_never_scrolls_sideways(show, data):
    tab = show(data())
    tab.eval_on_selector_all("details", "(all) => all.forEach((one) => { one.open = true; })")
    for width in (1280, 700, 360):
        tab.set_viewport_size({"width": width, "height": 900})
        tab.wait_for_function("() => document.querySelector('.curve svg').getBoundingClientRect().right <= innerWidth")
        assert tab.evaluate("document.scrollingElement.scrollWidth <= innerWidth")


def test_the_drawings_follow_the_window(show):
    tab = show(pages.pendulum(), device_scale_factor=2)
    for width in (1280, 500):
        tab.set_viewport_size({"width": width, "height": 900})
        tab.wait_for_function("(e) => e.width === 2 * e.clientWidth", arg=tab.query_selector("#stage"))
        sides = "(e) => [e.getBoundingClientRect().right, e.parentNode.getBoundingClientRect().right]"
        drawn, room = tab.eval_on_selector(".scrubbed", sides)
        assert abs(drawn - room) < 2


def test_details_open(show):
    tab = show(pages.pendulum())
    assert not tab.is_visible("text=algo.gamma")
    tab.click("summary >> nth=0")
    assert tab.is_visible("text=algo.gamma")


def test_what_the_data_does_not_have_is_not_there(show):
    tab = show(pages.comparison())
    assert tab.locator("#stage, .map, .workspace, details").count() == 0
    assert tab.locator("h2").all_inner_texts() == ["Learning", "Runs, the best first", "Probability of improvement"]


def test_texts_are_never_read_as_html(show):
    nasty = pages.NASTY
    data = pages.arm() | {"title": nasty, "facts": [[nasty, nasty]], "configuration": [[nasty, nasty]]}
    data |= {key: pages.comparison()[key] for key in ("tables", "improvement")}
    for policy in data["player"]["policies"]:
        policy["label"] = policy["note"] = nasty
    data["tables"][0]["rows"][0][0] = data["improvement"]["labels"][0] = data["curves"][0]["title"] = nasty
    data["workspace"]["title"] = data["workspace"]["pictures"][0]["x"] = data["curves"][0]["series"][0]["label"] = nasty
    tab = show(data)
    assert tab.locator("img, script").count() == 2
    assert tab.locator(".facts dd").text_content() == nasty


@pytest.mark.parametrize("policy", [True, False])
def test_no_request_can_leave_the_page_and_the_policy_is_why(tab_with, policy):
    text = make_page(pages.comparison())
    server = browsers.Server(text if policy else re.sub("<meta http-equiv.*>", "", text))
    tab = tab_with().page.context.new_page()
    tab.goto(server.url)
    assert tab.evaluate(browsers.EVERY_WAY) == ("refused" if policy else "sent")
    tab.wait_for_load_state("networkidle")
    assert len(server.asked) == (0 if policy else 9)
    tab.close()
    server.shutdown()
    server.server_close()
