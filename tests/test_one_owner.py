"""Who trains in a run folder, and how the same command begins a run or goes on with it."""

import fcntl
import json
import os
import platform
import shutil
import signal
from pathlib import Path

import pytest
from processes import LINES, RUN, outcome, stop_after, training, tree

from jaxpg import train
from jaxpg.errors import UserError
from jaxpg.store import lock

FIRST_CHECKPOINT = 10  # lines of metrics before it


@pytest.fixture(scope="module")
def undisturbed(command, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "undisturbed"
    assert command("train", *RUN, f"run_dir={folder}").returncode == 0
    return folder


@pytest.fixture(scope="module")
def killed(command_environment, tmp_path_factory):
    """Runs that were killed: before their first checkpoint, and after it."""
    folders = tmp_path_factory.mktemp("killed")
    rarely = [option for option in RUN if not option.startswith("checkpoint_interval=")]
    for name, options, lines in (("early", rarely, 2), ("late", RUN, FIRST_CHECKPOINT + 5)):
        with training(command_environment, *options, f"run_dir={folders / name}") as process:
            stop_after(process, folders / name, lines)
            process.kill()
    return folders


def test_a_run_in_use_has_one_owner(command, command_environment, tmp_path):
    """A second one is told who it is and changes nothing; others may look; the lock dies with its owner."""
    folder = tmp_path / "run"
    with training(command_environment, *RUN, f"run_dir={folder}") as process:
        stop_after(process, folder, FIRST_CHECKPOINT + 5)
        before, name = tree(folder), f"process {process.pid} on {platform.node()}"
        for arguments in ([f"run_dir={folder}"], [f"resume={folder}"], [*RUN, f"run_dir={folder}", "resume=auto"]):
            result = command("train", *arguments)
            assert (result.returncode, result.stdout) == (2, "")
            assert result.stderr == f"error: {folder} is in use by {name}, which is training in it\n"
        assert f"now, by {name}" in command("inspect", f"run={folder}").stdout
        assert tree(folder) == before
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert json.loads(command("inspect", f"run={folder}", "json=true").stdout)["owner"] is None
    assert command("train", f"resume={folder}").returncode == 0
    assert not (folder / lock.NAME).exists()


def test_without_locks_there_is_a_note(monkeypatch, tmp_path):
    def unsupported(*_):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", unsupported)
    notes = []
    with lock.hold(tmp_path, notes.append):
        assert len(notes) == 1
        assert "cannot be locked (Operation not supported)" in notes[0]
        assert lock.find_owner(tmp_path) is None


def test_a_look_at_the_owner_keeps_nobody_from_becoming_it(tmp_path):
    """It has the lock for a moment; a process that wants it waits that long."""
    path = tmp_path / lock.NAME
    path.touch()
    descriptor = os.open(path, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_SH)
    with pytest.raises(UserError, match="is in use by another process"), lock.hold(tmp_path, print):
        pass
    os.close(descriptor)
    with lock.hold(tmp_path, print):
        assert lock.find_owner(tmp_path) == f"process {os.getpid()} on {platform.node()}"


@pytest.mark.parametrize(
    ("state", "says"),
    [("none", "into"), ("empty", "into"), ("early", "into"), ("late", "resuming"), ("finished", "is")],
)
def test_the_same_command_begins_goes_on_or_is_finished(command, killed, undisturbed, tmp_path, state, says):
    """And ends with the bits of a run that was never stopped."""
    folder = tmp_path / "run"
    if state == "empty":
        folder.mkdir()
    elif state != "none":
        shutil.copytree(undisturbed if state == "finished" else killed / state, folder)
    result = command("train", *RUN, f"run_dir={folder}", "resume=auto")
    assert (result.returncode, result.stderr) == (0, "")
    assert f"{says} finished" in result.stdout if state == "finished" else says in result.stdout.splitlines()[0]
    assert outcome(folder) == outcome(undisturbed)


def test_options_that_may_change_on_resume_apply(command, killed, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(killed / "late", folder)
    longer = [f"total_steps={16 * LINES + 160}" if "total_steps" in option else option for option in RUN]
    result = command("train", *longer, f"run_dir={folder}", "resume=auto")
    assert result.returncode == 0, result.stderr
    assert len(outcome(folder)[0]) == LINES + 10


DIFFERENCES = {
    "another value": (["seed=3"], "seed=3: .* has seed=0, and on resume only"),
    "another environment": (["env=pendulum"], "env=pendulum: .* has env=quadratic, and on resume only"),
    "a value that is left out": (["env.episode_length"], "has env.episode_length=8, and on resume only"),
    "a sweep": (["sweep.algo.gamma=[0.5,0.9]"], r"gamma=\[0.5, 0.9\]: .* has no sweep.algo.gamma, and on resume only"),
}


@pytest.mark.parametrize("difference", DIFFERENCES)
def test_other_differences_are_refused_by_name(killed, difference):
    changes, message = DIFFERENCES[difference]
    before = tree(killed / "late")
    names = [change.partition("=")[0] for change in changes]
    options = [option for option in RUN if option.partition("=")[0] not in names]
    with pytest.raises(UserError, match=message):
        train.main(
            [*options, *(change for change in changes if "=" in change), f"run_dir={killed / 'late'}", "resume=auto"]
        )
    before.pop(Path(lock.NAME), None)  # of the process that was killed
    assert tree(killed / "late") == before


def test_a_sweep_that_is_left_out_is_another_run(killed, tmp_path):
    shutil.copytree(killed / "late", tmp_path / "run")
    path = tmp_path / "run" / "config.yaml"
    path.write_text(path.read_text().replace("sweep: {}", "sweep:\n  algo.gamma: [0.5, 0.9]"))
    message = r"no sweep.algo.gamma: .* has sweep.algo.gamma=\[0.5, 0.9\], and on resume only"
    with pytest.raises(UserError, match=message):
        train.main([*RUN, f"run_dir={tmp_path / 'run'}", "resume=auto"])


def test_auto_needs_a_folder():
    with pytest.raises(UserError, match="resume=auto needs run_dir=DIR"):
        train.main([*RUN, "resume=auto"])


FOREIGN = {
    "somebody's notes": {"notes.txt": ""},
    "a configuration of another program": {"config.yaml": "env: {}", "tb/events": ""},
    "a best policy without checkpoints": {"versions.json": '{"jaxlib": "0.10.1"}', "best/7/meta": ""},
}


@pytest.mark.parametrize("content", FOREIGN)
def test_a_folder_with_something_else_is_refused(tmp_path, content):
    for name, text in FOREIGN[content].items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    before = tree(tmp_path)
    with pytest.raises(UserError, match="is not empty"):
        train.main([*RUN, f"run_dir={tmp_path}", "resume=auto"])
    assert tree(tmp_path) == before
