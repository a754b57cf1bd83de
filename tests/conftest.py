"""Shared by all tests: strict JAX settings, a compilation cache for the session, and how commands are run."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import jax
import pytest

jax.config.update("jax_debug_key_reuse", True)
jax.config.update("jax_num_cpu_devices", 2)  # for the tests of shards

os.environ.setdefault("JAXPG_RAISE", "1")  # bugs in what is drawn of a run are raised, also in commands

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in the background of a shell: commands would be deaf to it
    signal.signal(signal.SIGINT, signal.default_int_handler)

ROOT = Path(__file__).parent.parent

SLOW = frozenset((ROOT / "tests" / "slow.txt").read_text(encoding="utf-8").split("\n"))


@pytest.hookimpl(tryfirst=True)  # before the tests are chosen by their markers
def pytest_collection_modifyitems(items):
    """Marks as `study` what compiles for so long that the suite would take more than twenty minutes with it."""
    for item in items:
        if item.nodeid in SLOW:
            item.add_marker(pytest.mark.study)


@pytest.fixture(scope="session")
def command_environment(tmp_path_factory):
    """The environment of commands under test: they share a cache of their own, so that a program compiles once."""
    session = tmp_path_factory.getbasetemp()
    cache = str((session.parent if "PYTEST_XDIST_WORKER" in os.environ else session) / "cache")  # of all workers
    environment = os.environ | {"XDG_CACHE_HOME": cache, "PYTHONIOENCODING": "utf-8", "COLUMNS": "120"}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)  # with it jax's own cache would be used instead
    return environment


@pytest.fixture(scope="session")
def command(command_environment):
    """`command("train", "env=pendulum", ...)` runs `python -m jaxpg.train env=pendulum ...` to its end."""

    def run(verb, *arguments, cwd=ROOT, timeout=600):
        return subprocess.run(
            [sys.executable, "-m", f"jaxpg.{verb}", *arguments],
            cwd=cwd,
            env=command_environment,
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )

    return run
