"""Terminals, variables and folders of any kind: the same bits, or one line that says what is wrong."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from processes import LINES, RUN, has_written, outcome, training

from jaxpg import train
from jaxpg.config.parsing import compose
from jaxpg.errors import UserError
from jaxpg.program.backend import prepare
from jaxpg.store.checkpoint import Checkpoints

TRAIN = (sys.executable, "-m", "jaxpg.train")


def some(cases, few):
    """All cases as parameters; all but the few named ones are marked as faults."""
    return [pytest.param(name, id=name, marks=[] if name in few else [pytest.mark.faults]) for name in cases]


@pytest.fixture(scope="module")
def undisturbed(command, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "undisturbed"
    assert command("train", *RUN, f"run_dir={folder}").returncode == 0
    return outcome(folder), training_state(folder)


# --- what must change nothing -----------------------------------------------------------------------------------------

VARIABLES = {
    "narrow": {"COLUMNS": "40"},
    "no colour": {"NO_COLOR": "1", "TERM": "dumb"},
    "ascii": {"LC_ALL": "C", "PYTHONIOENCODING": "ascii"},
    "hash seed": {"PYTHONHASHSEED": "1"},
    "time zone": {"TZ": "Pacific/Kiritimati"},
    "no home": {"HOME": "/nonexistent", "XDG_CACHE_HOME": ""},
    "no cache": {"XDG_CACHE_HOME": "/proc/nothing", "MPLCONFIGDIR": "{tmp}"},  # matplotlib would speak of its own
    "one OpenMP thread": {"OMP_NUM_THREADS": "1"},
    "synchronous": {"JAX_CPU_ENABLE_ASYNC_DISPATCH": "false"},
    "own cache of jax": {"JAX_COMPILATION_CACHE_DIR": "{tmp}/jax"},
}


@pytest.mark.parametrize("name", some(VARIABLES, ["ascii"]))
def test_variables_that_change_no_bit(name, undisturbed, command_environment, tmp_path):
    """Nor do they make noise; the folder's name has a letter that not every terminal can show."""
    variables = {key: value.format(tmp=tmp_path) for key, value in VARIABLES[name].items()}
    folder = tmp_path / "an äußerst long name for a folder, for a terminal of forty columns"
    command = [*TRAIN, *RUN, f"run_dir={folder}"]
    result = subprocess.run(command, env=command_environment | variables, capture_output=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stderr == b""
    assert outcome(folder) == undisturbed[0]


OPTIONS = {
    "no cache": ["cache=false"],
    "one chunk": ["log_interval=1600"],
    "long chunks": ["log_interval=64"],
    "no evaluation": ["eval_interval=1600"],
    "one checkpoint": ["checkpoint_interval=1600"],
    "skip": ["nan_policy=skip"],
}


@pytest.mark.parametrize("name", some(OPTIONS, ["long chunks"]))
def test_options_that_change_no_bit(name, undisturbed, command, tmp_path):
    """Of the training state, that is: its best policy depends on the evaluations."""
    given = dict(argument.split("=") for argument in (*RUN, *OPTIONS[name]))
    folder = tmp_path / "run"
    result = command("train", *(f"{key}={value}" for key, value in given.items()), f"run_dir={folder}")
    assert result.returncode == 0, result.stderr
    assert training_state(folder) == undisturbed[1]


def training_state(folder):
    """Shape, type and digest of every array of the newest training state."""
    checkpoints = Checkpoints(folder / "checkpoints", read_only=True)
    leaves = checkpoints.record(checkpoints.latest())["leaves"]
    state = {name: leaf for name, leaf in leaves.items() if name.startswith("train/")}
    assert state
    return state


@pytest.mark.faults
def test_one_core_with_the_same_threads(command_environment, undisturbed, tmp_path):
    """The number of XLA's threads is pinned, not taken from the cores that are free."""
    threads = str(len(os.sched_getaffinity(0)))
    folder, variables = tmp_path / "run", command_environment | {"PJRT_NPROC": threads}
    command = ["taskset", "--cpu-list", str(min(os.sched_getaffinity(0))), *TRAIN, *RUN, f"run_dir={folder}"]
    result = subprocess.run(command, env=variables, capture_output=True, check=False)
    assert result.returncode == 0, result.stderr
    assert outcome(folder) == undisturbed[0]


# --- the clock --------------------------------------------------------------------------------------------------------

# The system's clock is set at each look at it, by the next of so many seconds, before anything else has seen it.
SET_CLOCK = """
import itertools, runpy, sys, time
offsets = itertools.cycle([int(seconds) for seconds in sys.argv.pop(1).split(",")])
for name, unit in (("time", 1), ("time_ns", 10**9)):
    look = getattr(time, name)
    setattr(time, name, lambda look=look, unit=unit: look() + unit * next(offsets))
runpy.run_module("jaxpg.train", run_name="__main__", alter_sys=True)
"""


@contextlib.contextmanager
def training_while_the_clock_is_set(offsets, environment, *arguments):
    command = [sys.executable, "-c", SET_CLOCK, ",".join(map(str, offsets)), *arguments]
    with subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        try:
            yield process
        finally:
            process.kill()


def test_a_clock_that_is_set_back_and_forth(undisturbed, command_environment, tmp_path):
    """While it trains, and by a year more between a kill and the resumption: nothing follows from the time of day.

    Forward by less than a day: then the other tests' temporary folders, in the cache, would be taken for left ones.
    """
    folder, hour, day = tmp_path / "run", 3600, 86400
    with training_while_the_clock_is_set([0, -day, 20 * hour], command_environment, *RUN, f"run_dir={folder}") as first:
        assert has_written(first, folder, LINES // 2)
        first.kill()
        assert first.stderr.read() == b""
    offsets = [-365 * day, -366 * day, -400 * day]
    with training_while_the_clock_is_set(offsets, command_environment, f"resume={folder}") as second:
        assert second.stderr.read() == b""
        assert second.wait() == 0
    assert outcome(folder) == undisturbed[0]
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    seconds = [line["seconds"] for line in lines]
    assert seconds == sorted(seconds)
    assert 0 < seconds[0] <= seconds[-1] < hour


# --- output -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("end", some(["| head -1", "> /dev/full", ">&- 2>&-", "2>&1 | true"], ["| head -1"]))
def test_output_that_nobody_reads(end, undisturbed, command_environment, tmp_path):
    folder = tmp_path / "run"
    line = " ".join([*TRAIN, *RUN, f"run_dir={folder}", end])
    result = subprocess.run(["bash", "-c", f"set -o pipefail; {line}"], env=command_environment, capture_output=True)
    assert result.stderr == b""
    assert result.returncode == 0
    assert outcome(folder) == undisturbed[0]


@pytest.mark.faults
@pytest.mark.parametrize("ignored", [False, True])
def test_a_terminal_that_hangs_up(ignored, command_environment, tmp_path):
    """SIGHUP is a request to stop, as SIGTERM is; under nohup it is nothing."""
    folder = tmp_path / "run"
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN if ignored else signal.SIG_DFL)
    try:
        with training(command_environment, *RUN, f"run_dir={folder}") as process:
            while not (folder / "metrics.jsonl").exists():
                time.sleep(0.01)
            time.sleep(0.1)
            process.send_signal(signal.SIGHUP)
            said = process.stdout.read()
            assert process.wait() == (0 if ignored else 129), said
    finally:
        signal.signal(signal.SIGHUP, before)
    assert ("SIGHUP: stopped at" in said) != ignored


# --- what is refused --------------------------------------------------------------------------------------------------

REFUSED = {
    "no such platform": ({"JAX_PLATFORMS": "cuda"}, "JAX_PLATFORMS=cuda: "),
    "float64": ({"JAX_ENABLE_X64": "1"}, "JAX_ENABLE_X64: training is in float32"),
    "no jit": ({"JAX_DISABLE_JIT": "1"}, "JAX_DISABLE_JIT: training is one compiled program"),
    "threads in words": ({"PJRT_NPROC": "two"}, "PJRT_NPROC=two: expected a whole number of threads"),
    "no threads": ({"PJRT_NPROC": "0"}, "PJRT_NPROC=0: expected a whole number of threads, at least 1"),
}


@pytest.mark.parametrize("name", some(REFUSED, ["threads in words"]))
def test_variables_that_are_refused(name, command_environment, tmp_path):
    variables, message = REFUSED[name]
    command = [*TRAIN, *RUN, f"run_dir={tmp_path / 'run'}"]
    result = subprocess.run(command, env=command_environment | variables, capture_output=True, text=True, check=False)
    assert result.returncode == 2, result.stderr
    assert result.stderr.startswith(f"error: {message}"), result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert not (tmp_path / "run").exists()


ENDS = """#!/bin/sh
echo 'F0000 parse_flags.cc] not a flag that is known' >&2
exit 134
"""


@pytest.fixture
def flags(monkeypatch, tmp_path):
    """`flags(script)`: a harmless XLA_FLAGS, which a process of its own tries; that process is the script."""

    def given(script):
        stand_in, value = tmp_path / "python", "--xla_cpu_enable_fast_math=false"
        stand_in.write_text(script)
        stand_in.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(stand_in))
        monkeypatch.setenv("XLA_FLAGS", value)
        monkeypatch.setenv("PJRT_NPROC", "")
        return value

    return given


def test_flags_that_xla_does_not_start_with(flags, tmp_path):
    """It ends the process, with a line on standard error; ours is not that process."""
    value = flags(ENDS)
    with pytest.raises(UserError) as refusal:
        train.main([*RUN, f"run_dir={tmp_path / 'run'}"])
    assert str(refusal.value) == f"XLA_FLAGS={value}: XLA does not start with it (not a flag that is known)"
    assert not (tmp_path / "run").exists()


def test_flags_that_xla_starts_with(flags):
    flags("#!/bin/sh\n")
    prepare(compose([]))


@pytest.mark.faults
def test_a_renderer_that_is_not_to_be_had(command_environment, tmp_path):
    """Of which MuJoCo's import speaks, although nothing is drawn."""
    command = [*TRAIN, "env=pendulum", f"run_dir={tmp_path / 'run'}"]
    environment = command_environment | {"MUJOCO_GL": "nonsense"}
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert result.stderr.startswith("error: MUJOCO_GL=nonsense: MuJoCo cannot be imported with it")
    assert len(result.stderr.splitlines()) == 1
    assert not (tmp_path / "run").exists()


# --- folders ----------------------------------------------------------------------------------------------------------


@pytest.mark.faults
def test_a_link_to_a_folder_elsewhere(undisturbed, command, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    assert command("train", *RUN, f"run_dir={tmp_path / 'link'}").returncode == 0
    assert outcome(tmp_path / "elsewhere") == undisturbed[0]


@pytest.mark.faults
def test_a_relative_folder_below_folders_that_are_not_there(undisturbed, command, tmp_path):
    assert command("train", *RUN, "run_dir=a/b/../c", cwd=tmp_path).returncode == 0
    assert outcome(tmp_path / "a" / "c") == undisturbed[0]


@pytest.mark.faults
def test_a_run_that_was_moved_goes_on(undisturbed, command, command_environment, tmp_path):
    before, after = tmp_path / "before", tmp_path / "after"
    with training(command_environment, *RUN, f"run_dir={before}") as process:
        while not (before / "checkpoints" / "20").exists():
            time.sleep(0.005)
        process.kill()
        process.wait()
    Path(before).rename(after)
    assert command("train", f"resume={after}").returncode == 0
    assert outcome(after) == undisturbed[0]
    assert not before.exists()


def test_strangers_among_the_checkpoints(undisturbed, command, command_environment, tmp_path):
    """An empty folder with a number for a name, a file, and what a save leaves that was killed."""
    folder = tmp_path / "run"
    with training(command_environment, *RUN, f"run_dir={folder}") as process:
        while not (folder / "checkpoints" / "20").exists():
            time.sleep(0.005)
        process.kill()
        process.wait()
    (folder / "checkpoints" / "999").mkdir()
    (folder / "checkpoints" / "notes.txt").write_text("mine")
    (folder / "checkpoints" / "30.orbax-checkpoint-tmp").mkdir()
    result = command("train", f"resume={folder}")
    assert result.returncode == 0, result.stderr
    assert "checkpoints/999: cannot be read" in result.stdout
    assert outcome(folder) == undisturbed[0]
