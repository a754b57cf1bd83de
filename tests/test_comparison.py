"""Runs side by side: what is one method, what distinguishes it, and which is better."""

import json

import numpy as np
import pytest

from jaxpg import compare
from jaxpg.run import config as configuration
from jaxpg.run.config import compose
from jaxpg.run.errors import UserError
from jaxpg.run.statistics import interquartile_mean, probability_of_improvement
from jaxpg.watch.comparison import COLUMNS, comparison, methods, table


@pytest.fixture
def run(tmp_path):
    """`run(name, returns, *options)`: a folder as a run leaves it, with an evaluation for each row of returns."""

    def make(name, returns, *options, success=None):
        folder = tmp_path / name
        folder.mkdir()
        config = compose([*options, f"run_dir={folder}"])
        (folder / "config.yaml").write_text(configuration.to_yaml(config))
        lines = [{"update": i, "steps": 100 * (i + 1), "eval_return": row} for i, row in enumerate(returns)]
        for line in lines:
            line |= {"eval_success": success} if success is not None else {}
        (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        return str(folder)

    return make


def test_runs_that_differ_in_their_seeds_are_one_method(run):
    folders = [run(f"{seed}", [[-1.0 * seed], [2.0 * seed]], f"seed={seed}") for seed in range(3)]
    folders.append(run("more", [[5.0, 6.0], [7.0, 8.0], [9.0, 9.0]], "seed=3", "num_seeds=2", "total_steps=300"))
    (method,) = methods(folders)
    assert method.label == "algo=ppo"
    steps, values = method.values("eval_return")
    assert steps.tolist() == [100, 200]  # where all of them have one
    assert values.tolist() == [[0, 0], [-1, 2], [-2, 4], [5, 7], [6, 8]]
    assert method.scores.tolist() == [0, 2, 4, 7, 8]


def test_a_label_says_what_distinguishes_and_no_more(run):
    folders = [
        run("a", [-3.0], "algo=td"),
        run("b", [-2.0], "algo=td", "algo.gamma=0.9"),
        run("c", [-1.0], "algo=reinforce"),
    ]
    # The tuned options of TD and REINFORCE differ in many ways, which their names say already.
    assert [method.label for method in methods(folders)] == [
        "algo=reinforce algo.gamma=0.977",
        "algo=td algo.gamma=0.9",
        "algo=td algo.gamma=0.97",
    ]


def test_each_setting_of_a_sweep_is_a_method(run):
    folder = run("swept", [[1.0, 2.0, 3.0, 4.0]], "num_seeds=2", "sweep.algo.gamma=[0.5,0.9]")
    found = {method.label: method.scores.tolist() for method in methods([folder])}
    assert found == {"algo.gamma=0.9": [3, 4], "algo.gamma=0.5": [1, 2]}
    alone = run("alone", [10.0], "seed=7", "algo.gamma=0.5")
    found = {method.label: method.scores.tolist() for method in methods([folder, alone])}
    assert found["algo.gamma=0.5"] == [1, 2, 10]


def test_the_best_is_the_first_and_its_improvement_is_probable(run):
    low, high = [1.0, 5.0, 2.0, 3.0], [4.0, 6.0, 2.5, 9.0]
    folders = [
        run("low", [low], "num_seeds=4", "algo.gamma=0.5"),
        run("high", [high], "num_seeds=4", "algo.gamma=0.9"),
    ]
    found = methods(folders)
    data = comparison(found)
    assert data["improvement"]["labels"] == ["algo.gamma=0.9", "algo.gamma=0.5"]
    probability = data["improvement"]["probability"]
    assert probability[0][1] == probability_of_improvement(np.array(high), np.array(low)) == 13 / 16
    assert probability[0][1] + probability[1][0] == 1
    assert probability[0][0] is None
    assert 0 <= data["improvement"]["low"][0][1] <= 13 / 16 <= data["improvement"]["high"][0][1] <= 1
    assert table(found)[0][:3] == ["algo.gamma=0.9", "4", "100"]
    assert table(found)[0][3].startswith(f"{interquartile_mean(np.array(high)):.1f} [")
    assert ["env", "pendulum"] in data["configuration"]
    assert "algo.gamma" not in dict(data["configuration"])


def test_success_is_shown_where_there_is_one(run):
    found = methods([run("arm", [-1.0, -2.0], "env=arm", success=0.75)])
    assert table(found) == [["algo=ppo", "1", "200", "-2.0", "75.0 %"]]
    assert [panel["title"] for panel in comparison(found)["curves"]] == ["return", "success rate"]
    assert [len(row) for row in table(methods([run("pendulum", [-1.0])]))] == [len(COLUMNS) - 1]


@pytest.mark.parametrize(
    ("runs", "message"),
    [
        ([("a", "env=arm"), ("b", "env=pendulum")], "runs of arm and pendulum: only returns of the same environment"),
        ([("a", "env=brax"), ("b", "env=brax", "env.name=ant")], "runs of ant and inverted_pendulum: only returns"),
        ([("a", "seed=1"), ("b", "seed=1")], "seed 1 is there twice"),
        ([("a", "seed=1"), ("none", "seed=2")], "no evaluation that all its runs have made"),
    ],
)
def test_what_cannot_be_compared_is_said(run, runs, message):
    folders = [run(name, [] if name == "none" else [-1.0], *options) for name, *options in runs]
    with pytest.raises(UserError, match=message):
        methods(folders)


def test_the_command_takes_folders_with_any_name(run, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folders = [run("a, (with) odd name=x", [-1.0], "algo=td"), run("b", [-2.0], "algo=ppo")]
    assert compare.main([*folders, "out=both.html"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert [line.split() for line in said[:3]] == [
        ["method", "seeds", "environment", "steps", "return"],
        ["algo=td", "1", "100", "-1.0"],
        ["algo=ppo", "1", "100", "-2.0"],
    ]
    assert said[3].startswith("both.html")
    assert "algo=ppo" in (tmp_path / "both.html").read_text()


def test_what_is_no_run_is_left_out_with_a_note(run, tmp_path, capsys, monkeypatch):
    """`runs/*` finds the page that was written there before."""
    monkeypatch.chdir(tmp_path)
    run("a", [-1.0], "algo=td")
    run("b", [-2.0], "algo=ppo")
    (tmp_path / "comparison.html").write_text("<!DOCTYPE html>")
    (tmp_path / "notes").mkdir()
    assert compare.main(["a", "b", "comparison.html", "notes", "out=comparison.html"]) == 0
    assert capsys.readouterr().out.startswith("note: left out, as it is no run folder: comparison.html, notes\n")
    assert "algo=ppo" in (tmp_path / "comparison.html").read_text()
    with pytest.raises(UserError, match="nowhere is not a run folder"):
        compare.main(["a", "b", "nowhere", "out=comparison.html"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [([], "run folders are missing"), (["nowhere"], "nowhere is not a run folder"), (["."], "not a run folder")],
)
def test_mistakes_are_said_and_nothing_is_written(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=message):
        compare.main(arguments)
    assert not list(tmp_path.iterdir())
