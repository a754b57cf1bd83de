"""Killed at any moment and started again by the same command, a run ends as the run that nobody killed.

In state, best policy and metrics to the bit, but for times. `pytest -m faults tests/faults` kills a hundred times.
"""

import random
import re
import signal
import time

import pytest
from processes import LINES, RUN, has_written, outcome, training

FEW, MANY = 1, 100


@pytest.fixture(scope="module")
def undisturbed(command, tmp_path_factory):
    """What the run leaves, and how long its process lives."""
    folder = tmp_path_factory.mktemp("runs") / "undisturbed"
    for name in ("compiled", "undisturbed"):
        began = time.monotonic()
        assert command("train", *RUN, f"run_dir={folder.with_name(name)}").returncode == 0
    return outcome(folder), outcome(folder / ".." / "undisturbed", "best"), time.monotonic() - began


def moments(number):
    return [
        pytest.param(seed, id=f"{seed}", marks=[pytest.mark.faults] if seed >= FEW else []) for seed in range(number)
    ]


@pytest.mark.parametrize("seed", moments(MANY))
def test_killed_at_a_random_moment(undisturbed, command, command_environment, tmp_path, seed):
    """Every third kill at any time of the process, the others while it trains and saves."""
    expected, expected_best, lifetime = undisturbed
    folder, moment = tmp_path / "run", random.Random(seed)
    arguments = (*RUN, f"run_dir={folder}", "resume=auto")
    with training(command_environment, *arguments) as process:
        if seed % 3 == 2:
            time.sleep(moment.uniform(0, lifetime))
        else:
            has_written(process, folder, moment.randrange(LINES))
            time.sleep(moment.uniform(0, 0.02))
        process.send_signal(signal.SIGKILL)
        process.wait()
    result = command("train", *arguments)
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    assert "not the same bits" not in result.stdout
    assert outcome(folder) == expected
    assert outcome(folder, "best") == expected_best


@pytest.mark.faults
@pytest.mark.parametrize(("name", "status"), [("SIGTERM", 143), ("SIGINT", 130)])
def test_stopped_politely_several_times(undisturbed, command, command_environment, tmp_path, name, status):
    """Each time it saves what it has, says where, and goes on from there."""
    expected, _, _ = undisturbed
    folder, done = tmp_path / "run", []
    for lines in (5, 41):
        with training(command_environment, *RUN, f"run_dir={folder}", "resume=auto") as process:
            has_written(process, folder, lines)
            process.send_signal(signal.Signals[name])
            said = process.stdout.read()
            assert process.wait(timeout=60) == status, said
        steps = re.search(rf"{name}: stopped at ([\d,]+) steps; resume={re.escape(str(folder))} continues", said)[1]
        done.append(int(steps.replace(",", "")))
        assert outcome(folder)[0][-1]["steps"] == done[-1]
    assert done == sorted(done)
    assert command("train", *RUN, f"run_dir={folder}", "resume=auto").returncode == 0
    lines, _, digest = outcome(folder)
    assert (lines, digest) == (expected[0], expected[2])


@pytest.mark.faults
def test_a_second_sigint_stops_at_once(command_environment, tmp_path):
    """While a chunk of minutes is computed: the first one waits for its end."""
    sizes = ("log_interval=200000000", "total_steps=200000000", "eval_interval=200000000")
    folder = tmp_path / "run"
    arguments = [argument for argument in RUN if argument.partition("=")[0] not in {s.partition("=")[0] for s in sizes}]
    with training(command_environment, *arguments, *sizes, f"run_dir={folder}") as process:
        for line in process.stdout:
            if line.startswith("compiled in"):
                break
        time.sleep(1)
        process.send_signal(signal.SIGINT)
        with pytest.raises(Exception, match="timed out"):
            process.wait(timeout=1)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) in (130, -signal.SIGINT)
