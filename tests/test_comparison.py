"""Runs side by side: what is one method, what distinguishes it, and which is better."""

import csv
import json

import matplotlib.figure
import numpy as np
import pytest

from jaxpg import compare
from jaxpg.config import configuration
from jaxpg.config.parsing import compose
from jaxpg.errors import UserError
from jaxpg.store.statistics import bootstrap_interval, interquartile_mean, probability_of_improvement
from jaxpg.watch import publication
from jaxpg.watch.comparison import COLUMNS, build_comparison, make_table, write_notes
from jaxpg.watch.methods import compute_standings, read_methods


@pytest.fixture
def run(tmp_path):
    """`run(name, returns, *options)`: a folder as a run leaves it, with an evaluation for each row of returns."""

    def make(name, returns, *options, success=None, every=100):
        folder = tmp_path / name
        folder.mkdir()
        config = compose([*options, f"run_dir={folder}"])
        (folder / "config.yaml").write_text(configuration.to_yaml(config))
        lines = [
            {"update": i, "steps": every * i, "seconds": 1.0 * i, "eval_return": row}
            for i, row in enumerate(returns, 1)
        ]
        for line in lines:
            line |= {"eval_success": success} if success is not None else {}
        (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        return str(folder)

    return make


def test_runs_that_differ_in_their_seeds_are_one_method(run):
    folders = [run(f"{seed}", [[-1.0 * seed], [2.0 * seed]], f"seed={seed}") for seed in range(3)]
    folders.append(run("more", [[5.0, 6.0], [7.0, 8.0], [9.0, 9.0]], "seed=3", "num_seeds=2", "total_steps=300"))
    (method,) = read_methods(folders)
    assert method.label == "algo=ppo"
    steps, values = method.values("eval_return")
    assert steps.tolist() == [100, 200]  # where all of them have one
    assert values.tolist() == [[0, 0], [-1, 2], [-2, 4], [5, 7], [6, 8]]
    assert compute_standings([method])[0].returns.tolist() == [0, 2, 4, 7, 8]


def test_a_label_says_what_distinguishes_and_no_more(run):
    folders = [
        run("a", [-3.0], "algo=td"),
        run("b", [-2.0], "algo=td", "algo.gamma=0.9"),
        run("c", [-1.0], "algo=reinforce"),
    ]
    # The tuned options of TD and REINFORCE differ in many ways, which their names say already.
    assert [method.label for method in read_methods(folders)] == [
        "algo=reinforce algo.gamma=0.977",
        "algo=td algo.gamma=0.9",
        "algo=td algo.gamma=0.97",
    ]


def test_each_setting_of_a_sweep_is_a_method(run):
    folder = run("swept", [[1.0, 2.0, 3.0, 4.0]], "num_seeds=2", "sweep.algo.gamma=[0.5,0.9]")
    found = {one.method.label: one.returns.tolist() for one in compute_standings(read_methods([folder]))}
    assert found == {"algo.gamma=0.9": [3, 4], "algo.gamma=0.5": [1, 2]}
    alone = run("alone", [10.0], "seed=7", "algo.gamma=0.5")
    found = {one.method.label: one.returns.tolist() for one in compute_standings(read_methods([folder, alone]))}
    assert found["algo.gamma=0.5"] == [1, 2, 10]


def test_the_best_is_the_first_and_its_improvement_is_probable(run):
    low, high = [1.0, 5.0, 2.0, 3.0], [4.0, 6.0, 2.5, 9.0]
    folders = [
        run("low", [low], "num_seeds=4", "algo.gamma=0.5"),
        run("high", [high], "num_seeds=4", "algo.gamma=0.9"),
    ]
    found = read_methods(folders)
    data = build_comparison(found)
    assert data["improvement"]["labels"] == ["algo.gamma=0.9", "algo.gamma=0.5"]
    probability = data["improvement"]["probability"]
    assert probability[0][1] == probability_of_improvement(np.array(high), np.array(low)) == 13 / 16
    assert probability[0][1] + probability[1][0] == 1
    assert probability[0][0] is None
    assert 0 <= data["improvement"]["low"][0][1] <= 13 / 16 <= data["improvement"]["high"][0][1] <= 1
    mean = f"{interquartile_mean(np.array(high)):.1f}"
    assert make_table(found)[0] == ["algo.gamma=0.9", f"{mean} (2.5 to 9.0)", "4", "100"]
    assert ["env", "pendulum"] in data["configuration"]
    assert "algo.gamma" not in dict(data["configuration"])


@pytest.mark.parametrize(("few", "many"), [(1, 3), (3, 1), (1, 50), (3, 3), (2, 4)])
def test_too_few_seeds_are_sure_of_nothing(run, few, many):
    """However far apart they are."""
    folders = [
        run("a", [[100.0 + i for i in range(few)]], "algo=ppo", f"num_seeds={few}"),
        run("b", [[1.0 * i for i in range(many)]], "algo=td", f"num_seeds={many}"),
    ]
    found = read_methods(folders)
    data = build_comparison(found)["improvement"]
    assert data["probability"][0][1] == 1
    assert [row for row in data["low"] + data["high"] if any(end is not None for end in row)] == []
    assert "[" not in make_table(found)[0][1]
    assert any("a 95 % interval needs at least 6 seeds" in line for line in write_notes(found))


def test_enough_seeds_have_an_interval_and_no_note(run):
    scores = [[10.0 + i for i in range(6)]], [[1.0 * i for i in range(6)]]
    folders = [run(str(i), rows, f"algo.gamma=0.{i + 1}", "num_seeds=6") for i, rows in enumerate(scores)]
    found = read_methods(folders)
    data = build_comparison(found)["improvement"]
    assert 0.5 < data["low"][0][1] < data["probability"][0][1] == data["high"][0][1] == 1
    assert [row[1].count("[") for row in make_table(found)] == [1, 1]
    assert write_notes(found) == []


def test_runs_of_unequal_steps_are_compared_at_equal_steps(run):
    """Who went on for longer is better in the end, and worse at the steps that both have reached."""
    folders = [
        run("long", [-9.0, -8.0, -7.0, -1.0], "algo=td", "total_steps=400"),
        run("short", [-6.0, -5.0], "algo=ppo", "total_steps=200"),
    ]
    found = read_methods(folders)
    assert [row[:2] + row[-1:] for row in make_table(found)] == [
        ["algo=ppo", "-5.0", "200"],
        ["algo=td", "-8.0", "200"],
    ]
    assert build_comparison(found)["improvement"]["probability"] == [[None, 1], [0, None]]
    (said,) = [line for line in write_notes(found) if "compared at 200 environment steps" in line]
    assert "algo=td trained until 400" in said
    assert [series["steps"][-1] for series in build_comparison(found)["curves"][0]["series"]] == [200, 400]


def test_where_nobody_was_evaluated_at_the_same_steps_the_nearest_count_and_it_is_said(run):
    folders = [
        run("a", [-9.0, -8.0, -7.0], "algo=td"),
        run("b", [-6.0, -5.0], "algo=ppo", every=115),
    ]
    found = read_methods(folders)
    assert [row[:2] + row[-1:] for row in make_table(found)] == [
        ["algo=ppo", "-5.0", "230"],
        ["algo=td", "-8.0", "200"],
    ]
    assert any("not evaluated at 230 steps, but nearby: algo=td at 200" in line for line in write_notes(found))


def test_a_table_is_csv_with_intervals_where_there_are_some(run, tmp_path, capsys):
    many, few = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0], [-1.0, -2.0]
    folders = [
        run("many", [many], "env=arm", "algo.gamma=0.9", "num_seeds=8", success=[0.25] * 8),
        run("few", [few], "env=arm", "algo.gamma=0.5", "num_seeds=2", success=[0.5, 1.0]),
    ]
    assert compare.main([*folders, f"out={tmp_path / 'table.csv'}"]) == 0
    first, second = csv.DictReader((tmp_path / "table.csv").read_text().splitlines())
    low, high = bootstrap_interval(np.array(many))
    numbers = {"return": 4.5, "return_low": low, "return_high": high, "success": 0.25, "seeds": 8}
    assert {name: float(first[name]) for name in numbers} == pytest.approx(numbers)
    assert first["method"] == "algo.gamma=0.9"
    assert [second[name] for name in ("return", "return_low", "return_high")] == ["-1.5", "", ""]
    assert [first["environment_steps"], second["success"]] == ["100", "0.75"]
    assert "table.csv" in capsys.readouterr().out


@pytest.mark.parametrize("ending", ["pdf", "svg", "PDF"])
def test_a_figure_is_drawn_of_vectors_with_its_fonts_and_the_same_each_time(run, ending, tmp_path):
    folders = [
        run("a", [[-3.0 + i for i in range(8)], [-2.0] * 8], "env=arm", "num_seeds=8", success=[0.5] * 8),
        run("b", [[-3.0], [-1.0]], "env=arm", "algo=td"),
    ]
    written = []
    for name in ("one", "two"):
        assert compare.main([*folders, f"out={tmp_path / name}.{ending}"]) == 0
        written.append((tmp_path / f"{name}.{ending}").read_bytes())
    assert written[0] == written[1]
    if ending == "svg":
        assert b"<image" not in written[0]
        assert b"<text" not in written[0]  # letters are outlines: no font is needed
    else:
        assert b"/FontFile2" in written[0]
        assert b"/Subtype /Image" not in written[0]


def test_a_figure_can_be_read_without_its_colours(run, monkeypatch):
    """Each method has dashes and marks that no other of the first 28 has."""
    drawn = []
    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", lambda self, *_, **__: drawn.append(self))
    names = [f"0.{i:02}" for i in range(10, 38)]
    folders = [run(name, [-1.0, 0.0], f"algo.gamma={name}") for name in names]
    publication.draw_figure(read_methods(folders), "pdf")
    lines = drawn[0].axes[0].get_lines()
    assert len({(line.get_linestyle(), line.get_marker()) for line in lines}) == len(names)


def test_another_ending_is_refused_before_anything_is_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("figure.png", "table", "page.htm"):
        with pytest.raises(UserError, match=r"must end in .html, .pdf, .svg, .csv"):
            compare.main(["nowhere", f"out={name}"])
    assert not list(tmp_path.iterdir())


def test_success_is_shown_where_there_is_one(run):
    found = read_methods([run("arm", [-1.0, -2.0], "env=arm", success=0.75)])
    assert make_table(found) == [["algo=ppo", "-2.0", "75.0 %", "1", "200"]]
    assert [panel["title"] for panel in build_comparison(found)["curves"]] == ["return", "success rate"]
    assert [len(row) for row in make_table(read_methods([run("pendulum", [-1.0])]))] == [len(COLUMNS) - 1]


@pytest.mark.parametrize(
    ("runs", "message"),
    [
        (
            [("a", "env=arm"), ("b", "env=pendulum")],
            "can only be compared in the same environment: arm in .*a; pendulum in .*b",
        ),
        (
            [("a", "env=brax"), ("b", "env=brax", "env.name=ant")],
            "in the same environment: ant in .*b; inverted_pendulum in .*a",
        ),
        ([("a", "seed=1"), ("b", "seed=1")], "seed 1 occurs twice"),
        ([("a", "seed=1"), ("none", "seed=2")], "its runs have no evaluation in common"),
    ],
)
def test_what_cannot_be_compared_is_said(run, runs, message):
    folders = [run(name, [] if name == "none" else [-1.0], *options) for name, *options in runs]
    with pytest.raises(UserError, match=message):
        read_methods(folders)


def test_the_command_takes_folders_with_any_name(run, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folders = [run("a, (with) odd name=x", [-1.0], "algo=td"), run("b", [-2.0], "algo=ppo")]
    assert compare.main([*folders, "out=both.html"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert [line.split() for line in said[:3]] == [
        ["method", "return", "seeds", "environment", "steps"],
        ["algo=td", "-1.0", "1", "100"],
        ["algo=ppo", "-2.0", "1", "100"],
    ]
    assert said[3:] == ["note: a 95 % interval needs at least 6 seeds", "both.html"]
    assert "algo=ppo" in (tmp_path / "both.html").read_text()


def test_what_is_no_run_is_left_out_with_a_note(run, tmp_path, capsys, monkeypatch):
    """`runs/*` finds the page that was written there before."""
    monkeypatch.chdir(tmp_path)
    run("a", [-1.0], "algo=td")
    run("b", [-2.0], "algo=ppo")
    (tmp_path / "comparison.html").write_text("<!DOCTYPE html>")
    (tmp_path / "notes").mkdir()
    assert compare.main(["a", "b", "comparison.html", "notes", "out=comparison.html"]) == 0
    assert capsys.readouterr().out.startswith("note: skipped, not a run folder: comparison.html, notes\n")
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
