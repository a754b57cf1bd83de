"""What the page of a run shows, and that every finished run has one."""

import base64
import json
import re

import numpy as np
import pytest

from jaxpg import report as command_line
from jaxpg.store.folder import RunFolder, read_metrics
from jaxpg.watch.curves import make_curve, replace_nonfinite, round_numbers
from jaxpg.watch.player import pack

TINY = ("num_envs=4", "num_steps=4", "log_interval=64", "eval_interval=64", "total_steps=256")
TASKS = {
    "pendulum": ("env=pendulum", "env.episode_length=12", "eval_episodes=8", "network.widths=[8]"),
    "arm": ("env=arm", "env.episode_length=10", "eval_episodes=4", "network.widths=[8]"),
    "sweep": ("env=quadratic", "env.episode_length=8", "eval_episodes=4", "num_seeds=2", "sweep.algo.gamma=[0.5,0.9]"),
}


@pytest.fixture(scope="module")
def run(command, tmp_path_factory):
    """`run(task) -> (folder, output, data)` of a finished run, and what its page was given."""
    made = {}

    def make(task):
        if task not in made:
            folder = tmp_path_factory.mktemp("runs") / task
            result = command("train", *TASKS[task], *TINY, f"run_dir={folder}")
            assert result.returncode == 0, result.stderr
            assert result.stderr == ""
            made[task] = folder, result.stdout, data_of(folder / "report.html")
        return made[task]

    return make


def data_of(page):
    (text,) = re.findall(r'<script[^>]*type="application/json"[^>]*>(.*?)</script>', page.read_text(), re.DOTALL)
    return json.loads(text)


def unpacked(text, *shape):
    return np.frombuffer(base64.b64decode(text), "<i2").reshape(shape)


def test_a_finished_run_has_its_page(run):
    folder, output, data = run("pendulum")
    assert f"{folder / 'report.html'}: " in output
    assert data["title"] == "ppo on pendulum, seed 0"
    assert ["env.episode_length", "12", "200"] in data["configuration"]
    assert ["algo.gamma", "0.995", None] in data["configuration"]
    assert data["notes"] == []
    assert dict(data["versions"])["jax"]


def test_the_curves_are_the_lines_of_metrics(run):
    folder, _, data = run("pendulum")
    lines = read_metrics(RunFolder(folder))
    (panel,) = data["curves"]
    deterministic, training = panel["series"]
    assert deterministic["steps"] == [line["steps"] for line in lines if "eval_return" in line]
    np.testing.assert_allclose(deterministic["mean"], [line["eval_return"] for line in lines], rtol=1e-3)
    assert training["label"] == "while training"


def test_the_best_policy_earns_what_its_evaluation_said(run):
    """The page plays the starts of the evaluations: of the deterministic policy it has the same return."""
    folder, _, data = run("pendulum")
    best = max(line["eval_return"] for line in read_metrics(RunFolder(folder)))
    said = {row[0]: row[1] for row in data["head"]["rows"]}["best"]
    assert float(said.split(" ±")[0]) == pytest.approx(best, abs=0.06)
    assert "over the episodes of an evaluation" in data["head"]["note"]
    assert not [text for _, text in data["facts"] if "best" in text]  # nothing else is called so
    returns = [episode["return"] for episode in data["player"]["policies"][1]["episodes"]]
    assert len(returns) == 6


def test_every_policy_plays_from_the_same_starts(run):
    _, _, data = run("pendulum")
    player = data["player"]
    assert [policy["label"] for policy in player["policies"]][:2] == ["before training", "best"]
    for episodes in zip(*(policy["episodes"] for policy in player["policies"]), strict=True):
        first = [unpacked(one["parts"], one["frames"], 1, 8)[0, 0] * one["scale"] for one in episodes]
        for other in first[1:]:
            np.testing.assert_allclose(other, first[0], atol=1e-3)
    last = [unpacked(one["parts"], 13, 1, 8)[-1, 0] * one["scale"] for one in episodes]
    assert np.abs(last[0] - last[1]).max() > 1e-3  # and not to the same end


def test_an_episode_adds_up(run):
    for task in ("pendulum", "arm"):
        _, _, data = run(task)
        for policy in data["player"]["policies"]:
            for episode in policy["episodes"]:
                assert sum(episode["series"]["reward"]) == pytest.approx(episode["return"], rel=2e-3, abs=2e-3)
                assert {len(values) for values in episode["series"].values()} == {episode["frames"] - 1}


def test_the_portrait_has_a_map_for_each_policy(run):
    _, _, data = run("pendulum")
    portrait, policies = data["portrait"], data["player"]["policies"]
    assert len(portrait["values"]) == len(policies)
    for grid in portrait["values"]:
        values = unpacked(grid["data"], portrait["rows"], portrait["columns"])
        assert (values.min(), values.max()) == (0, 2**15 - 1)
        assert grid["low"] < grid["high"]
    path = np.array(policies[0]["episodes"][0]["path"])
    assert path.shape == (2, 13)
    assert np.abs(path[0]).max() <= np.pi + 1e-3


def test_the_workspace_counts_as_the_evaluation_does(run):
    folder, _, data = run("arm")
    lines = read_metrics(RunFolder(folder))
    (picture,) = data["workspace"]["pictures"]
    points = np.array(picture["points"][1])
    assert points.shape == (4, 4)
    assert points[:, 3].mean() == pytest.approx(max(lines, key=lambda line: line["eval_return"])["eval_success"])
    assert ((points[:, 2] < data["workspace"]["success_radius"]) == (points[:, 3] > 0)).all()
    goals = [episode["goal"] for episode in data["player"]["policies"][0]["episodes"]]
    np.testing.assert_allclose(goals, points[:, :2])
    np.testing.assert_allclose(picture["chosen"][0], goals, rtol=1e-3)
    assert data["portrait"] is None


def test_a_sweep_has_its_table_and_a_problem_without_a_body_no_player(run):
    _, output, data = run("sweep")
    assert data["player"] is None
    (table,) = data["tables"]
    assert [row[0] for row in table["rows"]] == re.findall(r"^(algo\.gamma=\S+)", output, re.MULTILINE)
    (panel,) = data["curves"]
    assert {series["label"] for series in panel["series"]} == {"algo.gamma=0.5", "algo.gamma=0.9"}
    for series in panel["series"]:
        rows = zip(series["low"], series["mean"], series["high"], strict=True)
        assert all(low <= mean <= high for low, mean, high in rows)


def test_the_page_can_be_written_anew(run, capsys):
    folder, _, _ = run("sweep")
    before = (folder / "report.html").read_bytes()
    (folder / "report.html").unlink()
    assert command_line.main([f"run={folder}"]) == 0
    assert "report.html" in capsys.readouterr().out
    assert (folder / "report.html").read_bytes() == before
    assert command_line.main([f"run={folder}", "agent=1"]) == 0
    assert ["episodes of", "seed 1 algo.gamma=0.5"] in data_of(folder / "report.html")["facts"]


def test_numbers_are_packed_to_half_a_unit():
    values = np.array([[-32767.0, 0.4, 32767.0]])
    assert unpacked(pack(values), 3).tolist() == [-32767, 0, 32767]


def test_what_is_not_finite_is_nothing():
    assert replace_nonfinite({"a": [1.0, float("nan")], "b": (float("inf"), "x", None)}) == {
        "a": [1.0, None],
        "b": [None, "x", None],
    }
    assert round_numbers(np.array([1 / 3, 123456.0])) == [0.3333, 123500.0]


def test_a_curve_of_one_agent_has_no_interval():
    one, several = (make_curve("x", np.arange(3), np.ones((agents, 3))) for agents in (1, 2))
    assert one["low"] is None
    assert several["low"] == several["high"] == [1.0, 1.0, 1.0]
