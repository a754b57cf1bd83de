"""What a command does before and around its training: nothing is compiled twice or in vain."""

import re

import pytest

TINY = (
    *("env=quadratic", "network=linear", "num_envs=2", "num_steps=4", "log_interval=16", "eval_interval=32"),
    *("eval_episodes=2", "env.episode_length=8", "report=false"),
)
PROGRAMS = {"advance", "init", "play"}


@pytest.fixture
def compilations(command, command_environment, monkeypatch):
    """Names of all that a training command compiles, in order."""
    monkeypatch.setitem(command_environment, "JAX_LOG_COMPILES", "1")

    def names(*arguments):
        result = command("train", *arguments)
        assert result.returncode == 0, result.stderr
        return re.findall(r"Finished XLA compilation of jit\((.*?)\)", result.stderr)

    return names


def test_a_run_compiles_three_programs_and_a_resumed_one_two(compilations, tmp_path):
    """Each once, and nothing after them: not a single small program for what the host does between the chunks."""
    names = compilations(*TINY, "total_steps=64", f"run_dir={tmp_path / 'run'}")
    assert sorted(names[-3:]) == sorted(PROGRAMS)
    assert not PROGRAMS & set(names[:-3])
    names = compilations(f"resume={tmp_path / 'run'}", "total_steps=128")
    assert sorted(names[-2:]) == ["advance", "play"]
    assert "init" not in names
