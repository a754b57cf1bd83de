"""Loggers: all of them get what `metrics.jsonl` has, each step once, and none can stop a run or hold it up."""

import json
import os
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from jaxpg import train
from jaxpg.errors import UserError
from jaxpg.store import folder
from jaxpg.store.folder import RunFolder
from jaxpg.store.loggers import LoggerError, SafeLogger, follower, mean_values, sender
from jaxpg.store.metrics_log import MetricsLog

# A stand-in for wandb that writes down what it is given, in a process of its own as the real one.
STAND_IN = """
import json, os, time
from types import SimpleNamespace

def Settings(**settings):
    return SimpleNamespace(mode=os.environ.get("STAND_IN_MODE", "offline"), **settings)

def init(*, settings, **given):
    if "STAND_IN_HANGS" in os.environ:
        time.sleep(60)
    if "STAND_IN_REFUSES" in os.environ:
        raise ValueError("No API key configured.\\nAnd more.")
    print("chatter")
    with open(os.environ["STAND_IN_FILE"], "a") as file:
        file.write(json.dumps(["init", given["id"], given["name"], given["config"]]) + "\\n")
    start = int(os.environ.get("STAND_IN_START", 0))
    return SimpleNamespace(settings=settings, starting_step=start, log=log, finish=lambda: None)

def log(values, step, commit):
    with open(os.environ["STAND_IN_FILE"], "a") as file:
        file.write(json.dumps(["log", step, values]) + "\\n")
"""


class Memory:
    """A logger that keeps what it gets, and fails where it is asked to."""

    def __init__(self, last=-1, fails_at=None):
        self.last, self.lines, self._fails_at = last, [], fails_at

    def write(self, values, step):
        if step == self._fails_at:
            raise LoggerError("is on strike")
        self.lines.append((step, values))

    def close(self):
        if self._fails_at == "close":
            raise OSError(28, "No space left on device")
        self.lines.append("closed")


def line_at(update):
    return {"update": update, "steps": 8 * update, "return": [1.0 * update, None, 2.0], "seconds": 0.5 * update}


def write_lines(path, updates):
    path.write_text("".join(json.dumps(line_at(update)) + "\n" for update in updates))


@pytest.fixture(autouse=True)
def _this_process_is_not_a_sender():
    """A sender has an alarm set, in the end."""
    yield
    signal.alarm(0)


@pytest.fixture
def run_folder(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text(
        "program: /home/me/robot.py\nseed: 3\nenv:\n  id: pendulum\n  mass: 1e-3\n"
    )
    return RunFolder(tmp_path / "run")


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """The calls that the stand-in for wandb has had."""
    (tmp_path / "packages" / "wandb").mkdir(parents=True)
    (tmp_path / "packages" / "wandb" / "__init__.py").write_text(STAND_IN)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "packages"))
    monkeypatch.setenv("STAND_IN_FILE", str(tmp_path / "calls"))
    monkeypatch.delenv("WANDB_RUN_ID", raising=False)
    return lambda: [json.loads(text) for text in (tmp_path / "calls").read_text().splitlines()]


def log_lines(run_folder, updates, say=print, done=0, loggers=("wandb",)):
    log = MetricsLog(run_folder, done, say, loggers)
    for update in updates:
        log.write(line_at(update))
    log.close()


def steps_in_tensorboard(folder):
    """What TensorBoard shows: it reads files by the order of their names; a beginning purges what is later."""
    from tensorboardX.proto.event_pb2 import Event

    steps = []
    for path in sorted(folder.iterdir()):
        content = path.read_bytes()
        while content:
            (length,) = struct.unpack("Q", content[:8])
            event, content = Event.FromString(content[12 : 12 + length]), content[16 + length :]
            if event.HasField("session_log"):
                steps = [step for step in steps if step < event.step]
            if event.HasField("summary"):
                steps.append(event.step)
    return steps


@pytest.mark.parametrize("now", [3e9, 2e9, 1e9], ids=["later", "in the same second", "set back"])
def test_tensorboard_has_every_step_once_whatever_the_clock_says(run_folder, monkeypatch, now):
    monkeypatch.setattr(time, "time", lambda: 2e9)
    log_lines(run_folder, range(1, 6), loggers=())
    monkeypatch.setattr(time, "time", lambda: now)
    log_lines(run_folder, range(4, 8), done=3, loggers=())
    assert steps_in_tensorboard(run_folder.tensorboard) == [8 * update for update in range(1, 8)]


def test_values_are_means_over_the_agents_that_have_one():
    line = {"update": 1, "steps": 8, "return": [1.0, None, 4.0], "eval_return": None, "value": [None, None], "sigma": 2}
    assert mean_values(line) == {"return": 2.5, "sigma": 2}


def test_a_logger_that_fails_says_so_once_and_gets_nothing_more():
    notes, memory = [], Memory(fails_at=16)
    logger = SafeLogger(lambda: memory, "memory", notes.append)
    for step in (8, 16, 24):
        logger.write({"return": 1.0}, step)
    logger.close()
    assert notes == ["note: memory: is on strike"]
    assert memory.lines == [(8, {"return": 1.0})]


@pytest.mark.parametrize("begins", [True, False])
def test_a_logger_that_cannot_begin_or_end_stops_nothing(begins):
    def begin():
        if not begins:
            raise OSError(28, "No space left on device")
        return Memory(fails_at="close")

    notes = []
    logger = SafeLogger(begin, "memory", notes.append)
    logger.write({"return": 1.0}, 8)
    logger.close()
    assert notes == ["note: memory: cannot be written (No space left on device); it gets no more metrics"]


@pytest.mark.parametrize("last", [-1, 0, 8, 20, 24])
def test_a_service_gets_the_lines_that_are_newer_than_its_last(tmp_path, last):
    write_lines(tmp_path / "metrics", [1, 2, 3])
    service = Memory(last)
    told, end = os.pipe()
    os.close(end)
    with (tmp_path / "metrics").open("rb") as lines:
        sender.follow(service, lines, told)
    os.close(told)
    assert service.lines == [
        (8 * update, {"return": update / 2 + 1, "seconds": update / 2}) for update in (1, 2, 3) if 8 * update > last
    ]


@pytest.mark.parametrize("size", [1, 7, 60, 1000])
def test_lines_are_sent_when_they_are_whole(tmp_path, size):
    """However they are torn: the file has grown by another piece whenever it has been read."""
    service, (told, tell) = Memory(), os.pipe()
    text = "".join(json.dumps(line_at(update)) + "\n" for update in (1, 2, 3)).encode()
    pieces, ended = [text[first : first + size] for first in range(0, len(text), size)], []
    os.write(tell, b"\n")
    with (tmp_path / "metrics").open("wb", buffering=0) as writer, (tmp_path / "metrics").open("rb") as reader:

        def read():
            found = reader.read()
            writer.write(pieces.pop(0) if pieces else b"")
            if pieces:
                os.write(tell, b"\n")
            elif not ended:
                ended.append(os.close(tell))
            return found

        sender.follow(service, SimpleNamespace(read=read, tell=reader.tell, seek=reader.seek), told)
    os.close(told)
    assert [step for step, _ in service.lines] == [8, 16, 24]


def test_a_service_gets_the_configuration_the_name_and_every_line(run_folder, stand_in, capfd):
    log_lines(run_folder, [1, 2, 3])
    (init, _, name, config), *logged = stand_in()
    assert (init, name, config) == ("init", "run", {"seed": 3, "env": {"id": "pendulum", "mass": 1e-3}})
    written = [(line["steps"], mean_values(line)) for line in folder.read_metrics(run_folder)]
    assert [(step, values) for _, step, values in logged] == written
    assert len(written) == 3
    assert capfd.readouterr() == ("", ""), "what a service prints is for its log"
    assert (run_folder.loggers / "wandb.log").read_text() == "chatter\n"


def test_a_resumed_run_has_each_step_once(run_folder, stand_in):
    """It repeats lines after its checkpoint, which were sent; under the same id."""
    log_lines(run_folder, [1, 2, 3, 4])
    log_lines(run_folder, [3, 4, 5, 6], done=2)
    calls = stand_in()
    assert [call[1] for call in calls if call[0] == "log"] == [8, 16, 24, 32, 40, 48]
    first, second = (call[1] for call in calls if call[0] == "init")
    assert first == second


def test_what_a_service_has_missed_is_sent_when_the_run_goes_on(run_folder, stand_in, monkeypatch):
    """It was not asked for at first; and then on line, where it says itself what it has, it has lost lines."""
    log_lines(run_folder, [1, 2], loggers=())
    log_lines(run_folder, [3], done=2)
    assert [call[1] for call in stand_in()[1:]] == [8, 16, 24]
    monkeypatch.setenv("STAND_IN_MODE", "online")
    monkeypatch.setenv("STAND_IN_START", "9")
    log_lines(run_folder, [4], done=3)
    assert [call[1] for call in stand_in()[5:]] == [16, 24, 32]


def test_a_service_that_refuses_costs_one_note(run_folder, stand_in, monkeypatch):
    """Whether that is noticed while training or at its end."""
    monkeypatch.setenv("STAND_IN_REFUSES", "1")
    for wait in (False, True):
        notes = []
        log = MetricsLog(run_folder, 0, notes.append, ["wandb"])
        log.write(line_at(1))
        while wait and not notes:
            log.write(line_at(2))
            time.sleep(0.01)
        log.close()
        assert len(notes) == 1
        assert notes[0].startswith(f"note: wandb: No API key configured. ({run_folder.loggers / 'wandb.log'}); it ")
        assert len(folder.read_metrics(run_folder)) >= 1


def test_a_service_that_hangs_holds_nothing_up(run_folder, stand_in, monkeypatch):
    """More words than the pipe takes do not block, and the end waits no longer than it is allowed to."""
    monkeypatch.setenv("STAND_IN_HANGS", "1")
    monkeypatch.setattr(follower, "CLOSE_TIMEOUT", 0.1)
    service = follower.Follower("wandb", run_folder.loggers)
    run_folder.metrics.touch()
    for step in range(1 << 17):
        service.write({}, step)
    with pytest.raises(
        LoggerError, match=r"^has not received all metrics after 0 s; process \d+ continues for at most 10 "
    ):
        service.close()
    service._process.kill()
    service._process.wait()


def test_one_line_where_a_package_is_missing(tmp_path, monkeypatch):
    """Before anything is written; a folder that W&B left has its name, but is no package."""
    monkeypatch.setattr(sys, "path", [str(tmp_path), *(p for p in sys.path if not Path(p, "wandb").exists())])
    monkeypatch.delitem(sys.modules, "wandb", raising=False)
    (tmp_path / "wandb").mkdir()
    with pytest.raises(UserError, match=r"^loggers=\[wandb\]: \S+ -m pip install wandb$"):
        train.main(["env=quadratic", "loggers=[wandb]", f"run_dir={tmp_path / 'run'}"])
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("uri", ["", "http://localhost:5000"])
def test_a_store_on_this_machine_needs_a_database(monkeypatch, uri):
    """mlflow-skinny has no database, and is enough for a server."""
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    monkeypatch.setattr(follower, "_is_installed", lambda package: package == "mlflow")
    if uri:
        follower.check_installed(["mlflow"])
    else:
        with pytest.raises(UserError, match=r"^loggers=\[mlflow\]: \S+ -m pip install mlflow$"):
            follower.check_installed(["mlflow"])


def test_the_process_of_a_logger_is_a_light_one():
    code = "import sys, jaxpg.store.loggers.sender; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"jax", "envs", "numpy", "wandb", "mlflow"} & set(loaded)
