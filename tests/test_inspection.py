"""What is said of a run; and which checkpoint a resumed run takes where some are damaged."""

import json
import re
import shutil

import pytest

SIZES = ("env=quadratic", "network=linear", "num_envs=2", "num_steps=4", "log_interval=16", "eval_interval=32")
TINY = (*SIZES, "eval_episodes=2", "env.episode_length=8", "checkpoint_interval=32")


@pytest.fixture(scope="module")
def runs(command, tmp_path_factory):
    """A run of 96 steps with a checkpoint every 32, and the same one 32 steps longer."""
    folder = tmp_path_factory.mktemp("runs")
    assert command("train", *TINY, "total_steps=96", f"run_dir={folder / 'run'}").returncode == 0
    shutil.copytree(folder / "run", folder / "longer")
    assert command("train", f"resume={folder / 'longer'}", "total_steps=128").returncode == 0
    return folder


def inspected(command, folder):
    result = command("inspect", f"run={folder}", "json=true")
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    return json.loads(result.stdout)


def damage(folder, number):
    """One bit of every file of a checkpoint's arrays: which of them are read is orbax's choice."""
    for path in (folder / "checkpoints" / str(number)).rglob("d/*"):
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)


def test_a_finished_run(runs, command):
    found = inspected(command, runs / "run")
    assert found["finished"]
    assert (found["step"], found["steps"]) == (12, 96)
    assert found["checkpoints"] == [{"step": number, "sound": True} for number in (12, 8, 4)]
    assert found["digest"] != inspected(command, runs / "longer")["digest"]
    text = command("inspect", f"run={runs / 'run'}").stdout
    for words in ("td on quadratic, seed 0", "96 of 96 steps, finished", "12 sound, 8 sound, 4 sound", found["digest"]):
        assert words in text
    assert "unchanged" in text


def test_other_versions_are_named(runs, command, tmp_path):
    shutil.copytree(runs / "run", tmp_path / "run")
    path = tmp_path / "run" / "versions.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"jax": "0.0.1"}))
    assert "jax was 0.0.1 and is " in command("inspect", f"run={tmp_path / 'run'}").stdout


def test_versions_that_computed_a_part_of_a_run_stay_on_record(runs, command, tmp_path):
    """After it has gone on with others, and so the way back to the first ones is noted, too."""
    folder = tmp_path / "run"
    shutil.copytree(runs / "run", folder)
    path = folder / "versions.json"
    now = json.loads(path.read_text())
    path.write_text(json.dumps(now | {"jax": "0.0.1"}))
    result = command("train", f"resume={folder}", "total_steps=128")
    assert f"note: jax was 0.0.1 and is {now['jax']}: the same run, but not the same bits" in result.stdout
    assert json.loads(path.read_text()) == now | {"earlier": [now | {"jax": "0.0.1"}]}
    assert "unchanged; 1 others before (versions.json)" in command("inspect", f"run={folder}").stdout
    result = command("train", f"resume={folder}", "total_steps=160")
    assert "not the same bits" not in result.stdout
    path.write_text(json.dumps(json.loads(path.read_text()) | {"jax": "0.0.2"}))
    assert "jax was 0.0.2" in command("train", f"resume={folder}", "total_steps=192").stdout
    assert [part["jax"] for part in json.loads(path.read_text())["earlier"]] == ["0.0.1", "0.0.2"]


def test_a_damaged_checkpoint_is_named_and_the_one_before_it_used(runs, command, tmp_path):
    """The run goes on from there and ends with the bits of the one that was not damaged."""
    folder = tmp_path / "run"
    shutil.copytree(runs / "run", folder)
    damage(folder, 12)
    found = inspected(command, folder)
    assert (found["step"], found["finished"]) == (8, False)
    assert [checkpoint["sound"] for checkpoint in found["checkpoints"]] == [False, True, True]
    result = command("train", f"resume={folder}")
    assert result.returncode == 0, result.stderr
    assert "checkpoints/12: " in result.stdout
    assert "using the one before it" in result.stdout
    assert inspected(command, folder) == inspected(command, runs / "run")


def test_without_a_sound_checkpoint_there_is_nothing_to_resume(runs, command, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(runs / "run", folder)
    for number in (4, 8, 12):
        damage(folder, number)
    result = command("train", f"resume={folder}")
    assert result.returncode == 2
    assert re.fullmatch(r"error: .*/checkpoints/12: .*; and none before it is sound\n", result.stderr)


def test_looking_leaves_an_unfinished_save_alone(runs, command, tmp_path):
    """It may be one that the run is making just now; the run itself removes it when it is resumed."""
    folder = tmp_path / "run"
    shutil.copytree(runs / "run", folder)
    unfinished = folder / "checkpoints" / "16.orbax-checkpoint-tmp"
    unfinished.mkdir()
    assert inspected(command, folder) == inspected(command, runs / "run")
    assert command("evaluate", f"run={folder}", "episodes=2", "checkpoint=last").returncode == 0
    assert unfinished.exists()
    assert command("train", f"resume={folder}", "total_steps=128").returncode == 0
    assert not unfinished.exists()
