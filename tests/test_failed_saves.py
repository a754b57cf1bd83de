"""A disk that is full, read-only or gone for a while does not end a run, and no bit is lost where it comes back."""

import json
import os
import shutil

import numpy as np
import pytest
from processes import LINES, RUN, bound_by_permissions, mounted, outcome, output_until, proceed, stop_after, training

from jaxpg.store.checkpoint import Checkpoints
from jaxpg.store.checkpoint_errors import SaveError
from jaxpg.store.folder import RunFolder, read_metrics
from jaxpg.store.metrics_log import MetricsLog

SAVE_FAILED = "training continues, and saving is tried again at each line of metrics"
LOST = "could not be saved; resume="


@pytest.fixture(scope="module")
def undisturbed(command, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "undisturbed"
    assert command("train", *RUN, f"run_dir={folder}").returncode == 0
    return outcome(folder)


@pytest.fixture
def disk(tmp_path):
    """A file system of 2 MB."""
    (tmp_path / "disk").mkdir()
    with mounted("-t", "tmpfs", "-o", "size=2m", "tmpfs", tmp_path / "disk") as folder:
        yield folder


def fill(disk):
    """Leaves not a block free."""
    space = os.statvfs(disk)
    (disk / "ballast").write_bytes(bytes(space.f_bsize * space.f_bavail))


def test_a_full_disk_that_is_emptied_leaves_no_trace(command_environment, disk, undisturbed):
    """Each failure is said in one line, and metrics and state are those of the run that had space."""
    folder = disk / "run"
    with training(command_environment, *RUN, f"run_dir={folder}") as process:
        stop_after(process, folder, 15)
        fill(disk)
        proceed(process)
        said = output_until(process, SAVE_FAILED, "lines are kept until it can")
        stop_after(process, folder, 15)
        (disk / "ballast").unlink()
        proceed(process)
        said += process.stdout.read()
        assert process.wait() == 0, said
    assert said.count("No space left on device") == said.count("note: ") - 1
    assert said.count(SAVE_FAILED) == said.count("note: saving works again, after ") == 1
    assert "Traceback" not in said
    assert outcome(folder) == undisturbed


def test_a_disk_that_stays_full_is_status_5(command, command_environment, disk, undisturbed):
    """What was saved before is sound, and resumed with space it ends with the bits of the run that had it always."""
    folder = disk / "run"
    with training(command_environment, *RUN, f"run_dir={folder}") as process:
        stop_after(process, folder, 15)
        fill(disk)
        proceed(process)
        said = process.stdout.read()
        assert process.wait() == 5, said
    assert said.count(SAVE_FAILED) == said.count(LOST) == 1
    assert said.endswith(f"error: the last state, at {16 * LINES:,} steps, {LOST}{folder} repeats the lost updates\n")
    assert "Traceback" not in said
    (disk / "ballast").unlink()
    found = json.loads(command("inspect", f"run={folder}", "json=true").stdout)
    assert all(checkpoint["sound"] for checkpoint in found["checkpoints"])
    assert 0 < found["step"] < 2 * LINES
    result = command("train", f"resume={folder}")
    assert result.returncode == 0, result.stderr
    assert outcome(folder) == undisturbed


def test_a_folder_that_became_read_only(command_environment, tmp_path, undisturbed):
    """And writable again."""
    folder = tmp_path / "run"
    with training(command_environment, *RUN, f"run_dir={folder}", by=bound_by_permissions()) as process:
        stop_after(process, folder, 15)
        (folder / "checkpoints").chmod(0o555)
        proceed(process)
        said = output_until(process, SAVE_FAILED)
        (folder / "checkpoints").chmod(0o755)
        said += process.stdout.read()
        assert process.wait() == 0, said
    assert "checkpoints/" in said
    assert "Permission denied" in said
    assert "Traceback" not in said
    assert outcome(folder) == undisturbed


def test_a_folder_that_was_removed_is_not_made_again(command_environment, tmp_path):
    folder = tmp_path / "run"
    with training(command_environment, *RUN, f"run_dir={folder}") as process:
        stop_after(process, folder, 15)
        shutil.rmtree(folder)
        proceed(process)
        said = process.stdout.read()
        assert process.wait() == 5, said
    assert said.count("No such file or directory") >= 1
    assert said.count(LOST) == 1
    assert "Traceback" not in said
    assert not folder.exists()


def test_there_is_no_checkpoint_without_its_lines_of_metrics(command, command_environment, tmp_path, undisturbed):
    """A run that goes on from it would have a gap in them."""
    folder = tmp_path / "run"
    with training(command_environment, *RUN, f"run_dir={folder}") as process:
        stop_after(process, folder, 15)
        (folder / "metrics.jsonl").rename(folder / "moved")
        proceed(process)
        said = process.stdout.read()
        assert process.wait() == 5, said
    assert said.count("not written, as its lines of metrics cannot be (No such file or directory)") == 1
    (folder / "moved").rename(folder / "metrics.jsonl")
    assert command("train", f"resume={folder}").returncode == 0
    assert outcome(folder) == undisturbed


LINE = {"update": 1, "steps": 8, "return": 0.5, "seconds": 0.1}


def test_what_a_failure_leaves_of_a_line_is_cut_off(tmp_path):
    run_folder = RunFolder(tmp_path)
    log = MetricsLog(run_folder, 0, print)
    log.write(LINE)
    with run_folder.metrics.open("a") as file:
        file.write('{"update": 2, "steps": 16, "return": null, "episodes": 0, "sec')
    log.write({**LINE, "update": 2})
    log.close()
    lines = [LINE, {**LINE, "update": 2}]
    assert run_folder.metrics.read_text() == "".join(json.dumps(line) + "\n" for line in lines)


def test_a_kill_while_metrics_are_taken_back_loses_none(monkeypatch, tmp_path):
    run_folder = RunFolder(tmp_path)
    log = MetricsLog(run_folder, 0, print)
    log.write(LINE)
    log.close()

    def killed(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", killed)
    with pytest.raises(KeyboardInterrupt):
        MetricsLog(run_folder, 1, print)
    assert read_metrics(run_folder) == [LINE]


def test_tensorboard_is_given_up_with_one_note(tmp_path):
    (tmp_path / "tb").touch()
    notes = []
    log = MetricsLog(RunFolder(tmp_path), 0, notes.append)
    log.write(LINE)
    log.write({**LINE, "update": 2})
    log.close()
    assert len(notes) == 1
    assert f"{tmp_path / 'tb'}: cannot be written (File exists)" in notes[0]


def test_checkpoints_of_a_run_that_is_gone_are_not_kept_elsewhere(tmp_path):
    (tmp_path / "run").mkdir()
    checkpoints = Checkpoints(tmp_path / "run" / "checkpoints")
    shutil.rmtree(tmp_path / "run")
    with pytest.raises(SaveError, match=r"checkpoints/1: cannot be written \(No such file or directory\)"):
        checkpoints.save(1, {"x": np.ones(2)}, {})
    assert not (tmp_path / "run").exists()
    (tmp_path / "run").mkdir()
    checkpoints.save(1, {"x": np.ones(2)}, {})
    assert checkpoints.newest_sound() == (1, [])


def test_a_checkpoint_is_on_the_disk_before_its_save_returns(tmp_path, monkeypatch):
    """Every file and folder of it, and the folder that has its name."""
    synchronized, fsync = set(), os.fsync

    def note(descriptor):
        synchronized.add(os.readlink(f"/proc/self/fd/{descriptor}"))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", note)
    Checkpoints(tmp_path).save(3, {"x": np.arange(4.0)}, {})
    there = {str(path) for path in (tmp_path / "3").rglob("*")} | {str(tmp_path / "3"), str(tmp_path)}
    assert len(there) > 5
    assert there <= synchronized
