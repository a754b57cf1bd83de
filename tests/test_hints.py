"""A message's command works when it is typed as it stands."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from envs import hints, playground_env
from envs.options import OptionError
from jaxpg.deploy.exporter import FORMATS
from jaxpg.errors import UserError
from jaxpg.store.loggers import follower
from jaxpg.watch import episodes, movie


@pytest.fixture
def interpreter(monkeypatch, tmp_path):
    """`interpreter(path)`: Python runs from there, below the working directory; no other is found by its name."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))

    def of(path):
        place = tmp_path / path
        place.parent.mkdir(parents=True)
        place.symlink_to(sys.executable)
        monkeypatch.setattr(sys, "executable", str(place))

    return of


@pytest.mark.parametrize(
    ("path", "typed"),
    [
        (".venv/bin/python", ".venv/bin/python"),
        ("bin/python3", "python3"),  # an environment that is activated
        ("my venv/bin/python", "'my venv/bin/python'"),
    ],
)
def test_the_interpreter_as_the_shell_finds_it(interpreter, path, typed):
    interpreter(path)
    assert hints.python_command() == typed
    assert subprocess.run(f"{typed} -c 'print(7)'", shell=True, capture_output=True, check=True).stdout == b"7\n"


def test_an_interpreter_elsewhere_has_its_whole_path(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(sys, "executable", "/opt/python/bin/python3")
    assert hints.pip_install("a", "b[c]") == "/opt/python/bin/python3 -m pip install a 'b[c]'"


def without_gymnasium(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    episodes.play_gymnasium(_pendulum(), 1, 0)


def _pendulum():
    from stored import a_policy

    return a_policy("env=pendulum", "network=linear")


def without_onnx(monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    FORMATS["onnx"].check()


def without_flatbuffers(monkeypatch):
    monkeypatch.setitem(sys.modules, "flatbuffers", None)
    FORMATS["stablehlo"].check()


def without_a_logger(monkeypatch):
    monkeypatch.setattr(follower, "_is_installed", lambda package: False)
    follower.check_installed(["wandb"])


def without_av(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    movie.find_format(Path("video.mp4"))


def without_playground(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    playground_env.make(playground_env.PlaygroundConfig())


MISSING = {
    without_gymnasium: "gymnasium",
    without_onnx: "onnx onnxruntime",
    without_flatbuffers: "flatbuffers",
    without_a_logger: "wandb",
    without_av: "av",
    without_playground: "playground",
}


@pytest.mark.parametrize("missing", MISSING, ids=lambda function: function.__name__)
def test_a_missing_package_is_installed_where_it_is_missing(missing, interpreter, monkeypatch):
    interpreter(".venv/bin/python")
    with pytest.raises((UserError, OptionError), match=r"\.venv/bin/python -m pip install " + MISSING[missing]):
        missing(monkeypatch)


def test_no_message_names_another_pip():
    """All others are spelt by `pip_install`."""
    root = Path(hints.__file__).parents[1]
    for path in [*(root / "envs").rglob("*.py"), *(root / "jaxpg").rglob("*.py")]:
        if path.name != "hints.py":
            assert "pip install " not in path.read_text(encoding="utf-8"), path
