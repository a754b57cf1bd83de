"""Mistakes end in one clear line, status 2, and nothing written."""

import errno
import json
import os
import shutil
import sys

import pytest
from processes import tree

from jaxpg import evaluate, train
from jaxpg.commands.ending import run_command
from jaxpg.store import cache_folder

MISTAKES = {
    "unknown option": (["lerning_rate=3"], "unknown option 'lerning_rate'"),
    "misspelt option": (["algo.gama=0.9"], "unknown option 'algo.gama': did you mean 'algo.gamma'?"),
    "part of a name": (["algo.lr=0.1"], "unknown option 'algo.lr': did you mean 'algo.actor_lr'?"),
    "part of a name without its group": (["lr=0.1"], "unknown option 'lr': did you mean 'algo.actor_lr'?"),
    "name with nothing near": (["algo.learning_rate=0.1"], "known are algo.actor_lr, algo.clip,"),
    "table for a number": (["env.mass={a: 1}"], "env.mass={'a': 1}: expected a number"),
    "interpolation for a number": (["env.mass='${seed}'"], "env.mass=${seed}: expected a number"),
    "option without its group": (["gamma=0.9"], "unknown option 'gamma': did you mean 'algo.gamma'?"),
    "misspelt environment": (["env=pendulm"], "unknown env 'pendulm': did you mean 'pendulum'?"),
    "misspelt algorithm": (["algo=reinforc"], "unknown algo 'reinforc': did you mean 'reinforce'?"),
    "unknown algorithm": (["algo=xyz"], "unknown algo 'xyz': known are online, ppo, reinforce, td"),
    "list of algorithms": (["algo=[td,ppo]"], "unknown algo '['td', 'ppo']': known are online, ppo, reinforce, td"),
    "option of another algorithm": (
        ["algo=td", "algo.baseline=mean"],
        "algo=td has no option algo.baseline; reinforce has it",
    ),
    "option of another environment": (["env.goal_min=0.3"], "unknown option 'env.goal_min'"),
    "word for a number": (["num_envs=many"], "num_envs=many: expected a whole number"),
    "fraction for a count": (["num_envs=2.5"], "num_envs=2.5: expected a whole number"),
    "number for a switch": (["network.squash=1"], "network.squash=1: expected true or false"),
    "number for a list": (["network.widths=64"], "network.widths=64: expected a list such as [64,64]"),
    "unknown choice": (["network.activation=gelu"], "must be tanh or relu or elu or swish"),
    "too many features": (
        ["env=arm", "network=linear", "network.features=fourier", "network.order=9"],
        "network.features=fourier network.order=9: 9,999,999",
    ),
    "one radial bump": (["network=linear", "network.features=radial", "network.order=1"], "at least 2 points"),
    "widths of a linear network": (
        ["network=linear", "network.widths=[8]"],
        "network=linear has no option network.widths; mlp has it",
    ),
    "zero environments": (["num_envs=0"], "num_envs=0: must be at least 1"),
    "zero width": (["network.widths=[64,0]"], "must be at least 1"),
    "negative steps": (["total_steps=-5"], "total_steps=-5: must be at least 1"),
    "negative step size": (["algo.actor_lr=-0.1"], "algo.actor_lr=-0.1: must be above 0"),
    "step size that is no number": (["algo.actor_lr=nan"], "algo.actor_lr=nan: must be finite"),
    "infinite step size": (["algo.actor_lr=inf"], "algo.actor_lr=inf: must be finite"),
    "discount above 1": (["algo.gamma=1.5"], "algo.gamma=1.5: must be at least 0, at most 1"),
    "lambda below 0": (["algo.lambda_=-0.5"], "algo.lambda_=-0.5: must be at least 0, at most 1"),
    "negative seed": (["seed=-1"], "seed=-1: must be at least 0, at most 4294967295"),
    "seed of 33 bits": (["seed=4294967296"], "must be at least 0, at most 4294967295"),
    "seeds beyond 32 bits": (["seed=4294967295", "num_seeds=2"], "seeds must stay below 2**32"),
    "agents that do not divide": (
        ["num_seeds=6", "vmap_seeds=4"],
        "vmap_seeds=4 does not divide the number of agents, 6: the nearest that does is 3",
    ),
    "settings that do not divide": (
        ["num_seeds=3", "vmap_seeds=4", "sweep.algo.gamma=[0.9,0.95]"],
        "vmap_seeds=4 does not divide the number of agents, 6: the nearest that does is 3",
    ),
    "sweep of a misspelt option": (
        ["sweep.algo.gama=[0.9]"],
        "unknown option 'sweep.algo.gama': did you mean 'sweep.algo.gamma'?",
    ),
    "sweep without the group": (["sweep.gamma=[0.9]"], "did you mean 'sweep.algo.gamma'?"),
    "sweep of another algorithm's option": (["algo=td", "sweep.algo.clip=[0.2]"], "unknown option 'sweep.algo.clip'"),
    "sweep of a size": (
        ["sweep.num_envs=[32,64]"],
        "sweep.num_envs: num_envs cannot be swept; train a run for each value",
    ),
    "sweep of a count": (["sweep.algo.epochs=[1,2]"], "algo.epochs cannot be swept"),
    "sweep of a switch": (
        ["sweep.algo.normalize_advantages=[true,false]"],
        "algo.normalize_advantages cannot be swept",
    ),
    "sweep of widths": (["sweep.network.widths=[[8],[16]]"], "network.widths cannot be swept"),
    "sweep of the environment": (["sweep.env=[arm,pendulum]"], "env cannot be swept"),
    "sweep of a scheduled sigma": (
        ["algo=td", "network.sigma_is=scheduled", "sweep.network.sigma=[0.5,1]"],
        "sweep.network.sigma: cannot be swept with network.sigma_is=scheduled",
    ),
    "sweep of one number": (["sweep.algo.gamma=0.9"], "sweep.algo.gamma=0.9: expected a list of values"),
    "sweep of nothing": (["sweep.algo.gamma=[]"], "sweep.algo.gamma=[]: expected at least one value"),
    "sweep of a word": (["sweep.algo.gamma=[0.9,high]"], "sweep.algo.gamma=high: expected a number"),
    "sweep out of range": (["sweep.algo.gamma=[0.9,1.5]"], "sweep.algo.gamma=1.5: must be at least 0, at most 1"),
    "sweep of a value twice": (["sweep.algo.gamma=[0.9,0.90]"], "sweep.algo.gamma=0.9: appears twice in the list"),
    "sweep of null": (["algo=ppo", "sweep.algo.clip=[0.2,null]"], "sweep.algo.clip=null: null cannot be swept"),
    "swept and given": (
        ["algo.gamma=0.9", "sweep.algo.gamma=[0.9,0.95]"],
        "algo.gamma is both given and swept; leave one out",
    ),
    "unknown policy for what is not finite": (["nan_policy=ignore"], "must be stop or skip"),
    "fraction for a seed": (["seed=1.5"], "seed=1.5: expected a whole number"),
    "switch for a seed": (["seed=true"], "seed=True: expected a whole number"),
    "nothing for a seed": (["seed="], "seed=: expected a whole number"),
    "digits of another script": (["seed=\u0663"], "seed=\u0663: expected a whole number"),
    "rollout beyond 32 bits": (
        ["num_envs=100000000", "num_steps=30"],
        "num_envs=100000000 num_steps=30: their product must stay below 2**31",
    ),
    "environments beyond 32 bits": (["num_envs=1000000000000"], "must be at least 1, at most 2147483647"),
    "updates beyond 32 bits": (
        ["algo=td", "num_envs=2", "num_steps=1", "total_steps=1e12"],
        "total_steps=1000000000000: with 2 steps per update it must stay below 4294967294",
    ),
    "gradient steps beyond 32 bits": (
        ["algo=ppo", "num_envs=512", "num_steps=30", "algo.epochs=10", "algo.minibatches=8", "total_steps=5e11"],
        "total_steps=500000000000: with 15360 steps and 80 gradient steps per update it must stay below 412316851200",
    ),
    "episodes beyond 32 bits": (["env.episode_length=3e9"], "env.episode_length=3000000000: it must stay below 2**31"),
    "rollouts beyond memory": (["num_envs=50000000"], "num_envs=50000000: this training needs at least "),
    "networks beyond memory": (
        ["network.widths=[1000000,1000000]"],
        "network.widths=[1000000, 1000000]: this training needs at least ",
    ),
    "agents beyond memory": (["num_seeds=1000000000"], "num_seeds=1000000000: this training needs at least "),
    "evaluations beyond memory": (["eval_episodes=1e12"], "eval_episodes=1000000000000: this training needs at least "),
    "auto without a folder": (["resume=auto"], "resume=auto needs run_dir=DIR"),
    "negative mass": (["env.mass=-1"], "env.mass=-1: must be above 0"),
    "rollout length of whole episodes": (["algo=reinforce", "num_steps=10"], "algo=reinforce plays whole episodes"),
    "leave nobody": (["algo=reinforce", "algo.baseline=leave_one_out", "num_envs=1"], "num_envs must be at least 2"),
    "factors twice": (
        ["algo=reinforce", "algo.returns=whole", "algo.discounted=true"],
        "algo.discounted=true: whole returns already have the factors gamma^t",
    ),
    "no rewards to sum": (["algo.estimator=n_step", "algo.n=0"], "algo.n=0: must be at least 1"),
    "environments that do not divide": (
        ["algo=ppo", "num_envs=64", "algo.num_shards=1", "algo.minibatches=5"],
        "algo.minibatches=5 does not divide num_envs=64: the nearest that does is 4",
    ),
    "environments of a shard that do not divide": (
        ["algo=ppo", "num_envs=64", "algo.num_shards=4", "algo.minibatches=10"],
        "algo.minibatches=10 does not divide num_envs=64 / algo.num_shards=4: the nearest that does is 8",
    ),
    "shards that do not divide": (
        ["algo=td", "num_envs=64", "algo.num_shards=5"],
        "algo.num_shards=5 does not divide num_envs=64: the nearest that does is 4",
    ),
    "no clip": (["algo=ppo", "algo.clip=0"], "algo.clip=0: must be above 0"),
    "schedule without an optimizer": (
        ["algo=online", "network.sigma_is=scheduled"],
        "network.sigma_is=scheduled: algo=online has no schedules",
    ),
    "unknown estimator": (["algo.estimator=gae"], "must be td_lambda or td_zero or n_step or monte_carlo"),
    "goal out of reach": (["env=arm", "env.goal_max=2"], "goals must lie in the reachable ring"),
    "unknown brax environment": (
        ["env=brax", "env.name=reachr"],
        "unknown brax environment 'reachr': did you mean 'reacher'?",
    ),
    "no equals sign": (["seed"], "'seed': expected name=value"),
    "stray flag": (["--fast"], "'--fast': expected name=value"),
    "unbalanced bracket": (["network.widths=[64"], "expected name=value"),
    "values without a list": (["seed=1,2"], "seed=1,2: expected a whole number"),
    "given twice": (["seed=1", "seed=2"], "seed is given twice"),
    "no run folder to resume": (
        ["resume=/nowhere/at/all"],
        "/nowhere/at/all is not a run folder: it has no config.yaml",
    ),
}


@pytest.fixture(scope="module", autouse=True)
def own_cache_folder(tmp_path_factory):
    """The commands run in this process: what they compile is not for the cache folder of who tests."""
    folder = tmp_path_factory.mktemp("cache") / "jaxpg"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cache_folder, "locate", lambda: folder)
        yield


def run(main, arguments, monkeypatch, capsys):
    """Exit status and standard error of a command."""
    monkeypatch.setattr(sys, "argv", ["jaxpg", *arguments])
    with pytest.raises(SystemExit) as exit_:
        run_command(main)
    return exit_.value.code, capsys.readouterr().err


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_in_training_options(mistake, monkeypatch, capsys, tmp_path):
    arguments, message = MISTAKES[mistake]
    if not arguments[0].startswith("resume="):
        arguments = [*arguments, f"run_dir={tmp_path / 'run'}"]
    status, error = run(train.main, arguments, monkeypatch, capsys)
    assert status == 2
    assert message in error
    assert error.startswith("error: ")
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "run").exists()


@pytest.fixture(scope="module")
def finished(command, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "finished"
    sizes = ("num_envs=2", "num_steps=2", "total_steps=4", "eval_episodes=2", "env.episode_length=4", "report=false")
    assert command("train", *sizes, f"run_dir={folder}").returncode == 0
    return folder


RUN_MISTAKES = {
    "folder in use": (train, ["run_dir={run}"], "is not empty: choose another run_dir, or resume="),
    "folder whose name has two lines": (train, ["run_dir={run}/a\nb"], "expected printable characters"),
    "folder with too long a name": (
        train,
        ["run_dir={run}/" + 300 * "x"],
        "cannot write a run folder there (File name",
    ),
    "folder below a file": (train, ["run_dir={run}/config.yaml/x"], "cannot write a run folder there"),
    "another environment": (train, ["resume={run}", "env=arm"], "env=arm: the run has env=pendulum"),
    "another network": (
        train,
        ["resume={run}", "network.widths=[64]"],
        "has network.widths=[32, 32], and on resume only",
    ),
    "another seed": (train, ["resume={run}", "seed=3"], "has seed=0, and on resume only"),
    "sweep of a run without one": (
        train,
        ["resume={run}", "sweep.algo.gamma=[0.9]"],
        "has no sweep.algo.gamma, and on",
    ),
    "misspelt on resume": (train, ["resume={run}", "totl_steps=9"], "did you mean 'total_steps'?"),
    "no run": (evaluate, [], "run=DIR is missing"),
    "run without its name": (evaluate, ["{run}"], "expected run={run}"),
    "run to resume without its name": (train, ["{run}"], "expected resume={run}"),
    "run with too long a name": (evaluate, ["run={run}" + 300 * "x"], "cannot be read as a run folder"),
    "run with too long a name to resume": (train, ["resume={run}" + 300 * "x"], "cannot be read as a run folder"),
    "folder that is no run": (evaluate, ["run={run}/tb"], "is not a run folder"),
    "misspelt backend": (evaluate, ["run={run}", "backend=gym"], "must be mjx or mujoco or gymnasium"),
    "misspelt evaluation option": (evaluate, ["run={run}", "episode=3"], "did you mean 'episodes'?"),
    "one episode": (evaluate, ["run={run}", "episodes=1"], "episodes=1: must be at least 2"),
    "no such agent": (evaluate, ["run={run}", "agent=1"], "agent=1: the run has one agent, 0"),
    "gymnasium with another pendulum": (
        evaluate,
        ["run={run}", "backend=gymnasium"],
        "runs of env=pendulum with its default",
    ),
}


@pytest.mark.parametrize("mistake", RUN_MISTAKES)
def test_mistakes_about_a_run(mistake, finished, monkeypatch, capsys):
    module, arguments, message = RUN_MISTAKES[mistake]
    before = tree(finished)
    status, error = run(module.main, [argument.format(run=finished) for argument in arguments], monkeypatch, capsys)
    assert status == 2
    assert message.format(run=finished) in error
    assert len(error.splitlines()) == 1
    assert tree(finished) == before


def damaged(finished, tmp_path, damage):
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    damage(folder)
    return folder


def flip_a_bit(folder):
    """In the largest file of the newest checkpoint's arrays."""
    largest = max((folder / "checkpoints").rglob("d/*"), key=lambda path: path.stat().st_size)
    content = bytearray(largest.read_bytes())
    content[len(content) // 2] ^= 1
    largest.write_bytes(content)


def edit_config(old, new):
    def damage(folder):
        path = folder / "config.yaml"
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    return damage


def other_versions(folder):
    path = folder / "versions.json"
    path.write_text(path.read_text().replace('"threads"', '"thread'))


DAMAGES = {
    "bit flipped in the arrays": (flip_a_bit, "damaged|cannot be read"),
    "checkpoints removed": (lambda folder: shutil.rmtree(folder / "checkpoints"), "no checkpoint yet"),
    "other network in config.yaml": (
        edit_config("- 32\n  - 32", "- 32\n  - 64"),
        "made with network.widths=[32, 32], but",
    ),
    "other environment in config.yaml": (edit_config("id: pendulum", "id: arm"), "unknown option"),
    "config.yaml that is no YAML": (edit_config("env:", "env: ["), "not a configuration of a run"),
    "versions.json torn": (other_versions, "cannot be read"),
    "versions.json of another kind": (
        lambda folder: (folder / "versions.json").write_text("[]"),
        "not written by a run",
    ),
    "threads in words": (
        lambda folder: (folder / "versions.json").write_text('{"threads": "two"}'),
        "not written by a run: expected an object with threads from 1 to ",
    ),
}


@pytest.mark.parametrize("kind", DAMAGES)
def test_damaged_runs_are_not_resumed(kind, finished, monkeypatch, capsys, tmp_path):
    damage, message = DAMAGES[kind]
    folder = damaged(finished, tmp_path, damage)
    status, error = run(train.main, [f"resume={folder}", "total_steps=400"], monkeypatch, capsys)
    assert status == 2
    assert any(part in error for part in message.split("|")), error
    assert "Traceback" not in error


def tear_last_line(folder):
    with (folder / "metrics.jsonl").open("a") as file:
        file.write('{"update": 2, "st')


def test_a_stray_line_in_metrics_is_cut_off(finished, monkeypatch, capsys, tmp_path):
    """A torn last line, as a kill leaves it, is no reason not to resume."""
    folder = damaged(finished, tmp_path, tear_last_line)
    status, error = run(train.main, [f"resume={folder}", "total_steps=8"], monkeypatch, capsys)
    assert (status, error) == (0, "")
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [line["update"] for line in lines] == [1, 2]


@pytest.mark.parametrize("number", [errno.EACCES, errno.ENAMETOOLONG, errno.EROFS, errno.ENOSPC, errno.ELOOP])
def test_what_is_wrong_with_a_folder_is_one_line(number, monkeypatch, capsys):
    def main(arguments):
        raise OSError(number, os.strerror(number), "/somewhere/report.html")

    status, error = run(main, [], monkeypatch, capsys)
    assert (status, error) == (2, f"error: /somewhere/report.html: {os.strerror(number)}\n")


@pytest.mark.parametrize("mistake", [FileNotFoundError(errno.ENOENT, "ours", "x"), OSError(errno.EACCES, "no file")])
def test_a_mistake_of_ours_keeps_its_traceback(mistake, monkeypatch):
    def main(arguments):
        raise mistake

    with pytest.raises(OSError, match=r"ours|no file"):
        run_command(main)
