"""experiments/plugged_in.py, with the trainings of the others replaced by what they leave behind."""

import json

import pytest


@pytest.fixture
def experiment(monkeypatch, tmp_path):
    """The script, which writes elsewhere, and the calls that it makes."""
    import commands
    import plugged_in

    calls = []

    def ask(interpreter, script, *options):
        calls.append((interpreter.parts[-3], script, dict(option.split("=", 1) for option in options)))
        seed = int(calls[-1][2]["seed"])
        return [{"steps": 100_000, "return": -500.0}, {"steps": 300_000, "return": -150.0 - seed}]

    def train(interpreter, seeds, *options):
        calls.append((str(interpreter), "train", dict(option.split("=", 1) for option in options)))
        return [1.0 * seed for seed in range(seeds)]

    monkeypatch.setattr(commands, "RESULTS", tmp_path)
    monkeypatch.setattr(plugged_in, "ask", ask)
    monkeypatch.setattr(plugged_in, "train", train)
    return plugged_in, calls, lambda: json.loads((tmp_path / "plugged_in.json").read_text())


def test_every_part_reports_means_over_seeds(experiment, capsys):
    plugged_in, calls, results = experiment
    plugged_in.main(["--venvs", "/v"])
    found = results()
    assert len(capsys.readouterr().out.splitlines()) == len(found) == 8
    assert found["SB3 PPO, Pendulum-v1"]["mean"] == -151.0
    assert found["SB3 PPO, Pendulum-v1"]["stderr"] == pytest.approx(1 / 3**0.5, abs=0.01)
    assert found["SB3 PPO, Pendulum-v1"]["curve"][0] == {"steps": 100_000, "mean": -500.0, "stderr": 0.0} | {
        "seeds": [-500.0] * 3
    }
    assert found["brax PPO, jaxpg's pendulum, 200,000 steps"]["seeds"] == [-150.0, -151.0, -152.0]
    assert found["jaxpg PPO, brax's reacher"]["seeds"] == [0.0, 1.0, 2.0]
    trained_by_sb3 = [options for _, script, options in calls if script == "sb3_by_name.py"]
    assert [options.pop("env") for options in trained_by_sb3] == ["Pendulum-v1"] * 3 + [
        "jaxpg.gymnasium:jaxpg/Pendulum-v0"
    ] * 3
    assert trained_by_sb3[:3] == trained_by_sb3[3:]  # all else is the same


@pytest.mark.parametrize("task", ["REACHER", "CARTPOLE"])
def test_both_train_for_as_long(experiment, task):
    ours, theirs = (dict(option.split("=", 1) for option in options) for options in getattr(experiment[0], task))
    assert ours["total_steps"] == theirs["steps"]
    assert ours["env.name"] == theirs["env"]


def test_parts_are_added_to_what_was_found_before(experiment):
    plugged_in, _, results = experiment
    plugged_in.main(["--venvs", "/v", "--only", "sb3"])
    plugged_in.main(["--venvs", "/v", "--only", "brax", "--seeds", "2"])
    assert len(results()) == 4
