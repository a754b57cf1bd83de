"""Training processes that tests stop in the middle of a cheap run, and the disks that these write to."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from jaxpg.store.checkpoint import Checkpoints

LINES = 100  # of metrics; a checkpoint after every tenth
SIZES = ("env=quadratic", "network=linear", "num_envs=2", "num_steps=4", "log_interval=16", "eval_interval=32")
SIZES += ("report=false",)  # which takes longer than such a run
RUN = (*SIZES, "eval_episodes=2", "env.episode_length=8", "checkpoint_interval=160", f"total_steps={16 * LINES}")


@contextlib.contextmanager
def training(environment, *arguments, by=()):
    """A training process, started by the command `by`; its output comes line by line, without a buffer."""
    command = [*by, sys.executable, "-m", "jaxpg.train", *arguments]
    environment = environment | {"PYTHONUNBUFFERED": "1"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with subprocess.Popen(command, env=environment, **pipes) as process:
        try:
            yield process
        finally:
            process.kill()


def has_written(process, folder, lines):
    """Waits until the process has written so many lines of metrics; whether it has before it ended."""
    log, deadline = folder / "metrics.jsonl", time.monotonic() + 300
    while not (log.exists() and log.read_bytes().count(b"\n") >= lines):
        if process.poll() is not None:
            return False
        assert time.monotonic() < deadline
        time.sleep(0.001)
    return True


def stop_after(process, folder, lines):
    """Stops the process when it has written so many lines of metrics; `proceed` lets it go on."""
    assert has_written(process, folder, lines), process.stdout.read()
    process.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOWAIT)


def proceed(process):
    process.send_signal(signal.SIGCONT)


def output_until(process, *texts):
    """What the process says until each of the texts has been said."""
    said = ""
    for line in process.stdout:
        said += line
        if all(text in said for text in texts):
            return said
    raise AssertionError(said)


def outcome(folder, which="checkpoints"):
    """The lines of metrics without their times, and the newest checkpoint's number and digest."""
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    checkpoints = Checkpoints(folder / which, read_only=True)
    latest = checkpoints.newest_sound()[0]
    return [{**line, "seconds": None} for line in lines], latest, checkpoints.digest(latest)


def tree(folder):
    """All files below a folder with their contents."""
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def bound_by_permissions():
    """A command that starts another one, as root without root's right to read and write everything."""
    if os.geteuid():
        return []
    if not shutil.which("setpriv"):
        pytest.skip("permissions do not keep root from writing")
    return ["setpriv", "--bounding-set=-dac_override,-dac_read_search"]


@contextlib.contextmanager
def mounted(*arguments):
    """`mount *arguments`, the last of which is the folder; skips the test where that is not possible."""
    result = subprocess.run(["mount", *map(str, arguments)], capture_output=True, text=True, check=False)
    if result.returncode:
        pytest.skip(f"cannot mount here: {result.stderr.strip()}")
    try:
        yield arguments[-1]
    finally:
        subprocess.run(["umount", "--lazy", str(arguments[-1])], check=True)
