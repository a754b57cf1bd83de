"""Ctrl-C ends a command with status 130, whatever it does; runs that begin in one second have folders of their own."""

import contextlib
import gc
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from jaxpg.commands.ending import run_command
from jaxpg.config.parsing import compose
from jaxpg.run.signals import Interrupts, StopRequests
from jaxpg.store import folder


def interrupt():
    os.kill(os.getpid(), signal.SIGINT)


@pytest.fixture
def swallowing():
    """A callback of the garbage collector, as JAX has one, in which a Ctrl-C arrives: its exception is dropped."""
    calls = []

    def callback(phase, info):
        if not calls:
            calls.append(phase)
            interrupt()

    gc.callbacks.append(callback)
    yield calls
    gc.callbacks.remove(callback)


def test_an_interrupt_in_a_garbage_collection_is_not_lost(swallowing, monkeypatch, capsys):
    monkeypatch.setattr(Interrupts, "AGAIN", 0.01)
    gone_on = []

    def main(arguments):
        gc.collect()
        time.sleep(10)
        gone_on.append(True)

    monkeypatch.setattr(threading, "active_count", lambda: 1)  # the test's own process is not to be left at once
    with pytest.raises(SystemExit) as ending:
        run_command(main)
    assert (ending.value.code, swallowing, gone_on) == (130, ["start"], [])
    assert capsys.readouterr().err == "interrupted\n"


def raise_another():
    try:
        interrupt()
    except KeyboardInterrupt:
        raise RuntimeError("a callback failed") from None


def raise_nothing():
    with contextlib.suppress(BaseException):
        interrupt()


@pytest.mark.parametrize("interrupted", [raise_another, raise_nothing])
def test_what_a_library_makes_of_an_interrupt_is_one_all_the_same(interrupted):
    with pytest.raises(KeyboardInterrupt), Interrupts():
        interrupted()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_without_an_interrupt_nothing_is_changed():
    hook = sys.unraisablehook
    with pytest.raises(ValueError, match="mine"), Interrupts():
        raise ValueError("mine")
    assert sys.unraisablehook is hook


def test_in_another_thread_no_signal_is_heard():
    heard = []

    def train():
        with Interrupts(), StopRequests() as stop:
            heard.append(stop.signal)

    thread = threading.Thread(target=train)
    thread.start()
    thread.join()
    assert heard == [None]


def test_a_second_interrupt_ends_a_training_at_once():
    def interrupt_twice():
        with Interrupts(), StopRequests() as stop:
            interrupt()
            heard.append(stop.signal)
            interrupt()

    heard = []
    with pytest.raises(KeyboardInterrupt):
        interrupt_twice()
    assert heard == [signal.SIGINT]


def test_an_interrupt_that_is_to_be_ignored_stays_ignored_after_another_signal():
    """As in the background of a shell, when a scheduler ends the job."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with StopRequests() as stop:
            os.kill(os.getpid(), signal.SIGTERM)
            assert stop.signal == signal.SIGTERM
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


COMPILING = """
import jax, threading, time
from concurrent.futures import ThreadPoolExecutor
from jaxpg.program import compile as program
from jaxpg.commands.ending import run_command

def main(arguments):
    with program._compiler_pool() as pool:
        pool.submit(time.sleep, 600)  # as XLA does, which does not hear of signals
        print("compiling", flush=True)
        time.sleep(600)

run_command(main)
"""


def test_an_interrupt_while_xla_compiles_does_not_wait_for_it():
    with subprocess.Popen([sys.executable, "-c", COMPILING], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.readline()
        process.send_signal(signal.SIGINT)
        assert process.wait(300) == 130
        assert process.stderr.read() == b"interrupted\n"


def test_runs_that_begin_in_one_second_have_folders_of_their_own(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(time, "strftime", lambda form: "now")
    config, found = compose(["env=quadratic"]), []
    threads = [threading.Thread(target=lambda: found.append(folder.choose(config).path)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(found)) == len(threads)
    assert all(path.is_dir() and path.name.startswith("quadratic-td-s0-now") for path in found)


@pytest.mark.parametrize("name", ["../../up", "a/b", "[x]", "x" * 300, "2 link", "..", "größe"])
def test_the_default_folder_is_in_runs_whatever_the_environment_is_called(name, monkeypatch, tmp_path):
    from environments import register

    register(monkeypatch, name)
    monkeypatch.chdir(tmp_path)
    path = folder.choose(compose(["env=" + repr(name)])).path
    assert path.parent.as_posix() == "runs"
    assert path.is_dir()
