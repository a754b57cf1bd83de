"""A run reads and writes in its own folder only, wherever it is moved, whatever is linked there, whatever its name."""

import gc
import json
import os
import shutil
import stat
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from in_process import contents, ended
from processes import RUN, bound_by_permissions, outcome, proceed, stop_after, training, tree

from jaxpg import compare, evaluate, export, inspect, report, train
from jaxpg.errors import UserError
from jaxpg.store import cache_folder, files, folder, lines, lock, run_files, versions, versions_file
from jaxpg.store.checkpoint import Checkpoints
from jaxpg.store.checkpoint_errors import CheckpointError, SaveError
from jaxpg.store.folder import RunFolder, read_metrics

SIZES = ("env=quadratic", "network=linear", "num_envs=2", "num_steps=4", "log_interval=16", "eval_interval=32")
TINY = (*SIZES, "eval_episodes=2", "env.episode_length=8", "checkpoint_interval=32", "report=false", "total_steps=96")


@pytest.fixture(scope="module", autouse=True)
def own_cache_folder(tmp_path_factory):
    """The commands run in this process: what they compile is not for the cache folder of who tests."""
    place = tmp_path_factory.mktemp("cache") / "jaxpg"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cache_folder, "locate", lambda: place)
        patch.setattr(gc, "freeze", lambda: None)  # as of a process that ends
        yield


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs that differ in the seed."""
    folders = tmp_path_factory.mktemp("runs")
    for name, seed in (("run", 0), ("other", 1)):
        status, _, error = ended(train.main, [*TINY, f"seed={seed}", f"run_dir={folders / name}"])
        assert (status, error) == (0, "")
    return folders


@pytest.fixture
def run(runs, tmp_path):
    shutil.copytree(runs / "run", tmp_path / "run")
    return tmp_path / "run"


@pytest.fixture
def outside(tmp_path):
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "file").write_text("not yours\n")
    return tmp_path / "outside"


def one_line(ending):
    """What a command says that refuses."""
    status, _, error = ending
    assert status == 2, ending
    assert error.startswith("error: ")
    assert len(error.splitlines()) == 1
    return error


def test_a_run_whose_folder_is_moved_goes_on_there(command, command_environment, tmp_path):
    """And another one that takes the old name has nothing of it."""
    undisturbed, place, away = (tmp_path / name for name in ("undisturbed", "place", "away"))
    assert command("train", *RUN, f"run_dir={undisturbed}").returncode == 0
    with training(command_environment, *RUN, f"run_dir={place}") as process:
        stop_after(process, place, 15)
        place.rename(away)
        assert command("train", *RUN, "seed=1", f"run_dir={place}").returncode == 0
        other = tree(place)
        proceed(process)
        said = process.stdout.read()
        assert process.wait() == 0, said
    assert tree(place) == other
    assert outcome(away) == outcome(undisturbed)
    assert said.count(f"note: {place} was moved: the run continues in {away}\n") == 1
    assert f"run={away}" in said
    assert (away / "learning_curve.png").stat().st_size > 1000
    assert not (away / lock.NAME).exists()


@pytest.fixture(params=["Linux", "elsewhere"])
def system(request, monkeypatch):
    """With and without paths that lead through descriptors."""
    if request.param == "elsewhere":
        monkeypatch.setattr(files, "DESCRIPTORS", "/none")
    return request.param


def test_checkpoints_are_in_the_folder_that_is_owned_or_nowhere(system, tmp_path):
    run_folder, away = RunFolder(tmp_path / "run"), tmp_path / "away"
    with folder.own(run_folder, print):
        checkpoints = Checkpoints(run_folder.checkpoints)
        checkpoints.save(1, {"x": np.arange(3.0)}, {})
        (tmp_path / "run").rename(away)
        (tmp_path / "run" / "checkpoints").mkdir(parents=True)
        if system == "Linux":
            checkpoints.save(2, {"x": np.arange(3.0)}, {})
            assert run_folder.path == away
        else:
            with pytest.raises(SaveError, match="the folder was moved or removed"):
                checkpoints.save(2, {"x": np.arange(3.0)}, {})
        run_files.replace(run_folder.report, "page")
    assert tree(tmp_path / "run") == {}
    assert (away / "report.html").read_text() == "page"
    assert Checkpoints(away / "checkpoints", read_only=True).numbers() == ([2, 1] if system == "Linux" else [1])


# What a run writes, and how it ends where that is a link to somewhere else.
WRITTEN = {
    "report.html": 0,
    "learning_curve.png": 0,
    "report.html.unfinished": 0,
    "metrics.jsonl.unfinished": 0,
    "tb": 0,
    "metrics.jsonl": 2,
    "config.yaml": 2,
    "versions.json": 2,
    "lock": 2,
    "checkpoints": 2,
    "checkpoints/12": 2,
    "checkpoints/16.orbax-checkpoint-tmp": 2,
    "best": 2,
    "best/12": 2,
}


@pytest.mark.parametrize("target", ["copy", "missing"])
@pytest.mark.parametrize("name", WRITTEN)
def test_a_run_that_goes_on_follows_no_link(run, outside, name, target):
    path, copy = run / name, outside / target
    if path.is_dir() and target == "copy":
        shutil.copytree(path, copy)
    elif target == "copy":
        copy.write_bytes(path.read_bytes() if path.exists() else b"")
    if path.exists():
        (shutil.rmtree if path.is_dir() else os.unlink)(path)
    path.symlink_to(copy)
    before = contents(outside)
    ending = ended(train.main, [f"resume={run}", "total_steps=128", "report=true"])
    assert contents(outside) == before
    assert ending[0] == WRITTEN[name], ending
    if ending[0]:
        assert "it is a link, and a run folder must not contain links" in one_line(ending)
    else:
        assert ending[2] == ""


@pytest.mark.parametrize("name", ["export", "export/policy.c"])
def test_an_export_into_the_run_folder_follows_no_link(run, outside, name):
    (run / name).parent.mkdir(exist_ok=True)
    (run / name).symlink_to(outside if name == "export" else outside / "file")
    before = contents(outside)
    ended(export.main, [f"run={run}", "format=c"])
    assert contents(outside) == before


def test_a_file_is_replaced_whole_and_leaves_nothing_else(tmp_path, outside):
    for content in ("text", b"bytes\xff", "a name that is no text: \udcff"):
        (tmp_path / "file").unlink(missing_ok=True)
        (tmp_path / "file").symlink_to(outside / "file")
        run_files.replace(tmp_path / "file", content)
        assert not (tmp_path / "file").is_symlink()
    assert (tmp_path / "file").read_text() == "a name that is no text: \\udcff"
    assert (outside / "file").read_text() == "not yours\n"
    with pytest.raises(UserError, match=r"outside: cannot be written \(Is a directory\)"):
        run_files.replace(outside, "text")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "outside"]
    mask = os.umask(0)
    os.umask(mask)
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o666 & ~mask


ODD_NAMES = ("back\\slash", "a[b]", "*?", "100 % #1 ~ ", "$HOME ${x}", "s3:", "épée", "'\"", "a" * 255)


@pytest.mark.parametrize("name", ODD_NAMES)
def test_a_folder_may_have_any_name_that_can_be_printed(tmp_path, name):
    checkpoints = Checkpoints(tmp_path / name)
    checkpoints.save(1, {"x": np.arange(3.0)}, {})
    checkpoints.replace(1, {"x": np.arange(4.0)}, {})
    assert Checkpoints(tmp_path / name, read_only=True).read(1)["x"].tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("name", ["back\\slash [1]*", "100 % ~"])
def test_a_run_may_have_any_name_that_can_be_printed(tmp_path, name):
    """And is trained, shown, judged and resumed there."""
    run = tmp_path / name
    assert ended(train.main, [*TINY, f"run_dir={run}"])[::2] == (0, "")
    assert ended(train.main, [f"resume={run}", "total_steps=128", "report=true"])[::2] == (0, "")
    status, out, _ = ended(inspect.main, [f"run={run}", "json=true"])
    assert (status, json.loads(out)["step"]) == (0, 16)
    assert all(checkpoint["sound"] for checkpoint in json.loads(out)["checkpoints"])
    assert ended(evaluate.main, [f"run={run}", "episodes=2"])[0] == 0
    assert not (tmp_path / "100").exists()


@pytest.mark.parametrize("name", ["two\nlines", "tab\t", "latin-1 \udce9", "bell\a"])
def test_a_name_that_cannot_be_printed_is_refused(tmp_path, name):
    assert "expected printable characters" in one_line(ended(train.main, [*TINY, f"run_dir={tmp_path / name}"]))
    assert list(tmp_path.iterdir()) == []


def test_elsewhere_names_that_orbax_takes_for_patterns_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "DESCRIPTORS", "/none")
    for name in ("back\\slash", "a[b]", "a*"):
        assert "checkpoints cannot be kept" in one_line(ended(train.main, [*TINY, f"run_dir={tmp_path / name}"]))
    assert list(tmp_path.iterdir()) == []


def change_config(run, old, new):
    text = (run / "config.yaml").read_text()
    assert old in text
    (run / "config.yaml").write_text(text.replace(old, new))


def take_of(runs, run, name):
    shutil.rmtree(run / name)
    shutil.copytree(runs / "other" / name, run / name)


FOREIGN = {
    "seed": (
        lambda runs, run: change_config(run, "seed: 0", "seed: 3"),
        "made with seed=0, but config.yaml has seed=3",
    ),
    "gamma": (lambda runs, run: change_config(run, "gamma: ", "gamma: 0.5 # "), "but config.yaml has algo.gamma=0.5"),
    "checkpoints": (
        lambda runs, run: [take_of(runs, run, name) for name in ("checkpoints", "best")],
        "made with seed=1",
    ),
}
READERS = {
    "resume": (train, ["resume={run}", "total_steps=128"]),
    "resume=auto": (train, [*TINY[:-1], "total_steps=128", "run_dir={run}", "resume=auto"]),
    "evaluate": (evaluate, ["run={run}", "episodes=2"]),
    "export": (export, ["run={run}", "format=c"]),
    "report": (report, ["run={run}"]),
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("kind", FOREIGN)
def test_checkpoints_of_another_run_are_refused_by_name(runs, run, kind, reader):
    spoil, message = FOREIGN[kind]
    spoil(runs, run)
    before = tree(run)
    module, arguments = READERS[reader]
    error = one_line(ended(module.main, [argument.format(run=run) for argument in arguments]))
    if reader != "resume=auto" or kind == "checkpoints":  # which compares what is asked for with config.yaml first
        assert message in error
    assert tree(run) == before


def test_an_inspection_names_checkpoints_of_another_run(runs, run):
    shutil.copytree(runs / "other" / "checkpoints" / "12", run / "checkpoints" / "16")
    shutil.rmtree(run / "checkpoints" / "12")
    shutil.copytree(runs / "other" / "checkpoints" / "12", run / "checkpoints" / "12")
    status, out, _ = ended(inspect.main, [f"run={run}"])
    assert status == 0
    assert "16 damaged, 12 of another run, 8 sound, 4 sound" in out
    assert "of another run: " in out


def test_options_that_may_change_make_no_other_run(run):
    for options in (["total_steps=128", "log_interval=8", "checkpoint_interval=16"], ["total_steps=160"]):
        assert ended(train.main, [f"resume={run}", *options])[::2] == (0, "")
    assert ended(evaluate.main, [f"run={run}", "episodes=2", "checkpoint=last"])[0] == 0


def test_a_record_with_another_configuration_is_damaged(tmp_path):
    """What a flipped bit makes of it is no other run."""
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, {"x": np.ones(2)}, {"config": {"seed": 1}})
    (path,) = (tmp_path / "1" / "meta").glob("meta*")
    path.write_text(path.read_text().replace('"seed": 1', '"seed": 3'))
    with pytest.raises(CheckpointError, match="damaged, its record differs from what was saved"):
        Checkpoints(tmp_path).read(1)


def line_at(update):
    return {"update": update, "steps": 8 * update, "return": [1.5, None], "eval_return": [0.25, 2e300], "seconds": 0.5}


texts = st.text(st.characters(exclude_characters="\n"))
values = st.recursive(st.none() | st.booleans() | st.floats() | st.integers() | texts, st.lists, max_leaves=3)
objects = st.dictionaries(st.sampled_from(list(line_at(1))), values).map(json.dumps)


@given(st.integers(3, 12), st.data())
def test_a_damaged_line_costs_no_other(number, data):
    written = [line_at(update) for update in range(1, number + 1)]
    texts_written = [lines.format_line(line) for line in written]
    at = data.draw(st.integers(0, number - 1))
    texts_written[at] = data.draw(texts | objects) + "\n"
    found, damaged = lines.parse_lines("".join(texts_written))
    assert [line for line in found if line["update"] != at + 1] == written[:at] + written[at + 1 :]
    assert damaged in ([], [at + 1])


@given(st.integers(1, 5), st.integers(0, 200))
def test_a_torn_last_line_is_not_damaged(number, cut):
    whole = "".join(lines.format_line(line_at(update)) for update in range(1, number + 1))
    torn = lines.format_line(line_at(number + 1))[:cut]
    found, damaged = lines.parse_lines(whole + torn)
    assert (found[:number], damaged) == ([line_at(update) for update in range(1, number + 1)], [])


def test_a_run_that_goes_on_keeps_the_lines_after_a_damaged_one(run):
    path = run / "metrics.jsonl"
    before = path.read_text().splitlines()
    path.write_text("\n".join([before[0], before[1][:-9], *before[2:]]) + "\n")
    status, out, error = ended(train.main, [f"resume={run}", "total_steps=128"])
    assert (status, error) == (0, "")
    assert f"note: {path}: line 2 is damaged and dropped; the others are kept" in out
    assert path.read_text().splitlines()[:5] == [before[0], *before[2:]]
    assert [line["update"] for line in read_metrics(RunFolder(run))] == [2, 6, 8, 10, 12, 14, 16]


def not_a_file(path):
    path.unlink()
    path.mkdir()


def looped_link(path):
    path.unlink()
    path.symlink_to(path)


DAMAGES = {
    "a number": lambda path: path.write_text("5"),
    "bytes": lambda path: path.write_bytes(bytes(range(128, 256))),
    "a folder": not_a_file,
    "a looped link": looped_link,
    "a pipe": lambda path: (path.unlink(), os.mkfifo(path)),
    "nothing": lambda path: path.write_text(""),
    "a deep list": lambda path: path.write_text("[" * 5000),
    "earlier versions that are none": lambda path: path.write_text('{"threads": 1, "jaxlib": "0", "earlier": 5}'),
    "earlier versions in words": lambda path: path.write_text('{"threads": 1, "jaxlib": "0", "earlier": ["old"]}'),
    "too many threads": lambda path: path.write_text(f'{{"threads": {versions_file.MAX_THREADS + 1}, "jaxlib": "0"}}'),
}
COMMANDS = READERS | {"inspect": (inspect, ["run={run}"]), "compare": (compare, ["{run}", "out={run}/page.html"])}


@pytest.mark.parametrize("reader", ["resume", "inspect", "report", "compare"])
@pytest.mark.parametrize("kind", DAMAGES)
@pytest.mark.parametrize("name", ["metrics.jsonl", "versions.json", "config.yaml"])
def test_what_is_in_place_of_a_file_is_said_in_one_line(run, name, kind, reader):
    DAMAGES[kind](run / name)
    module, arguments = COMMANDS[reader]
    ending = ended(module.main, [argument.format(run=run) for argument in arguments])
    if ending[0] == 0:  # it does without
        assert ending[2] == ""
    else:
        assert (name if reader != "compare" else "") in one_line(ending)


@pytest.mark.parametrize("reader", COMMANDS)
def test_a_run_in_a_later_format_is_refused_in_one_line(run, reader):
    recorded = json.loads((run / "versions.json").read_text())
    assert recorded["format"] == versions_file.FORMAT
    (run / "versions.json").write_text(json.dumps(recorded | {"format": versions_file.FORMAT + 1}))
    module, arguments = COMMANDS[reader]
    error = one_line(ended(module.main, [argument.format(run=run) for argument in arguments]))
    assert (
        f"written by a later jaxpg (format {versions_file.FORMAT + 1}; this one reads up to {versions_file.FORMAT})"
        in error
    )


@pytest.mark.parametrize("name", ["config.yaml", "versions.json", "metrics.jsonl", "checkpoints", "best", "."])
def test_what_may_not_be_read_is_said_in_one_line(command_environment, run, name):
    os.chmod(run / name, 0)
    arguments = [sys.executable, "-m", "jaxpg.train", f"resume={run}", "total_steps=128"]
    result = subprocess.run(
        [*bound_by_permissions(), *arguments], env=command_environment, capture_output=True, text=True, check=False
    )
    assert result.returncode == 2, result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert "Permission denied" in result.stderr


def test_versions_name_the_commit_of_a_checkout(tmp_path, monkeypatch):
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    (tmp_path / "jaxpg" / "run").mkdir(parents=True)
    module = tmp_path / "jaxpg" / "run" / "versions.py"
    module.write_text("")
    monkeypatch.setattr(versions, "__file__", str(module))
    assert versions.find_commit() is None
    for arguments in (["init", "-q"], ["add", "."], ["commit", "-qm", "first"]):
        subprocess.run([*git, *arguments], check=True)
    head = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()
    assert versions.find_commit() == head
    module.write_text("x = 1\n")
    assert versions.find_commit() == f"{head}-dirty"
    monkeypatch.setenv("PATH", "")
    assert versions.find_commit() is None


def test_another_commit_is_noted_and_not_as_other_bits(run):
    recorded = json.loads((run / "versions.json").read_text())
    assert recorded["jaxpg"] == "0.1.0"
    (run / "versions.json").write_text(json.dumps(recorded | {"commit": "0123abc"}))
    status, out, _ = ended(train.main, [f"resume={run}", "total_steps=128"])
    assert status == 0
    assert "note: commit was 0123abc and is " in out
    assert "not the same bits" not in out
    assert json.loads((run / "versions.json").read_text())["earlier"] == [recorded | {"commit": "0123abc"}]
    for name in ("format", "jaxpg", "commit", "earlier"):  # as a run of earlier days
        recorded.pop(name, None)
    (run / "versions.json").write_text(json.dumps(recorded))
    assert "commit was" not in ended(train.main, [f"resume={run}", "total_steps=160"])[1]
