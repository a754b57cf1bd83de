"""How the commands are called: by `jaxpg`, by `python -m`; and on systems that have not all that Linux has."""

import importlib
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from jaxpg.__main__ import VERBS
from jaxpg.store import versions

ROOT = Path(__file__).parent.parent


@pytest.fixture
def script(monkeypatch, capsys):
    """`script("train", ...)`: exit status, output and errors of the console script `jaxpg`."""
    entry = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]["jaxpg"]
    module, _, name = entry.partition(":")

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["jaxpg", *arguments])
        with pytest.raises(SystemExit) as end:
            getattr(importlib.import_module(module), name)()
        return end.value.code, *capsys.readouterr()

    return call


@pytest.mark.parametrize("arguments", [(), ("--help",), ("-h",)])
def test_the_console_script_says_what_there_is(script, arguments):
    status, output, error = script(*arguments)
    assert (status, error) == (0, "")
    assert output.startswith("usage: jaxpg VERB ")
    assert all(f"\n  {verb} " in output for verb in VERBS)


def test_the_console_script_has_every_command(script):
    for verb in VERBS:
        status, output, error = script(verb, "--help")
        assert (status, error) == (0, "")
        assert output.startswith("usage: ")
    assert script("trian") == (2, "", "error: unknown command 'trian': did you mean 'train'?\n")
    assert script("evaluate") == (2, "", "error: run=DIR is missing: the folder of a run, such as runs/pendulum\n")


# As on Windows, where Python has no such modules and names.
WITHOUT_LOCKS = """
import os, runpy, sys
sys.modules["fcntl"] = sys.modules["resource"] = None
del os.O_DIRECTORY, os.O_NOFOLLOW
del sys.argv[0]
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""


def without_locks(*arguments, cwd):
    command = [sys.executable, "-c", WITHOUT_LOCKS, *arguments]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("arguments", [("jaxpg.train", "env=quadratic"), ("jaxpg", "evaluate", "run=somewhere")])
def test_on_windows_the_commands_say_where_they_run(arguments, tmp_path):
    ended = without_locks(*arguments, cwd=tmp_path)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.startswith("error: runs need Linux or macOS; on Windows start this command in WSL")
    assert len(ended.stderr.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_on_windows_there_is_help_and_the_library(tmp_path):
    ended = without_locks("jaxpg.train", "--help", cwd=tmp_path)
    assert (ended.returncode, ended.stderr) == (0, "")
    code = "import sys; sys.modules['fcntl'] = None; import jaxpg.actor_critic, jaxpg.returns, envs; print(7)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, check=True).stdout == b"7\n"


def test_on_a_mac_the_threads_are_all_cores(monkeypatch):
    """It does not say which of them a process may use."""
    monkeypatch.delenv("PJRT_NPROC", raising=False)
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 6)
    assert versions.count_threads() == 6
