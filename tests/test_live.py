"""The interactive viewer, played by a stand-in: what it is shown, when, and what is said where it cannot be opened."""

import contextlib
import os
import subprocess
import sys
import threading
import types

import mujoco
import numpy as np
import pytest
from spatial import ARM
from stored import a_policy

from envs.scenes import Scene
from jaxpg import view as command_line
from jaxpg.errors import UserError
from jaxpg.watch import live
from jaxpg.watch.clips import Clip
from jaxpg.watch.recording import Look

PENDULUM = ("env=pendulum", "env.physics=mujoco", "env.episode_length=7", "network.widths=[8]", "num_envs=2")
NO_SCREEN = (
    "error: there is no screen, neither DISPLAY nor WAYLAND_DISPLAY is set; "
    "python -m jaxpg.render run=DIR makes a video without one\n"
)


class Clock:
    """Time that passes only while somebody sleeps."""

    def __init__(self, monkeypatch):
        self.now = 0.0
        monkeypatch.setattr(live, "time", self)

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += max(seconds, 1e-6)


class Viewer:
    """As the handle of `mujoco.viewer.launch_passive`, closed after some pictures; keeps what it was shown.

    At the pictures in `keys`, those keys are pressed.
    """

    def __init__(self, clock, pictures, keys=None):
        self.clock, self.left, self.keys, self.seen = clock, pictures, keys or {}, []
        self.cam = mujoco.MjvCamera()
        self.mutex, self.closed = threading.RLock(), False

    def launch(self, model, data, *, key_callback, show_left_ui, show_right_ui):
        self.data, self.press = data, key_callback
        self.user_scn = mujoco.MjvScene(model, maxgeom=1000)
        self.user_scn.ngeom = 0
        return self

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.closed = True

    def is_running(self):
        return self.left > 0

    def lock(self):
        return self.mutex

    def set_texts(self, texts):
        self.texts = texts

    def sync(self):
        geoms = [self.user_scn.geoms[i] for i in range(self.user_scn.ngeom)]
        balls = [geom.pos.copy() for geom in geoms if geom.type == mujoco.mjtGeom.mjGEOM_SPHERE]
        bars = [geom.pos.copy() for geom in geoms if geom.type == mujoco.mjtGeom.mjGEOM_CAPSULE]
        self.seen.append((self.clock.now, self.data.qpos.copy(), balls, bars, self.texts, self.cam.lookat.copy()))
        self.left -= 1
        for key in self.keys.get(len(self.seen), ()):
            self.press(key)


@pytest.fixture
def clock(monkeypatch):
    return Clock(monkeypatch)


def make_clips(number=2, frames=6, dt=0.05, rotation=False):
    """Robots whose first joint is at number + 0.1 frame; the goal is at (0, 0, number)."""
    clips = []
    for i in range(number):
        qpos = np.column_stack([i + 0.1 * np.arange(frames), np.zeros(frames)])
        goal = np.tile([0.0, 0.0, float(i)], (frames, 1))
        turn = np.tile(np.eye(3), (frames, 1, 1)) if rotation else None
        clips.append(Clip(Look(qpos, goal, None, turn), {}, -np.arange(frames) * 1.0, dt, -5.0, bool(i)))
    return clips


def scene(**more):
    return Scene(mujoco.MjModel.from_xml_string(ARM), None, goal_radius=0.05, **more)


def test_every_step_is_shown_in_real_time_and_then_the_next_episode(clock):
    viewer = Viewer(clock, pictures=14)
    live.play(viewer.launch, scene(), make_clips(), speed=1.0)
    times, qpos = [one[0] for one in viewer.seen], np.array([one[1] for one in viewer.seen])
    within, rest = np.arange(6) * 0.05, 6 * 0.05 - 0.05 + live.REST
    expected = [*within, *(rest + within), *(2 * rest + within[:2])]
    np.testing.assert_allclose(times, expected, atol=1e-3)
    np.testing.assert_allclose(qpos[:, 0], [*(0.1 * np.arange(6)), *(1 + 0.1 * np.arange(6)), 0.0, 0.1], atol=1e-12)
    assert viewer.closed


def test_the_speed_is_the_users_and_pictures_are_no_faster_than_a_screen(clock):
    slow, fast = Viewer(clock, pictures=4), Viewer(clock, pictures=4)
    live.play(slow.launch, scene(), make_clips(), speed=0.5)
    np.testing.assert_allclose(np.diff([one[0] for one in slow.seen]), 0.1, atol=1e-3)
    live.play(fast.launch, scene(), make_clips(frames=41, dt=0.002), speed=1.0)
    np.testing.assert_allclose(np.diff([one[0] for one in fast.seen]), 0.018, atol=1e-3)
    np.testing.assert_allclose(np.diff([one[1][0] for one in fast.seen]), 0.9, atol=1e-9)


@pytest.mark.parametrize("rotation", [False, True])
def test_the_goal_is_a_ball_and_where_it_is_turned_it_has_axes(clock, rotation):
    """The middle of each bar lies on its axis."""
    viewer = Viewer(clock, pictures=8)
    live.play(viewer.launch, scene(site=0), make_clips(rotation=rotation), speed=1.0)
    for number, picture in ((0, viewer.seen[0]), (1, viewer.seen[7])):
        (ball,) = picture[2]
        np.testing.assert_allclose(ball, [0, 0, number])
        assert len(picture[3]) == (6 if rotation else 0)  # the goal's axes and those of the site
        for axis, bar in enumerate(picture[3][:3]):
            offset = bar - ball
            assert np.argmax(offset) == axis
            assert np.count_nonzero(np.abs(offset) > 1e-9) == 1


def test_keys_pause_and_change_the_episode(clock, monkeypatch):
    """Paused at the second picture for half a second; at the fourth the episode before is asked for."""
    viewer = Viewer(clock, pictures=6, keys={2: [live.SPACE], 4: [live.BEFORE]})
    stopped = []

    def wait(seconds):
        clock.sleep(seconds)
        if len(viewer.seen) == 2 and not stopped and clock.now > 0.55:
            stopped.append(clock.now)
            viewer.press(live.SPACE)

    monkeypatch.setattr(live, "time", types.SimpleNamespace(monotonic=clock.monotonic, sleep=wait))
    live.play(viewer.launch, scene(), make_clips(number=3), speed=1.0)
    first = np.array([one[1][0] for one in viewer.seen])
    np.testing.assert_allclose(first, [0.0, 0.1, 0.2, 0.3, 2.0, 2.1], atol=1e-12)  # back from the first is the last
    assert stopped
    assert viewer.seen[2][0] == pytest.approx(0.6, abs=0.05)


def test_the_caption_says_which_episode_when_and_how_it_ends(clock):
    viewer = Viewer(clock, pictures=12)
    live.play(viewer.launch, scene(), make_clips(), speed=1.0)
    assert viewer.seen[1][4][2:] == ("episode\ntime\nreturn", "1 of 2\n0.05 s\n-1.0")
    assert viewer.seen[5][4][3] == "1 of 2\n0.25 s\n-5.0\nmissed"
    assert viewer.seen[11][4][3].endswith("success")


def test_a_position_that_is_no_number_leaves_the_robot_where_it_was(clock):
    (clip,) = make_clips(number=1)
    clip.look.qpos[2] = np.nan
    viewer = Viewer(clock, pictures=4)
    live.play(viewer.launch, scene(), [clip], speed=1.0)
    np.testing.assert_allclose([one[1][0] for one in viewer.seen], [0.0, 0.1, 0.1, 0.3])


def test_a_viewer_that_does_not_start_is_one_line():
    def launch(*_, **__):
        raise RuntimeError("`launch_passive` requires\nmjpython on macOS")

    with pytest.raises(UserError, match="no window can be opened: `launch_passive` requires mjpython on macOS"):
        live.play(launch, scene(), make_clips(), speed=1.0)


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("environment", "system", "is_there"),
    [
        ({}, "linux", False),
        ({"DISPLAY": ""}, "linux", False),
        ({"DISPLAY": ":0"}, "linux", True),
        ({"WAYLAND_DISPLAY": "wayland-0"}, "linux", True),
        ({}, "darwin", True),
        ({}, "win32", True),
    ],
)
def test_on_linux_a_screen_has_a_name(environment, system, is_there):
    with contextlib.nullcontext() if is_there else pytest.raises(UserError, match="there is no screen"):
        live.check_screen(environment, system)


def make_folder(path):
    path.mkdir()
    (path / "config.yaml").touch()
    return path


def test_without_a_screen_it_is_said_in_one_line_before_anything_is_loaded(tmp_path, command_environment):
    """The run folder has no policy: it is not looked for yet."""
    run = make_folder(tmp_path / "run")
    bare = {name: value for name, value in command_environment.items() if not name.endswith("DISPLAY")}
    ended = subprocess.run(
        [sys.executable, "-m", "jaxpg.view", f"run={run}"], env=bare, capture_output=True, text=True, check=False
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (2, "", NO_SCREEN)


def stand_in(glfw_works, launch=None):
    glfw = types.SimpleNamespace(
        VISIBLE=1, FALSE=0, init=lambda: glfw_works != "no init", window_hint=lambda *_: None, terminate=lambda: None
    )
    glfw.create_window = lambda *_: object() if glfw_works == "yes" else None
    return glfw, types.SimpleNamespace(launch_passive=launch)


@pytest.mark.parametrize("glfw_works", ["no init", "no window", "no package", "no library"])
def test_where_no_window_can_be_opened_it_is_said_in_one_line(monkeypatch, tmp_path, glfw_works):
    glfw, viewer = stand_in(glfw_works)

    def load(name):
        if glfw_works == "no package":
            raise ImportError("No module named 'glfw'")
        if glfw_works == "no library":
            raise RuntimeError("GLFW dynamic library handle is not available")
        return {"mujoco.viewer": viewer, "glfw": glfw}[name]

    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setattr(live, "sys", types.SimpleNamespace(platform="linux"))
    monkeypatch.setattr(live, "importlib", types.SimpleNamespace(import_module=load))
    with pytest.raises(UserError, match="no window can be opened") as raised:
        command_line.main([f"run={make_folder(tmp_path / 'run')}"])
    assert "\n" not in str(raised.value)
    assert "python -m jaxpg.render" in str(raised.value)


def test_a_policy_is_played_until_the_window_is_closed(monkeypatch, tmp_path, capsys, clock):
    viewer = Viewer(clock, pictures=11)
    glfw, module = stand_in("yes", viewer.launch)
    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(live, "sys", types.SimpleNamespace(platform="linux"))
    monkeypatch.setitem(sys.modules, "mujoco.viewer", module)
    monkeypatch.setitem(sys.modules, "glfw", glfw)
    monkeypatch.setattr("jaxpg.store.policies.load", lambda *_: a_policy(*PENDULUM))
    assert command_line.main([f"run={make_folder(tmp_path / 'run')}", "episodes=2"]) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert first == "ppo on pendulum, seed 0, best policy (saved after 1 updates)"
    assert second.startswith("space bar: pause")
    assert len(viewer.seen) == 11
    assert viewer.seen[8][4][3].startswith("2 of 2\n0.00 s")
    assert os.listdir(tmp_path / "run") == ["config.yaml"]
    assert np.isfinite(np.array([one[1] for one in viewer.seen])).all()


def test_what_has_no_body_is_not_shown(monkeypatch, tmp_path):
    monkeypatch.setattr(live, "check_screen", lambda *_: None)
    monkeypatch.setattr(live, "find_launcher", lambda: None)
    monkeypatch.setattr("jaxpg.store.policies.load", lambda *_: a_policy("env=quadratic", "network=linear"))
    with pytest.raises(UserError, match="env=quadratic has no robot that could be drawn"):
        command_line.main([f"run={make_folder(tmp_path / 'run')}"])
