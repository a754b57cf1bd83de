"""Settings that must be made before JAX starts its backend."""

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

# LLVM's optimization levels. With 3, XLA's default, a training compiles a quarter longer and runs no faster.
OPTIMIZED: dict[str, Any]
RUN_ONCE: dict[str, Any]
OPTIMIZED, RUN_ONCE = ({"xla_backend_optimization_level": level} for level in (2, 0))


def prepare(config: Config, threads: int | None = None, divided: bool = False) -> None:
    """Starts the backend with a fixed number of XLA threads, as the bits of large reductions depend on it.

    Args:
      config: configuration of the run. Environments of other libraries call LAPACK, which needs a single thread on some
        jaxlib releases.
      threads: number of threads of the run being resumed; by default `count_threads`.
      divided: whether each thread has a device of its own, over which `envs.batches.divide_batch` divides episodes, and
        not each shard of a training.

    Raises:
      UserError: an environment variable sets JAX up in a way that training does not support.
    """
    _check_variables()
    if threads is None and config.choices["env"] in LIBRARIES and may_deadlock(jaxlib.version.__version__):
        threads = 1
    threads = threads or count_threads()
    os.environ["PJRT_NPROC"] = str(threads)
    with contextlib.suppress(RuntimeError):  # raised if the backend has already started
        jax.config.update("jax_num_cpu_devices", threads if divided else config.num_shards)
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # the latter has no message, if there is no plugin for the platform
        reason = (str(error).splitlines() or ["no such platform on this machine; use cpu"])[0]
        raise UserError(f"JAX_PLATFORMS={jax.config.values['jax_platforms']}: {reason}") from error


def count_threads() -> int:
    """Number of XLA threads: PJRT_NPROC if it is set, else the number of cores that this process may use."""
    variable = os.environ.get("PJRT_NPROC")
    if variable:
        return int(variable)
    # macOS has no sched_getaffinity: all cores there.
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
    if flags:  # XLA ends the process at an unknown flag, so try them in another one
        command = [sys.executable, "-c", "import jax; jax.devices()"]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode:
            lines = [line for line in result.stderr.splitlines() if "flag" in line.lower()]
            reason = lines[0].rpartition("] ")[2] if lines else f"status {result.returncode}"
            raise UserError(f"XLA_FLAGS={flags}: XLA does not start with it ({reason})")
