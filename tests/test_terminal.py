"""What is seen while a run goes on: on a terminal, and in a file."""

import gc
import io
import os
import re
import subprocess
import sys
import threading
import time
import warnings

import pytest
from rich.console import Console

from jaxpg.run import terminal
from jaxpg.store import durations, stderr
from jaxpg.store.stderr import filter_stderr

LINE = {"update": 2, "steps": 50, "return": -3.0, "eval_return": -2.5, "seconds": 1.0}


@pytest.fixture(params=[True, False], ids=["terminal", "file"])
def display(request, monkeypatch):
    """A display and what it writes."""
    written = io.StringIO()
    console = Console(file=written, force_terminal=request.param, width=100, highlight=False, soft_wrap=True)
    monkeypatch.setattr(terminal, "Console", lambda **options: console)
    shown = terminal.Display(total_steps=100)
    shown.is_terminal = request.param
    return shown, written


def test_evaluations_are_shown_as_lines_that_stay(display):
    shown, written = display
    shown.start()
    shown.update({name: value for name, value in LINE.items() if name != "eval_return"})
    shown.update(LINE)
    shown.stop()
    lines = [line for line in written.getvalue().splitlines() if "deterministic -2.5" in line]
    assert len(lines) == 1
    assert "50 steps" in lines[0]


@pytest.mark.parametrize("num_agents", [1, 4])
def test_the_rate_counts_the_steps_of_all_agents(num_agents, monkeypatch, capsys):
    """1,000 of 5,000 steps of each agent in 2 s: 500 steps/s an agent, and 8 s are left, however many there are."""
    now = iter([10.0, 10.0, 12.0])
    monkeypatch.setattr(terminal.time, "monotonic", lambda: next(now))
    display = terminal.Display(5000, num_agents=num_agents)
    display.start()
    display.update({"steps": 1000, "return": -1.0, "eval_return": -2.0})
    said = capsys.readouterr().out
    assert int(re.search(r"([\d,]+) steps/s", said)[1].replace(",", "")) == 500 * num_agents
    assert "8 s left" in said


def test_what_takes_its_time_is_named_with_a_clock_or_in_a_line(display):
    shown, written = display
    with shown.show_status("compiling [a b]"):
        time.sleep(1.3)
        shown.say("note: said meanwhile")
    text = written.getvalue()
    assert "compiling [a b]" in text
    assert text.count("note: said meanwhile") == 1
    if shown.is_terminal:
        assert "0:00:00" in text
        assert "0:00:01" in text
    else:
        assert text == "compiling [a b] ...\nnote: said meanwhile\n"


def test_how_long_it_takes_is_known_the_next_time(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def said(what, seconds):
        clock = iter([0.0, seconds])
        monkeypatch.setattr(durations.time, "monotonic", lambda: next(clock))
        with durations.record_duration(True, what) as words:
            return words

    new = "for the first time here"
    assert [said("a", 15.0), said("b", 1.0), said("a", 2.0), said("a", 4.0)] == [
        *(new, new, "15.0 s here before", "2.0 to 15.0 s here before")
    ]


def test_without_a_cache_nothing_is_known_or_kept(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for _ in range(2):
        with durations.record_duration(False, "a") as words:
            assert words == "for the first time here"
    assert not list(tmp_path.iterdir())


# --- standard error while XLA compiles --------------------------------------------------------------------------------

ALARM = """\
E0000 00:00:1790000000.000000   12345 slow_operation_alarm.cc:73] \n\
********************************
[Compiling module jit_advance] Very slow compile? If you want to file a bug, run with envvar \
XLA_FLAGS=--xla_dump_to=/tmp/foo and attach the results.
********************************

"""


def test_xlas_alarms_do_not_reach_the_terminal(capfd):
    with filter_stderr() as seen:
        os.write(2, f"before\n{ALARM}\nafter\n".encode())
        os.write(2, ALARM.encode())
        os.write(2, b"no end of line")
    assert capfd.readouterr().err == "before\nafter\nno end of line"
    assert not seen.refused


def test_empty_lines_of_others_stay(capfd):
    with filter_stderr():
        os.write(2, b"one\n\ntwo **\n\n")
    assert capfd.readouterr().err == "one\n\ntwo **\n\n"


def test_the_last_words_of_a_process_that_aborts_are_passed_on():
    """All of them: a thread of the process itself would die with some unread."""
    words = b"what was wrong\n" * 4000  # of 15 letters: less than a pipe holds
    program = (
        "import os\nfrom jaxpg.store.stderr import filter_stderr\n"
        "with filter_stderr():\n"
        "    os.write(2, b'what was wrong\\n' * 4000)\n"
        "    os.abort()\n"
    )
    for _ in range(3):
        result = subprocess.run([sys.executable, "-c", program], capture_output=True, check=False)
        assert result.returncode < 0
        assert result.stderr == words


def test_without_a_process_to_filter_it_standard_error_is_as_it_was(monkeypatch, capfd):
    monkeypatch.setattr(stderr.sys, "executable", "/nonexistent/python")
    with filter_stderr():
        os.write(2, ALARM.encode())
    assert capfd.readouterr().err == ALARM


def test_a_filter_that_ends_late_is_waited_for_in_the_background(monkeypatch):
    """As on a busy machine, or while another process holds the pipe open: Python would warn that it still runs."""
    monkeypatch.setattr(stderr, "PATIENCE", 0.05)
    with warnings.catch_warnings():
        warnings.simplefilter("error", ResourceWarning)
        with filter_stderr():
            holder = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)  # inherits the pipe
        gc.collect()
        holder.communicate(b"\n")
    for thread in [thread for thread in threading.enumerate() if thread.name.endswith("(wait)")]:
        thread.join(60)
        assert not thread.is_alive()
