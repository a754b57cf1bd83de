"""Shared by all tests: strict JAX settings, a compilation cache for the session, and how commands are run."""

import gc
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import pytest

jax.config.update("jax_debug_key_reuse", True)
jax.config.update("jax_num_cpu_devices", 2)  # for the tests of shards

os.environ.setdefault("JAXPG_RAISE", "1")  # bugs in what is drawn of a run are raised, also in commands

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in the background of a shell: commands would be deaf to it
    signal.signal(signal.SIGINT, signal.default_int_handler)

ROOT = Path(__file__).parent.parent

SLOW = frozenset((ROOT / "tests" / "slow.txt").read_text(encoding="utf-8").split())  # files
BEGAN = time.monotonic()
MEMORY = 1.5e9  # bytes, beyond which a worker gives up what it has compiled


def pytest_addoption(parser):
    parser.addoption(
        "--minutes", type=float, default=math.inf, help="slow tests that would begin after so many minutes are skipped"
    )


def is_slow(item):
    return item.nodeid.partition("::")[0] in SLOW


def pytest_collection_modifyitems(items):
    """The quick ones first: they are run on any machine."""
    items.sort(key=is_slow)


def pytest_runtest_setup(item):
    """Compiles quickly; and on a machine that is many times slower than usual a part of the slow tests has to do."""
    jax.config.update("jax_disable_most_optimizations", item.get_closest_marker("optimized") is None)
    if is_slow(item) and time.monotonic() - BEGAN > 60 * item.config.getoption("minutes"):
        pytest.skip("slow, and the time given with --minutes is over")


@pytest.fixture(scope="module", autouse=True)
def _release_memory():
    """JAX keeps all that was compiled: by the last file a worker would hold gigabytes."""
    yield
    if resident_memory() > MEMORY:
        jax.clear_caches()
        gc.collect()


def resident_memory():
    """Bytes of this process in memory; 0 where the system does not say."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


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
