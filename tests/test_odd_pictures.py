"""Whatever an environment is, its run has a page; what cannot be drawn is left out and said, and bugs are raised."""

import base64
import json
import math
import re
import subprocess
import sys
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs.base import Interface, initial_state
from envs.options import option
from envs.scenes import PhasePlane, Scene
from jaxpg.config.parsing import compose
from jaxpg.errors import UserError
from jaxpg.normalization import RunningStatistics
from jaxpg.program.networks import make_networks
from jaxpg.program.state import Policy
from jaxpg.store.folder import RunFolder
from jaxpg.store.policies import make_stored_policy
from jaxpg.watch import attempts, player, run_page
from jaxpg.watch.attempts import DrawingError, attempt
from jaxpg.watch.page import make_page
from jaxpg.watch.untrained import make_untrained

ROBOT = """<mujoco><worldbody>
  <body><joint name="slide" type="slide" axis="1 0 0"/><geom type="box" size=".2 .1 .05" {more}/>
    <body><joint name="hinge" axis="0 -1 0"/><geom type="capsule" fromto="0 0 0 0 0 .6" size=".02" {more}/></body>
  </body></worldbody><actuator><motor joint="slide"/><motor joint="hinge"/></actuator></mujoco>"""
BARE = """<mujoco><worldbody>
  <body><joint name="slide" type="slide" axis="1 0 0"/><inertial pos="0 0 0" mass="1" diaginertia=".01 .01 .01"/>
    <body><joint name="hinge" axis="0 -1 0"/><inertial pos="0 0 .3" mass=".1" diaginertia=".003 .003 .0001"/></body>
  </body></worldbody><actuator><motor joint="slide"/><motor joint="hinge"/></actuator></mujoco>"""

SPATIAL = ROBOT.format(more="").replace('axis="0 -1 0"', 'axis="0 0 1"').replace("</body>", "<site/></body>", 1)
UNKNOWN = "the policy has 1 command, the model 2 actuators: cannot match them"


@dataclass(frozen=True)
class OddConfig:
    episode_length: int = option(6, "steps", at_least=1)


class Odd:
    """A robot without physics: its joints go where they are told. What the tests change are its attributes."""

    observation_size, action_size, dt = 2, 2, 0.1
    xml, commands, limits = ROBOT.format(more=""), ("force [N]", "torque [N m]"), (5.0, 0.1)
    metrics, goal, goal_radius, goal_rotation, site = (), None, None, None, None

    def __init__(self, config):
        self.config, self.model = config, mujoco.MjModel.from_xml_string(self.xml)

    @property
    def interface(self):
        return Interface(("x", "angle"), self.commands, self.limits)

    @property
    def scene(self):
        goal, rotation = (x and (lambda state, x=x: jnp.array(x)) for x in (self.goal, self.goal_rotation))
        return Scene(self.model, self.qpos, goal, self.goal_radius, rotation, self.site)

    def qpos(self, state):
        return state.pipeline_state

    def measured(self, qpos):
        return {name: qpos[0] / qpos[0] if name == "success" else qpos[0] for name in self.metrics}

    def reset(self, rng):
        qpos = jax.random.normal(rng, (2,))
        return initial_state(qpos, qpos, self.metrics)

    def step(self, state, action):
        qpos = state.obs + 0.1 * jnp.pad(jnp.clip(action, -1, 1), (0, 2 - self.action_size))
        qpos = qpos.at[0].multiply(jnp.abs(qpos[0]) > 0.5)  # then success is 0 / 0
        return state.replace(pipeline_state=qpos, obs=qpos, reward=-jnp.sum(qpos**2), metrics=self.measured(qpos))


@pytest.fixture
def shown(monkeypatch, tmp_path):
    """`shown(name=value, ...)`: what the page of a run shows whose environment has these attributes."""

    def make(**attributes):
        entry = envs.Entry(OddConfig, type("Changed", (Odd,), attributes), {"td": {}})
        monkeypatch.setitem(envs.REGISTRY, "odd", entry)
        config = compose(["env=odd", "algo=td", "num_envs=2", "eval_episodes=8", "network.widths=[4]"])
        env = entry.build(config.env)
        params = make_networks(config, env).init(jax.random.key(1))
        statistics = RunningStatistics(jnp.array(1.0), jnp.zeros(2), jnp.ones(2))
        best = make_stored_policy(config, env, Policy(params, statistics), 1, "seed 0")
        lines = [{"update": 1, "steps": 10, "seconds": 1.0, "eval_return": -1.0}]
        (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        (tmp_path / "versions.json").write_text("{}")
        data = run_page.build_report(
            RunFolder(tmp_path), config, {"before training": make_untrained(best), "best": best}
        )
        assert "<title>" in make_page(data)
        return data

    return make


def test_an_ordinary_robot_has_all_of_its_parts_and_no_note(shown):
    data = shown()
    assert data["notes"] == []
    assert [len(part["points"]) for part in data["player"]["parts"]] == [8, 2]
    assert [motor["name"] for motor in data["player"]["motors"]] == ["torque [N m]"]
    assert data["player"]["limits"] == {"force [N]": 5.0, "torque [N m]": 0.1}


def test_an_actuator_that_the_policy_does_not_command(shown):
    data = shown(action_size=1, commands=("force [N]",), limits=(5.0,))
    assert data["player"]["motors"] == []
    assert data["player"]["series"] == ["force [N]", "reward", "value"]
    assert data["notes"] == [f"no motors: {UNKNOWN}"]


@pytest.mark.parametrize("limits", [np.array([5.0, 0.1]), [5, 0.1], jnp.array([5.0, 0.1]), (np.float32(5), 0.1), None])
def test_limits_of_any_kind_of_numbers(shown, limits):
    data = shown(limits=limits)
    assert data["notes"] == []
    assert data["player"]["motors"][0]["limit"] == (None if limits is None else pytest.approx(0.1))


def test_a_success_that_is_no_number_and_a_goal_without_a_distance(shown):
    data = shown(metrics=("success",), goal=(0.0, 0.0, 0.5), goal_radius=np.float32(0.1))
    (picture,) = data["workspace"]["pictures"]
    points = picture["points"][1]
    assert len(points) == 8
    assert {row[2] for row in points} == {None}
    assert {row[3] for row in points} <= {0, 1}
    assert (picture["x"], picture["y"]) == ("x [m]", "z [m]")
    assert data["notes"] == []
    assert all(0 <= float(row[2].removesuffix(" %")) <= 100 for row in data["head"]["rows"])


@pytest.mark.parametrize("xml", [ROBOT.format(more='group="3"'), BARE], ids=["group 3", "no geoms"])
def test_a_robot_without_visible_geoms_is_drawn_all_the_same(shown, xml):
    data = shown(xml=xml)
    assert len(data["player"]["parts"]) == 2
    assert data["notes"] == []


def test_a_robot_in_space_with_a_pose_to_reach(shown):
    turn = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    data = shown(xml=SPATIAL, goal=(0.1, 0.2, 0.5), goal_radius=0.1, goal_rotation=turn, site=0, metrics=("success",))
    assert data["notes"] == []
    space = data["player"]["space"]
    assert (len(space["bodies"]), len(space["joints"]), len(space["parts"])) == (2, 2, 2)
    assert space["site"]["body"] == 2
    for episode in (one for policy in data["player"]["policies"] for one in policy["episodes"]):
        assert episode["goals"] == [[0.1, 0.2, 0.5]]  # one row, as it does not move
        assert episode["turns"] == [np.ravel(turn).tolist()]
        assert len(np.frombuffer(base64.b64decode(episode["qpos"]), "<i2")) == 2 * episode["frames"]
    assert [picture["x"] for picture in data["workspace"]["pictures"]] == ["x [m]"]


def test_a_robot_in_space_whose_goal_is_no_number(shown):
    data = shown(xml=SPATIAL, goal=(np.nan, 0.0, 0.0))
    assert data["notes"] == []
    assert data["player"]["policies"][0]["episodes"][0]["goals"] is None


@pytest.mark.parametrize(
    ("commands", "names"),
    [
        (("torque", "torque"), ["torque (1)", "torque (2)"]),
        (("reward", "value"), ["reward (1)", "value (2)"]),
        (("only one",), ["action 1", "action 2"]),
        (["a", 3], ["a", "3"]),
    ],
)
def test_each_command_is_a_series_of_its_own(shown, commands, names):
    data = shown(commands=commands)
    assert data["player"]["series"] == [*names, "reward", "value"]
    assert {len(set(e["series"])) for policy in data["player"]["policies"] for e in policy["episodes"]} == {4}
    assert list(data["player"]["limits"]) == names


def plane(**changes):
    known = {"labels": ("x", "angle"), "ranges": ((-1.0, 1.0), (-3.0, 3.0)), "wraps": (False, True)}
    known |= {"coordinates": lambda state: state.obs, "observe": lambda x, y: jnp.stack([x, y])}
    return PhasePlane(**known | changes)


def fails(*_):
    raise AttributeError("'tuple' object has no attribute 'qpos'")


WRONG = [
    (
        {"qpos": fails},
        r"no picture of the robot: scene.qpos\(state\) raises AttributeError: .*test_odd_pic",
    ),
    ({"qpos": lambda self, state: state.obs[:1]}, r"no picture of the robot: scene.qpos\(state\) has the shape \(1,\)"),
    ({"scene": Scene("robot", lambda state: state.obs)}, "no picture of the robot: scene.model is a str, expected"),
    ({"dt": 0.0}, "no picture of the robot: dt is 0.0, expected seconds"),
    ({"dt": property(fails)}, "no picture of the robot: dt raises AttributeError"),
    (
        {"goal": (0.0, 1.0), "metrics": ("success",)},
        r"no goal: scene.goal\(state\) has the shape \(2,\), expected \(3,\)",
    ),
    ({"goal": (0.0, 0.0, 0.0), "goal_radius": -1.0}, "no goal: scene.goal_radius is -1.0"),
    (
        {"goal": (0.0, 0.0, 0.0), "goal_rotation": (1.0, 0.0, 0.0, 0.0), "metrics": ("success",)},
        r"no goal: scene.goal_rotation\(state\) has the shape \(4,\), expected \(3, 3\)",
    ),
    ({"site": 3}, "no picture of the robot: scene.site is 3, the model has 0 sites"),
    ({"phase_plane": plane(ranges=((1.0, 1.0), (0.0, 1.0)))}, "no phase portrait: phase_plane.ranges"),
    ({"phase_plane": plane(coordinates=lambda state: state.reward)}, r"no phase portrait: .*coordinates\(state\) has"),
    ({"phase_plane": plane(observe=fails)}, r"no phase portrait: phase_plane.observe\(x, y\) raises AttributeError"),
    ({"references": {"best": "unknown"}}, "no returns to compare with"),
]


@pytest.mark.parametrize(("attributes", "note"), WRONG)
def test_what_cannot_be_drawn_is_left_out_and_said_and_the_rest_stands(shown, attributes, note, monkeypatch):
    monkeypatch.delenv(attempts.RAISE, raising=False)
    data = shown(**attributes)
    (said,) = data["notes"]
    assert re.search(note, said)
    assert len(data["curves"]) == 1
    assert len(data["head"]["rows"]) == 2
    assert (data["player"] is None) == ("picture of the robot" in said)
    assert data["portrait"] is None
    assert data["workspace"] is None


def test_a_critic_that_is_no_number_somewhere_has_no_portrait(shown, monkeypatch):
    monkeypatch.setattr(player, "compute_value_map", lambda *_: [np.full((3, 3), math.nan)])
    data = shown(phase_plane=plane())
    assert data["notes"] == ["no phase portrait: the critic's values are not finite everywhere"]
    assert data["player"]["policies"][0]["episodes"][0]["path"]


def test_a_bug_is_one_note_for_users_and_raised_for_whoever_asks(shown, monkeypatch):
    def broken(*_):
        raise KeyError("nothing of this name")

    monkeypatch.setattr(run_page, "make_diagnostics", broken)
    monkeypatch.setenv(attempts.RAISE, "1")
    with pytest.raises(KeyError):
        shown()
    monkeypatch.delenv(attempts.RAISE)
    data = shown()
    (said,) = data["notes"]
    assert said.startswith("no diagnostics: KeyError: 'nothing of this name' (test_odd_pictures.py, line ")
    assert data["player"]


def test_an_attempt_says_why_and_gives_nothing(monkeypatch):
    monkeypatch.setenv(attempts.RAISE, "1")
    said = []

    def raising(error):
        raise error

    assert attempt("picture", lambda: 3, said.append) == 3
    for error in (DrawingError("no geoms"), UserError("the disk is full")):
        assert attempt("picture", lambda error=error: raising(error), said.append) is None
    assert said == ["no picture: no geoms", "no picture: the disk is full"]
    with pytest.raises(KeyboardInterrupt):
        attempt("picture", lambda: raising(KeyboardInterrupt()), said.append)


SCRIPT = '''
import dataclasses
import test_odd_pictures as odd
import envs
from jaxpg.__main__ import main, run_command

class Wrong(odd.Odd):
    """An actuator too many, a success that is 0 / 0, a goal without a distance, limits of numpy, no visible geoms."""
    xml, action_size, commands = odd.ROBOT.format(more='group="3"'), 1, ("force [N]",)
    limits, metrics, goal = odd.np.array([5.0]), ("success",), (0.0, 0.0, 0.0)

    def measured(self, qpos):
        return {"success": odd.jnp.zeros(()) / odd.jnp.zeros(())}

envs.register("wrong", envs.Entry(odd.OddConfig, Wrong, {"td": {}}))
run_command(main)
'''
TINY = ("num_envs=4", "num_steps=4", "total_steps=64", "log_interval=32", "eval_interval=32", "eval_episodes=4")


def test_a_run_ends_with_0_and_a_page_whatever_its_environment_is(command_environment, tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    path = {"PYTHONPATH": f"{__file__.rsplit('/', 1)[0]}:{command_environment.get('PYTHONPATH', '')}"}
    ran = subprocess.run(
        [sys.executable, "script.py", "train", "env=wrong", "algo=td", "network.widths=[4]", "run_dir=run", *TINY],
        cwd=tmp_path,
        env=command_environment | path,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    assert "Traceback" not in ran.stderr
    assert f"note: report.html has no motors: {UNKNOWN}" in ran.stdout
    assert (tmp_path / "run" / "report.html").is_file()
    assert (tmp_path / "run" / "learning_curve.png").is_file()
