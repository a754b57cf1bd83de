"""A run folder that is damaged in any way, or has something else in place of a file: each command does what is right.

It ends with the bits of the run that was not damaged, or with one line and status 2; and nothing outside the folder is
touched. `pytest -m faults tests/faults/test_folders.py` tries five hundred.
"""

import gc
import os
import shutil
import socket
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from in_process import contents, ended

from jaxpg import compare, evaluate, export, inspect, report, train
from jaxpg.config import configuration
from jaxpg.store import cache_folder, config_file
from jaxpg.store.checkpoint import Checkpoints
from jaxpg.store.folder import RunFolder, read_metrics

FEW, MANY = 12, 500
SIZES = ("env=quadratic", "network=linear", "num_envs=2", "num_steps=4", "log_interval=16", "eval_interval=32")
RUN = (*SIZES, "eval_episodes=2", "env.episode_length=8", "checkpoint_interval=32", "report=false", "total_steps=128")
LAST = 128 // 8  # updates
COMMANDS = {
    "resume": (train, ["resume={run}"]),
    "begin or resume": (train, [*RUN, "run_dir={run}", "resume=auto"]),
    "inspect": (inspect, ["run={run}"]),
    "evaluate": (evaluate, ["run={run}", "episodes=2", "checkpoint=last"]),
    "report": (report, ["run={run}"]),
    "compare": (compare, ["{run}", "out={run}/page.html"]),
    "export": (export, ["run={run}"]),
}
KINDS = ("flip", "scramble", "truncate", "empty", "remove", "of another run", "unreadable", "folder", "file")
KINDS += ("link to a copy", "link to a file", "link to a folder", "dangling link", "looped link")
OUTPUTS = ("lock", "report.html", "page.html", "learning_curve.png", "export", "export/policy.c", "loggers")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A run that was killed before its last checkpoint, another one, and the first as it ends undamaged."""
    folders = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cache_folder, "locate", lambda: folders / "cache" / "jaxpg")
        patch.setattr(gc, "freeze", lambda: None)  # as of a process that ends
        for name, seed in (("undisturbed", 0), ("other", 1)):
            status, _, error = ended(train.main, [*RUN, f"seed={seed}", f"run_dir={folders / name}"])
            assert status == 0, error
        shutil.copytree(folders / "undisturbed", folders / "run")
        for name in ("run", "other"):
            shutil.rmtree(folders / name / "checkpoints" / str(LAST))
        yield folders


def digest(run):
    return Checkpoints(run / "checkpoints", read_only=True).digest(LAST)


def damage(path, kind, position, other, outside):
    """Damages what is at `path`, or puts something else there.

    Args:
      path: a file or folder of a run, or the name of one that there could be.
      kind: of `KINDS`.
      position: in [0, 1), where in the file.
      other: the same of another run.
      outside: a folder that nobody may touch.
    """
    if kind in ("flip", "scramble", "truncate", "empty"):
        if path.is_file():
            path.write_bytes(altered(path.read_bytes(), kind, position))
        return
    copy = Path(tempfile.mkdtemp(dir=outside), path.name)
    make_copy(path, copy)
    remove(path)
    if kind == "of another run":
        make_copy(other, path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "file":
        path.write_text("5")
    elif kind == "unreadable":
        make_unreadable(path)
    elif "link" in kind:
        targets = {"link to a copy": copy, "link to a file": outside / "file", "link to a folder": outside / "folder"}
        path.symlink_to(targets.get(kind, outside / "missing" if kind == "dangling link" else path))


def make_copy(path, to):
    """Of a file or folder, if there is one; but for what damages before have made unreadable."""
    if path.is_dir():
        shutil.copytree(path, to, symlinks=True, ignore=lambda at, names: [x for x in names if Path(at, x).is_socket()])
    elif path.is_file():
        shutil.copyfile(path, to)


def is_own(path, run):
    """Whether the damages before have left it, or its place, in the folder."""
    parents = [parent for parent in path.parents if run in parent.parents]
    return not path.is_symlink() and all(parent.is_dir() and not parent.is_symlink() for parent in parents)


def altered(content, kind, position):
    at = int(position * len(content))
    if kind == "flip":
        return content[:at] + bytes(byte ^ 1 << at % 8 for byte in content[at : at + 1]) + content[at + 1 :]
    if kind == "scramble":
        return content[:at] + bytes(byte ^ 165 for byte in content[at : at + 64]) + content[at + 64 :]
    return content[: at if kind == "truncate" else 0]


def remove(path):
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def make_unreadable(path):
    """What cannot be opened, by root neither."""
    here = os.getcwd()
    os.chdir(path.parent)  # a socket's name must be short
    try:
        with socket.socket(socket.AF_UNIX) as unbound:
            unbound.bind(path.name)
    finally:
        os.chdir(here)


def is_right(runs, run, command, status, output, error):
    """Whether a command has ended as it may."""
    assert "Traceback" not in output + error
    if status == 2:
        assert error.startswith("error: "), error
        assert len(error.splitlines()) == 1, error
        return
    assert (status, error) == (0, ""), error
    if command in ("resume", "begin or resume"):
        config, usual = (
            configuration.to_arguments(config_file.load(path / "config.yaml")) for path in (run, runs / "undisturbed")
        )
        if config | {"run_dir": None} == usual | {"run_dir": None}:  # else another interval, say, which may change
            assert digest(run) == digest(runs / "undisturbed")
        assert [line["update"] for line in read_metrics(RunFolder(run))][-1] == LAST


def try_one(runs, damages, command):
    with tempfile.TemporaryDirectory() as place:
        run, outside = Path(place, "run"), Path(place, "outside")
        shutil.copytree(runs / "run", run)
        (outside / "folder").mkdir(parents=True)
        for name in ("file", "folder/file"):
            (outside / name).write_text("not yours\n")
        for name, kind, position in damages:
            if is_own(run / name, run):
                damage(run / name, kind, position, runs / "other" / name, outside)
        before = contents(outside)
        module, arguments = COMMANDS[command]
        ending = ended(module.main, [argument.format(run=run) for argument in arguments])
        assert contents(outside) == before
        is_right(runs, run, command, *ending)


def names(runs):
    """What can be damaged, by name: all files and folders of the run, and what a command may write."""
    found = sorted(str(path.relative_to(runs / "run")) for path in (runs / "run").rglob("*"))
    top = [name for name in found if name.count("/") < 2]
    return sorted({*top, *OUTPUTS}), found


def damaged_at_random(runs, data):
    top, every = names(runs)
    name = st.one_of(st.sampled_from(top), st.sampled_from(every))
    one = st.tuples(name, st.sampled_from(KINDS), st.floats(0, 1, exclude_max=True))
    damages = data.draw(st.lists(one, min_size=1, max_size=2), label="damages")
    try_one(runs, damages, data.draw(st.sampled_from(list(COMMANDS)), label="command"))


FUZZ = {"deadline": None, "derandomize": True, "database": None, "suppress_health_check": list(HealthCheck)}


@settings(max_examples=FEW, **FUZZ)
@given(data=st.data())
def test_a_few_folders(runs, data):
    damaged_at_random(runs, data)


@pytest.mark.faults
@settings(max_examples=MANY, **FUZZ)
@given(data=st.data())
def test_many_folders(runs, data):
    damaged_at_random(runs, data)
