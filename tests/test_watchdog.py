"""A chunk that does not end is spoken of, once, with where it stands; one that ends is not."""

import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

from jaxpg.run import watchdog
from jaxpg.run.watchdog import Watchdog


def test_what_ends_in_time_is_left_alone(capfd):
    dog = Watchdog(at_least=5.0)
    for _ in range(3):
        with dog.chunk("update 1 to 2"):
            time.sleep(0.01)
    assert capfd.readouterr() == ("", "")


def test_what_does_not_end_is_named_with_its_stack(capfd):
    error, deadline = "", time.monotonic() + 60
    with Watchdog(at_least=0.2, pulse=0.05).chunk("update 1 to 2"):
        while "test_what_does_not_end" not in error and time.monotonic() < deadline:
            time.sleep(0.1)
            error += capfd.readouterr().err
    error += capfd.readouterr().err
    assert error.startswith("warning: update 1 to 2 has been running for 0 s: ")
    assert error.count("warning:") == 1
    assert "test_what_does_not_end_is_named_with_its_stack" in error


def test_ten_times_the_usual_is_allowed(monkeypatch):
    now = 0.0
    monkeypatch.setattr(watchdog, "time", SimpleNamespace(monotonic=lambda: now))
    dog = Watchdog(at_least=3.0)
    assert dog.limit == 3.0
    for seconds in (1.0, 5.0, 1.0):
        with dog.chunk("update"):
            now += seconds
    assert dog.limit == 10.0


def test_the_likely_cause_depends_on_jaxlib(monkeypatch):
    monkeypatch.setattr(watchdog.jaxlib.version, "__version__", "0.10.1")
    assert "PJRT_NPROC=1 or jaxlib 0.12 avoids it" in watchdog.describe_cause()
    monkeypatch.setattr(watchdog.jaxlib.version, "__version__", "0.12.0")
    assert "LAPACK" not in watchdog.describe_cause()


def test_time_in_which_the_process_is_stopped_does_not_count():
    code = """
import time
from jaxpg.run.watchdog import Watchdog
with Watchdog(at_least=1.5, pulse=0.1).chunk("update"):
    print("began", flush=True)
    time.sleep(0.8)
    end = time.monotonic() + 0.2
    while time.monotonic() < end: pass
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.readline()
        process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOWAIT)
        time.sleep(3)
        process.send_signal(signal.SIGCONT)
        assert process.stderr.read() == b""
        assert process.wait() == 0
