"""The commands as their users run them: real processes, real folders."""

import json
import re
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
from processes import has_written

from jaxpg.store import policies
from jaxpg.store.checkpoint import Checkpoints

TINY = (
    "num_envs=4",
    "num_steps=4",
    "log_interval=64",
    "eval_interval=256",
    "eval_episodes=2",
    "checkpoint_interval=256",
    "report=false",  # which takes longer than such a run
)
LINES = 64  # log lines of the run that is stopped and resumed
LONG = (*TINY, f"total_steps={64 * LINES}", "env.episode_length=20")


def metrics(folder):
    """The lines of metrics, without their times."""
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in line.items() if name != "seconds"} for line in lines]


def digests(folder):
    """SHA-256 of every array of the newest checkpoint, and its number."""
    checkpoints = Checkpoints(folder / "checkpoints")
    return checkpoints.latest(), checkpoints.record(checkpoints.latest())["leaves"]


@pytest.fixture(scope="module")
def uninterrupted(command, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "uninterrupted"
    result = command("train", *LONG, f"run_dir={folder}")
    assert result.returncode == 0, result.stderr
    return folder, result


def test_a_run_leaves_everything_behind(uninterrupted):
    folder, result = uninterrupted
    assert {path.name for path in folder.iterdir()} == {
        *("config.yaml", "versions.json", "metrics.jsonl", "tb", "checkpoints", "best", "learning_curve.png")
    }
    assert (folder / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    assert list((folder / "tb").glob("events*"))
    assert f"python -m jaxpg.evaluate run={folder}" in result.stdout
    assert len(metrics(folder)) == LINES
    assert json.loads((folder / "versions.json").read_text())["threads"] >= 1


def test_a_run_makes_no_noise(uninterrupted):
    """Nothing on standard error, and no library's talk on standard output."""
    _, result = uninterrupted
    assert result.stderr == ""
    assert not re.search("warp|warning|absl|deprecat", result.stdout, re.IGNORECASE)
    assert result.stdout.startswith(
        "ppo on pendulum, seed 0: 4 environments x 4 steps x 256 updates = 4,096 steps, into"
    )
    assert "compiling" in result.stdout


@pytest.mark.parametrize(
    ("stop", "status", "after"),
    [
        ("SIGTERM", 143, 5),
        pytest.param("SIGINT", 130, 17, marks=pytest.mark.faults),
        pytest.param("SIGKILL", -9, 30, marks=pytest.mark.faults),
    ],
)
def test_stopped_and_resumed_is_never_stopped(
    uninterrupted, command, command_environment, tmp_path, stop, status, after
):
    """State, best policy and metrics to the bit, wherever the run was stopped."""
    whole, _ = uninterrupted
    folder = tmp_path / "stopped"
    with subprocess.Popen(
        [sys.executable, "-m", "jaxpg.train", *LONG, f"run_dir={folder}"],
        env=command_environment,
        stdout=subprocess.DEVNULL,
    ) as process:
        assert has_written(process, folder, after), "the run ended before it could be stopped"
        process.send_signal(signal.Signals[stop])
        assert process.wait(timeout=60) == status
    assert len(metrics(folder)) < LINES
    result = command("train", f"resume={folder}")
    assert result.returncode == 0, result.stderr
    assert "resuming" in result.stdout
    assert "not the same bits" not in result.stdout
    assert metrics(folder) == metrics(whole)
    assert digests(folder) == digests(whole)


def test_resume_with_more_steps(command, tmp_path):
    folder = tmp_path / "a run, (with) odd name=x äß"
    assert command("train", "env=quadratic", *TINY, "total_steps=256", f"run_dir={folder}").returncode == 0
    assert "is finished" in command("train", f"resume={folder}").stdout
    result = command("train", f"resume={folder}", "total_steps=512")
    assert result.returncode == 0, result.stderr
    assert [line["steps"] for line in metrics(folder)] == list(range(64, 513, 64))


@pytest.mark.parametrize(
    ("agents", "enough", "two"),
    [
        ("one", np.max, "num_seeds=2"),
        ("all", np.min, "num_seeds=2"),
        ("one", np.max, "sweep.algo.actor_lr=[0.001,0.02]"),
    ],
)
def test_a_run_ends_where_the_return_is_reached(command, tmp_path, agents, enough, two):
    """By the best or the worst of two agents; the checkpoint is there, and a higher return goes on."""
    folder = tmp_path / "run"
    sizes = (two, "log_interval=1600", "eval_interval=1600", "eval_episodes=2")
    quadratic = ("env=quadratic", "algo=reinforce", *sizes, f"stop_agents={agents}", "stop_return=-2")
    result = command("train", *quadratic, f"run_dir={folder}")
    assert result.returncode == 0, result.stderr
    best = np.maximum.accumulate([line["eval_return"] for line in metrics(folder)])
    *before, last = enough(best, axis=1)
    assert last >= -2 > max(before)
    assert f"reached stop_return=-2 after {metrics(folder)[-1]['steps']:,} steps" in result.stdout
    assert digests(folder)[0] == metrics(folder)[-1]["update"]
    assert "has reached stop_return=-2" in command("train", f"resume={folder}").stdout
    result = command("train", f"resume={folder}", f"stop_return={last + 0.01}")
    assert "reached stop_return=" in result.stdout
    assert metrics(folder)[-1]["steps"] > metrics(folder)[len(before)]["steps"]


def test_evaluation_of_a_run(uninterrupted, command):
    folder, _ = uninterrupted
    results = [
        command("evaluate", f"run={folder}", "episodes=8", "json=true", "env.episode_length=200", *more)
        for more in ((), (), ("seed=1",), ("checkpoint=last",))
    ]
    for result in results:
        assert result.returncode == 0, result.stderr
        assert result.stderr == ""
    answers = [json.loads(result.stdout.splitlines()[-1]) for result in results]
    assert set(answers[0]) == {"mean", "stderr", "episodes", "success", "diverged"}
    assert answers[0]["episodes"] == 8
    assert -2000 < answers[0]["mean"] < 0
    assert answers[0] == answers[1], "the same seed gives the same starts"
    assert answers[0] != answers[2]


def test_gymnasium_plays_the_same_episodes(uninterrupted, command):
    """Mean returns in Gymnasium and in MJX agree within 4 standard errors of their difference."""
    folder, _ = uninterrupted
    arguments = (f"run={folder}", "episodes=200", "json=true", "env.episode_length=200")
    answers = [
        json.loads(command("evaluate", *arguments, f"backend={backend}").stdout.splitlines()[-1])
        for backend in ("mjx", "gymnasium")
    ]
    spread = (answers[0]["stderr"] ** 2 + answers[1]["stderr"] ** 2) ** 0.5
    assert abs(answers[0]["mean"] - answers[1]["mean"]) < 4 * spread


@pytest.mark.study
def test_several_seeds_of_the_arm(command, tmp_path):
    folder = tmp_path / "run"
    result = command(
        *("train", "env=arm", "num_seeds=3", *TINY, "env.episode_length=8", "total_steps=256"), f"run_dir={folder}"
    )
    assert result.returncode == 0, result.stderr
    assert "success" in result.stdout
    line = metrics(folder)[-1]
    assert len(line["eval_return"]) == len(line["eval_success"]) == 3
    assert len(set(line["eval_return"])) == 3, "different seeds are different agents"
    answer = json.loads(
        command("evaluate", f"run={folder}", "episodes=2", "json=true", "agent=2").stdout.splitlines()[-1]
    )
    assert answer["success"] is not None


SWEEP = ("sweep.algo.gamma=[0.5,0.9]", "sweep.algo.actor_lr=[0.001,0.01,1e38]")


@pytest.fixture(scope="module")
def swept(command, tmp_path_factory):
    """Six settings, two of which diverge, with two seeds."""
    folder = tmp_path_factory.mktemp("runs") / "swept"
    sizes = ("env=quadratic", "algo=td", "network=linear", "num_seeds=2", "total_steps=768", "env.episode_length=8")
    result = command("train", *sizes, *TINY, *SWEEP, f"run_dir={folder}")
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    return folder, result.stdout


def test_a_sweep_trains_every_setting_with_every_seed(swept):
    """And says at the end which is the best, by the interquartile mean of the seeds."""
    folder, text = swept
    assert text.startswith("td on quadratic, 6 settings x seeds 0 to 1: ")
    assert len(list((folder / "checkpoints").iterdir())) == 3
    returns = np.array(metrics(folder)[-1]["eval_return"], float).reshape(6, 2)
    assert np.isnan(returns[[2, 5]]).all(), "the settings change in the order of the command line, the last one fastest"
    rows = re.findall(r"^algo\.gamma=(\S+) algo\.actor_lr=(\S+) +(\S+)(?: \((\S+) to (\S+)\))?$", text, re.MULTILINE)
    means = {(gamma, lr): mean for gamma, lr, mean, _, _ in rows}
    expected = [f"{mean:.1f}" for mean in returns.mean(axis=1)]
    settings = [(gamma, lr) for gamma in ("0.5", "0.9") for lr in ("0.001", "0.01", "1e+38")]
    assert [means[setting] for setting in settings] == [mean.replace("nan", "n/a") for mean in expected]
    finite = [float(mean) for *_, mean, low, _ in rows if low]
    assert finite == sorted(finite, reverse=True)
    assert "inf" not in text
    assert [lr for _, lr, *_ in rows[4:]] == ["1e+38", "1e+38"]


def test_agents_of_a_sweep_are_evaluated_and_inspected_by_their_settings(swept, command):
    folder, text = swept
    first = text[text.index("(lowest to highest):") :].splitlines()[1]
    assert f"best setting {re.sub(' {2,}', ': ', first)}" in command("inspect", f"run={folder}").stdout
    result = command("evaluate", f"run={folder}", "episodes=2", "agent=7")
    assert "quadratic, seed 1 algo.gamma=0.9 algo.actor_lr=0.001, best policy" in result.stdout
    assert "the run has agents 0 to 11" in command("evaluate", f"run={folder}", "agent=12").stderr


def test_a_sweep_resumed_is_the_sweep_never_stopped(swept, command, tmp_path):
    """State, best policies and metrics to the bit; the sweep itself may not change."""
    whole, _ = swept
    folder = tmp_path / "stopped"
    shutil.copytree(whole, folder)
    shutil.rmtree(folder / "checkpoints" / "48")
    result = command("train", f"resume={folder}", "sweep.algo.gamma=[0.5,0.8]")
    assert result.returncode == 2
    assert "has sweep.algo.gamma=[0.5, 0.9], and on resume only" in result.stderr
    result = command("train", f"resume={folder}", *SWEEP)
    assert result.returncode == 0, result.stderr
    assert "resuming" in result.stdout
    assert metrics(folder) == metrics(whole)
    assert digests(folder) == digests(whole)


# With mjx, brax's default here, it takes two minutes to compile, with spring one.
@pytest.mark.study
@pytest.mark.parametrize("backend", ["spring", "mjx"])
def test_brax_environments_train(command, tmp_path, backend):
    folder = tmp_path / "run"
    brax = ("env=brax", "env.name=inverted_pendulum", f"env.backend={backend}", "env.episode_length=8")
    result = command("train", *brax, *TINY, "total_steps=256", f"run_dir={folder}", timeout=900)
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    assert len(metrics(folder)) == 4


def test_a_policy_is_played_with_the_threads_of_a_training(monkeypatch, uninterrupted):
    """Brax's environments hang on more than one with some releases of jaxlib, in an evaluation as in a training."""
    prepared = []
    monkeypatch.setattr(policies, "prepare", lambda config, **_: prepared.append(config))
    stored = policies.load(str(uninterrupted[0]))
    (config,) = prepared
    assert config.choices == stored.config.choices


def test_help_lists_every_option(command):
    result = command("train", "--help", "env=arm", "algo=reinforce")
    assert result.returncode == 0
    for text in (
        "env.success_radius=0.05",
        "algo.baseline=value",
        "network.widths=[64,64]",
        "total_steps=",
        "none or mean or time_mean or leave_one_out or optimal or value",
        "sweep.NAME=[VALUE,VALUE,...]",
    ):
        assert text in result.stdout
    assert "run=" in command("evaluate", "--help").stdout


def test_several_mistakes_are_reported_at_once_with_status_2(command, tmp_path):
    swept = ("sweep.algo.lambda_=[0,2,3]", "sweep.algo.gama=[1]", "sweep.num_steps=[4]")
    result = command("train", "algo.gamma=2", "seed=-1", "num_envs=2.5", *swept, f"run_dir={tmp_path / 'run'}")
    assert result.returncode == 2
    assert result.stdout == ""
    assert [line.split(":")[1].strip() for line in result.stderr.splitlines()] == [
        "algo.gamma=2",
        "seed=-1",
        "num_envs=2.5",
        "sweep.algo.lambda_=2",
        "sweep.algo.lambda_=3",
        "unknown option 'sweep.algo.gama'",
        "sweep.num_steps",
    ]
    assert not (tmp_path / "run").exists()
