"""What has to be settled before JAX starts its backend."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from typing import Any

import jax
import jaxlib.version

from jaxpg.compatibility import may_deadlock
from jaxpg.config.configuration import LIBRARIES, Config
from jaxpg.errors import UserError

# Of LLVM. With 3, XLA's default, a training compiles a quarter longer and runs no faster.
OPTIMIZED: dict[str, Any]
RUN_ONCE: dict[str, Any]
OPTIMIZED, RUN_ONCE = ({"xla_backend_optimization_level": level} for level in (2, 0))


def prepare(config: Config, threads: int | None = None) -> None:
    """Starts the backend, with the number of XLA's threads pinned, on which the bits of large reductions depend.

    Args:
      config: environments of other libraries make LAPACK calls, which need a single thread on some jaxlib releases.
      threads: those of the run that is resumed; by default as many as there are cores.

    Raises:
      UserError: the process's environment asks JAX for something that cannot be trained with.
    """
    _check_variables()
    if threads is None and config.choices["env"] in LIBRARIES and may_deadlock(jaxlib.version.__version__):
        threads = 1
    os.environ["PJRT_NPROC"] = str(threads or num_threads())
    with contextlib.suppress(RuntimeError):  # where the process has computed something already, with what it has
        jax.config.update("jax_num_cpu_devices", config.num_shards)
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # the latter, without words, where jax has no plugin for it
        reason = (str(error).splitlines() or ["there is no such platform here; cpu is one"])[0]
        raise UserError(f"JAX_PLATFORMS={jax.config.values['jax_platforms']}: {reason}") from error


def num_threads() -> int:
    """XLA's threads: results of large reductions depend on their number, so it is pinned and recorded."""
    asked = os.environ.get("PJRT_NPROC")
    if asked:
        return int(asked)
    # The cores that this process may use; where nobody knows, as on a Mac, all.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _check_variables() -> None:
    if jax.config.values["jax_enable_x64"]:
        raise UserError("JAX_ENABLE_X64: training is in float32; unset it")
    if jax.config.values["jax_disable_jit"]:
        raise UserError("JAX_DISABLE_JIT: training is one compiled program; unset it")
    threads = os.environ.get("PJRT_NPROC")
    if threads and not (threads.isascii() and threads.isdigit() and int(threads)):
        raise UserError(f"PJRT_NPROC={threads}: expected a whole number of threads, at least 1")
    flags = os.environ.get("XLA_FLAGS")
    if flags:  # at one that it does not know XLA ends the process
        attempt = [sys.executable, "-c", "import jax; jax.devices()"]
        ended = subprocess.run(attempt, capture_output=True, text=True, check=False)
        if ended.returncode:
            lines = [line for line in ended.stderr.splitlines() if "flag" in line.lower()]
            reason = lines[0].rpartition("] ")[2] if lines else f"status {ended.returncode}"
            raise UserError(f"XLA_FLAGS={flags}: XLA does not start with it ({reason})")
