"""Videos: what is drawn is where it should be, time is real, and what cannot be drawn or written is said in a line."""

import contextlib
import functools
import math
import os
import subprocess
import sys
from fractions import Fraction

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageSequence
from spatial import ARM as ARM_IN_SPACE
from spatial import RUNNER
from stored import a_policy

from envs.options import OptionError
from envs.scenes import find_scene
from jaxpg import render as command_line
from jaxpg.errors import UserError
from jaxpg.watch import gl, movie, raster, sketch, solids, space, video
from jaxpg.watch.clips import Clip
from jaxpg.watch.recording import Look

SMALL = ("network.widths=[8]", "num_envs=2", "algo.num_shards=1", "algo.minibatches=1")
# Without equations of the physics, which take a while to make.
PENDULUM = ("env=pendulum", "env.physics=mujoco", "env.episode_length=7", *SMALL)
ARM = ("env=arm", "env.physics=mujoco", "env.episode_length=5", *SMALL)
SIZE = 120


# --- which OpenGL -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("asked", "there", "found", "tried"),
    [
        (None, {"egl", "osmesa"}, "egl", ["egl"]),
        (None, {"osmesa"}, "osmesa", ["egl", "osmesa"]),
        ("", {"osmesa"}, "osmesa", ["egl", "osmesa"]),
        ("osmesa", {"egl", "osmesa"}, "osmesa", ["osmesa"]),
        (" EGL", {"egl"}, "egl", ["egl"]),
        ("glfw", {"egl", "glfw"}, "", ["glfw"]),
    ],
)
def test_what_the_user_asks_for_comes_before_egl_and_that_before_osmesa(asked, there, found, tried):
    attempts = []
    environment = {} if asked is None else {"MUJOCO_GL": asked}
    assert gl.find_backend(environment, lambda name: attempts.append(name) or name in there, "linux") == found
    assert attempts == tried


def test_where_there_is_no_opengl_none_is_found():
    assert gl.find_backend({}, lambda name: False, "linux") is None
    assert gl.find_backend({"MUJOCO_GL": " "}, lambda name: False, "darwin") is None


def test_a_mac_has_a_backend_of_its_own():
    assert gl.find_backend({}, lambda name: name == "", "darwin") == ""


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ("egl", "^MUJOCO_GL=egl: .*; apt-get install libegl1 libgl1-mesa-dri, or unset it$"),
        ("osmesa", "^MUJOCO_GL=osmesa: .*; apt-get install libosmesa6, or unset it$"),
        ("glfw", "^MUJOCO_GL=glfw: .*here; unset it$"),
    ],
)
def test_where_what_the_user_asks_for_fails_the_line_says_what_to_install(asked, message):
    with pytest.raises(UserError, match=message):
        gl.find_backend({"MUJOCO_GL": asked}, lambda name: False, "linux")


def test_a_backend_that_fails_fails_elsewhere():
    """MuJoCo refuses this name when it is imported, which here it may have been long ago."""
    assert not gl.is_working("no-such-backend")


# --- the pictures -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def backend():
    try:
        found = gl.find_backend(os.environ, gl.is_working)
    except UserError as error:
        pytest.skip(str(error))
    return pytest.skip("needs OpenGL: apt-get install libegl1 libgl1-mesa-dri") if found is None else found


@pytest.fixture(scope="module")
def draw(backend):
    """`draw(options, (qpos, goal, efforts), ..., size=)`: the picture, `[H, W, 3]`, without captions."""
    from jaxpg.watch.canvas import Canvas, Cell

    with contextlib.ExitStack() as stack:

        @functools.cache
        def canvas(options, number, size):
            view = find_scene(a_policy(*options).env)
            return stack.enter_context(Canvas(view.model, backend, video.choose_grid(number), size, view.goal_radius))

        def drawn(options, *states, size=(SIZE, SIZE)):
            cells = [Cell(*(None if x is None else np.array(x, float) for x in state), "") for state in states]
            return canvas(options, len(cells), size).draw(cells).astype(int)

        yield drawn


def pixel(options, point, size=(SIZE, SIZE)):
    """Column and row at which the model's first camera sees a point [m]; and how many pixels a metre is there."""
    model, (width, height) = find_scene(a_policy(*options).env).model, size
    x, y, z = model.cam_mat0[0].reshape(3, 3).T @ (np.array(point) - model.cam_pos[0])
    unit = height / 2 / math.tan(math.radians(model.cam_fovy[0]) / 2) / -z
    return np.array([width / 2 + x * unit, height / 2 - y * unit]) - 0.5, unit


def where(mask):
    """Columns and rows of the pixels in a mask, `[K, 2]`."""
    return np.argwhere(mask)[:, ::-1]


def changed(a, b):
    return np.abs(a - b).max(axis=-1) > 30


def seen(image):
    """What is not background."""
    return changed(image, image[-1, -1])


@pytest.mark.parametrize("goal", [(0.6, 0.3, 0.0), (-0.2, -0.9, 0.0)])
def test_the_goal_is_where_it_is_and_as_large(goal, draw):
    qpos = (2.0, 0.5)
    mask = changed(draw(ARM, (qpos, goal, (0, 0))), draw(ARM, (qpos, None, (0, 0))))
    place, unit = pixel(ARM, goal)
    np.testing.assert_allclose(where(mask).mean(axis=0), place, atol=0.7)
    assert math.sqrt(mask.sum() / math.pi) == pytest.approx(unit * find_scene(a_policy(*ARM).env).goal_radius, abs=0.7)


@pytest.mark.parametrize(
    "geoms",
    ['<geom size=".3" group="3"/>', '<inertial pos="0 0 0" mass="1" diaginertia=".1 .1 .1"/>'],
    ids=["group 3", "no geoms"],
)
def test_a_robot_without_visible_geoms_is_seen_all_the_same(geoms, backend):
    from jaxpg.watch.canvas import Canvas, Cell

    body = f'<body><joint type="hinge"/>{geoms}</body><geom type="plane" size="9 9 1" pos="0 0 -9"/>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    with Canvas(model, backend, (1, 1), (SIZE, SIZE)) as canvas:
        image = canvas.draw([Cell(np.zeros(1), None, np.zeros(0), "")]).astype(int)
    middle = image[SIZE // 2 - 5 : SIZE // 2 + 5, SIZE // 2 - 5 : SIZE // 2 + 5]
    assert changed(middle, np.broadcast_to(image[5, 5], middle.shape)).all()


def in_space(camera="", size=SIZE):
    """The robot in space, two of its poses, its framing, and where the camera sees a point: column and row."""
    model = mujoco.MjModel.from_xml_string(ARM_IN_SPACE.replace("<worldbody>", f"<worldbody>{camera}"))
    parts, qpos = solids.make_parts(model), np.array([[0.3, 0.4], [2.0, 1.0]])
    framing = space.make_framing(model, parts, [Look(qpos, np.tile([[0.4, 0.2, 0.9]], (2, 1)), None)])
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, qpos, framing, sketch.make_camera(model, data, framing, np.zeros(3), (size, size))


@pytest.fixture(params=["OpenGL", "no OpenGL"])
def draw_in_space(request):
    """`draw_in_space(model, framing, cell)`: a picture by MuJoCo's renderer, or without it."""

    def drawn(model, framing, cell, size=SIZE):
        if request.param == "no OpenGL":
            with sketch.Sketch(model, (1, 1), (size, size), 0.1, 0, framing) as tool:
                return tool.draw([cell]).astype(int)
        from jaxpg.watch.canvas import Canvas

        found = request.getfixturevalue("backend")
        with Canvas(model, found, (1, 1), (size, size), 0.1, 0, framing) as tool:
            return tool.draw([cell]).astype(int)

    return drawn


@pytest.mark.parametrize("camera", ["", '<camera pos="0 -3 .5" xyaxes="1 0 0 0 0 1" fovy="50"/>'])
def test_in_space_the_goal_is_where_the_camera_sees_it(draw_in_space, camera):
    """Beside the robot; a ball of 0.1 m, of which some may be below the floor."""
    from jaxpg.watch.canvas import Cell

    model, qpos, framing, seen_from = in_space(camera)
    goal, still = np.array([0.4, 0.2, 0.9]), (qpos[1], None, np.zeros(0), "")
    without = draw_in_space(model, framing, Cell(*still))
    mask = changed(draw_in_space(model, framing, Cell(qpos[1], goal, np.zeros(0), "")), without)
    x, y, depth = raster.project(seen_from, goal)
    np.testing.assert_allclose(where(mask).mean(axis=0), [x - 0.5, y - 0.5], atol=1.0)
    assert math.sqrt(mask.sum() / math.pi) == pytest.approx(0.1 * seen_from.focal / depth, rel=0.1)


def test_in_space_a_goal_that_is_turned_has_axes_in_the_colours_of_x_y_and_z(draw_in_space):
    from jaxpg.watch.canvas import Cell

    model, qpos, framing, seen_from = in_space(size=480)
    goal, turn = np.array([0.25, 0.0, 0.5]), np.eye(3)[:, [1, 2, 0]]
    cells = (Cell(qpos[1], goal, np.zeros(0), "", rotation) for rotation in (None, turn))
    plain, turned = (draw_in_space(model, framing, cell, size=480) for cell in cells)
    for axis in range(3):
        x, y, _ = np.rint(raster.project(seen_from, goal + 0.26 * turn[:, axis])).astype(int)  # of 0.3 m
        near = (slice(y - 2, y + 2), slice(x - 2, x + 2))
        new = (turned - plain)[near][changed(turned[near], plain[near])]  # also where it is seen through the ball
        assert len(new) > 0
        assert (np.argmax(new, axis=1) == axis).mean() > 0.7


def test_a_robot_that_runs_stays_in_the_middle_of_its_video(draw_in_space):
    """On the same place relative to the camera: the pictures differ only in what is on the ground."""
    from jaxpg.watch.canvas import Cell

    model = mujoco.MjModel.from_xml_string(RUNNER.replace('<geom type="box" size="1 1 .1" pos="9 9 9"/>', ""))
    parts, qpos = solids.make_parts(model), np.tile(model.qpos0, (3, 1))
    qpos[:, 0] = [0.0, 10.0, 20.0]  # whole meshes of the grid
    framing = space.make_framing(model, parts, [Look(qpos, None, None)])
    shifts = space.find_shifts(model, parts, qpos, framing)
    first, last = (draw_in_space(model, framing, Cell(qpos[i], None, np.zeros(0), "", None, shifts[i])) for i in (0, 2))
    assert changed(first, last).mean() < 0.02
    lost = draw_in_space(model, framing, Cell(qpos[2], None, np.zeros(0), ""))
    assert changed(first, lost).mean() > 0.05


@pytest.mark.parametrize("theta", [0.0, 1.0, -2.2])
def test_the_rod_is_where_the_angle_says(theta, draw):
    """Positive angles lean to the left."""
    image = draw(PENDULUM, ((theta,), None, (0,)))
    rod = image[..., 0] - image[..., 2] > 60
    middle = (-0.5 * math.sin(theta), 0.0, 0.5 * math.cos(theta))
    np.testing.assert_allclose(where(rod).mean(axis=0), pixel(PENDULUM, middle)[0], atol=2)  # the pivot hides an end


@pytest.mark.parametrize("effort", [0.25, -0.25, 0.8, -0.8, 5.0])
def test_an_arc_sweeps_three_quarters_of_a_turn_at_the_limit(effort, draw):
    """From the top, counter-clockwise where the command is positive; no further where it is beyond the limit."""
    qpos = (math.pi,)
    points = where(changed(draw(PENDULUM, (qpos, None, (effort,))), draw(PENDULUM, (qpos, None, (0,)))))
    x, y = ((points - pixel(PENDULUM, (0, 0, 0))[0]) * (1, -1)).T
    turned = np.sign(effort) * np.arctan2(-x, y) % (2 * math.pi)
    sweep = 1.5 * math.pi * min(abs(effort), 1)
    inside = (turned < sweep + 0.5) | (turned > 2 * math.pi - 0.3)  # the head is ahead of it and behind
    assert inside.all()
    covered = np.histogram(turned, bins=np.linspace(0, sweep, 12))[0]
    assert (covered > 0).all()
    assert np.ptp(np.hypot(x, y)) < 12  # a circle about the hinge


def test_the_sense_of_a_torque_has_a_colour(draw):
    def colour(effort):
        states = [((math.pi,), None, (e,)) for e in (effort, 0.0)]
        one, none = (draw(PENDULUM, state) for state in states)
        return one[changed(one, none)].mean(axis=0)

    (red, _, blue), (red_back, _, blue_back) = colour(0.5), colour(-0.5)
    assert red - blue > 50
    assert blue_back - red_back > 20


def test_nothing_is_drawn_of_an_effort_that_is_none(draw):
    still = draw(PENDULUM, ((1.0,), None, (0.0,)))
    for effort in (0.001, math.nan):
        np.testing.assert_array_equal(draw(PENDULUM, ((1.0,), None, (effort,))), still)


@pytest.mark.parametrize(
    "size", [(SIZE, SIZE), (SIZE, SIZE // 2), (SIZE // 2, SIZE)], ids=["square", "wide", "upright"]
)
@pytest.mark.parametrize(("options", "joints"), [(PENDULUM, 1), (ARM, 2)], ids=["pendulum", "arm"])
def test_the_whole_workspace_is_seen(options, joints, size, draw):
    """Stretched out in any direction, the robot does not touch the picture's edge."""
    for angle in np.linspace(-math.pi, math.pi, 4, endpoint=False):
        image = draw(options, ((angle, *[0.0] * (joints - 1)), None, [0.0] * joints), size=size)
        assert seen(image).sum() > 50
        assert not seen(image)[[0, -1]].any()
        assert not seen(image)[:, [0, -1]].any()


def test_a_grid_has_the_pictures_side_by_side(draw):
    """Row by row; each is what it is alone, but for the line between them; where there is none left it is grey."""
    from jaxpg.watch.canvas import BORDER, EMPTY

    states = [((theta,), None, (0.5,)) for theta in (0.0, 1.0, 2.0)]
    image = draw(PENDULUM, *states)
    assert image.shape == (2 * SIZE, 2 * SIZE, 3)
    assert (image[SIZE] == BORDER).all()
    assert (image[:, SIZE] == BORDER).all()
    places = image.reshape(2, SIZE, 2, SIZE, 3).swapaxes(1, 2).reshape(4, SIZE, SIZE, 3)[:, 1:, 1:]
    for found, state in zip(places, states, strict=False):
        np.testing.assert_allclose(found, draw(PENDULUM, state)[1:, 1:], atol=2)
    np.testing.assert_allclose(places[3], np.round(255 * EMPTY[0]), atol=1)


def test_pictures_with_captions_differ_in_a_corner_alone(backend):
    from jaxpg.watch.canvas import Canvas, Cell

    view = find_scene(a_policy(*PENDULUM).env)
    with Canvas(view.model, backend, (1, 1), (2 * SIZE, 2 * SIZE)) as canvas:
        first, second = (canvas.draw([Cell(np.zeros(1), None, np.zeros(1), text)]) for text in ("", "1.00 s"))
    points = where((first != second).any(axis=-1))
    assert len(points) > 0
    assert (points.max(axis=0) < (SIZE, SIZE // 2)).all()


@given(number=st.integers(1, 64))
def test_a_grid_has_a_place_for_each_and_no_row_too_many(number):
    rows, columns = video.choose_grid(number)
    assert (rows - 1) * columns < number <= rows * columns
    assert rows <= columns <= rows + 1


# --- time -------------------------------------------------------------------------------------------------------------


@given(
    dt=st.sampled_from([0.002, 0.005, 0.008, 1 / 60, 0.02, 0.05, 1.0]),
    speed=st.sampled_from([0.1, 0.5, 1.0, 1.5, 10.0]),
    most=st.integers(1, 240),
)
def test_pictures_come_in_time_and_not_too_fast(dt, speed, most):
    every, seconds = video.choose_pace(dt, speed, most)
    assert float(seconds) == pytest.approx(every * dt / speed, rel=1e-6)
    assert seconds * most >= 1
    assert every == 1 or (seconds / every) * (every - 1) * most < 1  # one step less would be too fast


def test_a_step_that_float_has_not_exactly_is_not_left_out():
    assert video.choose_pace(float(np.float32(0.02)), 1.0, 50) == (1, Fraction(1, 50))


def made_clip(length, success=None):
    look = Look(np.arange(length + 1.0)[:, None], None, None)
    series = {name: np.arange(length) / 4 for name in ("torque [N m]", "reward", "value")}
    so_far = np.append(0.0, np.cumsum(series["reward"]))
    return Clip(look, series, so_far, dt=0.05, episode_return=so_far[-1], success=success)


def test_after_its_end_an_episode_shows_its_last_frame():
    stored = a_policy(*PENDULUM)
    one, other = made_clip(5), made_clip(3, success=True)
    assert video.shown_steps([one, other], 2) == [0, 2, 4, 5]
    cells = [video.make_cell(stored, find_scene(stored.env), other, step) for step in range(6)]
    assert [float(cell.qpos[0]) for cell in cells] == [0, 1, 2, 3, 3, 3]
    assert [float(cell.efforts[0]) for cell in cells] == [0, 0.125, 0.25, 0, 0, 0]  # of the limit, 2 N m
    assert cells[2].caption == "0.10 s  return 0.2"
    assert cells[3].caption == cells[5].caption == "0.15 s  return 0.8  success"


def read(path):
    """The frames of a file, and how long each is shown [s]."""
    if path.suffix == ".gif":
        with Image.open(path) as file:
            found = [
                (np.asarray(one.convert("RGB")), one.info["duration"] / 1000) for one in ImageSequence.Iterator(file)
            ]
    else:
        import av

        with av.open(str(path)) as file:
            found = [(one.to_ndarray(format="rgb24"), float(one.duration * one.time_base)) for one in file.decode()]
    return [frame for frame, _ in found], [seconds for _, seconds in found]


def some_images(number, height=32, width=48):
    """A white square on its way through a blue picture."""
    for i in range(number):
        image = np.zeros((height, width, 3), np.uint8)
        image[..., 2] = 200
        image[8:16, 2 * i : 2 * i + 8] = 255
        yield image


@pytest.mark.parametrize("suffix", movie.FORMATS)
@pytest.mark.parametrize("seconds", [Fraction(1, 20), Fraction(1, 30), Fraction(3, 125)])
def test_what_is_written_is_read_back_in_time(suffix, seconds, tmp_path):
    if suffix == ".mp4":
        pytest.importorskip("av", reason="MP4 needs PyAV")
    out, number = tmp_path / "new" / f"video{suffix}", 15
    movie.write(out, some_images(number), seconds)
    frames, times = read(out)
    assert [path.name for path in out.parent.iterdir()] == [out.name]
    assert len(frames) == number
    for found, expected in zip(frames, some_images(number), strict=True):
        assert found.shape == expected.shape
        assert np.abs(found.astype(int) - expected).mean() < 5
    begins = np.cumsum([0, *times])
    np.testing.assert_allclose(
        begins, np.arange(number + 1) * float(seconds), atol=0.0051 if suffix == ".gif" else 1e-3
    )


@settings(deadline=None)
@given(number=st.integers(1, 200), rate=st.fractions(1, 50, max_denominator=1000))
def test_delays_of_a_gif_never_drift(number, rate):
    found = np.cumsum(movie.compute_delays(number, 1 / rate))
    assert np.abs(found - [100 * float(i / rate) for i in range(1, number + 1)]).max() <= 0.5 + 1e-9
    assert min(movie.compute_delays(number, 1 / rate)) >= 2  # what is shorter, browsers show slowly


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture
def run(monkeypatch, tmp_path):
    """A run folder as far as it is looked at; its policy is drawn."""
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "config.yaml").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("jaxpg.store.policies.load", lambda *_: a_policy(*PENDULUM))
    return folder


def names(folder):
    return {path.name for path in folder.iterdir()}


def test_episodes_of_a_run_become_a_video(run, backend, capsys):
    out = run / "three.gif"
    assert command_line.main([f"run={run}", f"out={out}", "episodes=3", "width=64", "height=48", "speed=0.5"]) == 0
    first, returns, last = capsys.readouterr().out.splitlines()
    assert first == "ppo on pendulum, seed 0, best policy (saved after 1 updates)"
    assert len(returns.split()) == 1 + 3
    assert last == f"{out}  8 pictures, 0.80 s at 10 a second"
    frames, times = read(out)
    assert frames[0].shape == (2 * 48, 2 * 64, 3)
    assert sum(times) == pytest.approx(0.8)
    assert names(run) == {"config.yaml", "three.gif"}


def test_without_opengl_the_video_is_drawn_all_the_same(run, monkeypatch, capsys):
    monkeypatch.setattr(gl, "find_backend", lambda *_: None)
    out = run / "three.gif"
    assert command_line.main([f"run={run}", f"out={out}", "episodes=3", "width=128", "height=96", "speed=0.5"]) == 0
    note, *_, last = capsys.readouterr().out.splitlines()
    assert note.startswith("note: there is no OpenGL, so the video is drawn in a simpler way; ")
    assert last == f"{out}  8 pictures, 0.80 s at 10 a second"
    frames, _ = read(out)
    assert frames[0].shape == (2 * 96, 2 * 128, 3)
    rods = [frame[:96, 128:255, 0].astype(int) - frame[:96, 128:255, 2] > 60 for frame in frames]
    assert min(rod.sum() for rod in rods) > 30
    assert (rods[0] != rods[-1]).any()  # it moves


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("out={run}",), "must end in .mp4 or .gif"),
        (("out={run}/video.avi",), r"out=.*video.avi: must end in .mp4 or .gif"),
        (("out={run}/folder.gif",), "a folder has that name"),
        (("out={run}/v.gif", "width=99"), "width=99: must be even"),
        (("out={run}/v.gif", "episodes=64", "width=2000"), "64 episodes of 2000 x 360 are 16000 x 2880 pixels, more"),
        (("out={run}/v.gif", "checkpoint=first"), "checkpoint=first: must be best or last or untrained"),
        (("out={run}/config.yaml/v.gif", "env.dt=1", "episodes=1"), r"v.gif: cannot be written \(File exists\)"),
    ],
)
def test_mistakes_are_one_line(arguments, message, run, monkeypatch):
    (run / "folder.gif").mkdir()
    monkeypatch.setattr(gl, "is_working", lambda name: True)
    with pytest.raises((UserError, OptionError), match=message) as raised:
        command_line.main([f"run={run}", *(argument.format(run=run) for argument in arguments)])
    assert "\n" not in str(raised.value)
    assert names(run) == {"config.yaml", "folder.gif"}


def test_what_has_no_body_is_not_drawn(run, monkeypatch):
    monkeypatch.setattr(gl, "is_working", lambda name: True)
    monkeypatch.setattr("jaxpg.store.policies.load", lambda *_: a_policy("env=quadratic", "network=linear"))
    with pytest.raises(UserError, match="env=quadratic has no robot that could be drawn"):
        command_line.main([f"run={run}", f"out={run / 'v.gif'}"])


def test_without_opengl_there_is_one_line_and_no_file(run, command_environment):
    """MUJOCO_GL is a name with which MuJoCo does not let itself be imported."""
    ended = subprocess.run(
        [sys.executable, "-m", "jaxpg.render", f"run={run}", f"out={run / 'v.gif'}"],
        env=command_environment | {"MUJOCO_GL": "nonsense"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 2
    assert ended.stderr == "error: MUJOCO_GL=nonsense: MuJoCo cannot draw with it here; unset it\n"
    assert names(run) == {"config.yaml"}


def test_without_the_package_for_mp4_there_is_one_line(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(UserError, match=r"video.mp4: .mp4 needs a package, \S+ -m pip install av; .* needs none$"):
        command_line.main([f"run={run}"])


@pytest.mark.parametrize("suffix", movie.FORMATS)
def test_what_fails_half_way_leaves_the_file_as_it_was(suffix, tmp_path):
    if suffix == ".mp4":
        pytest.importorskip("av", reason="MP4 needs PyAV")

    def torn():
        yield from some_images(2)
        raise OSError(28, "No space left on device")

    out = tmp_path / f"video{suffix}"
    movie.write(out, some_images(3), Fraction(1, 20))
    before = out.read_bytes()
    with pytest.raises(UserError, match=rf"video{suffix}: cannot be written \(No space left on device\)"):
        movie.write(out, torn(), Fraction(1, 20))
    assert out.read_bytes() == before
    assert names(tmp_path) == {out.name}
