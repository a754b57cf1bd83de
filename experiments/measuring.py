"""Measurements of speed: calls per second, on all cores."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from envs.batches import LANES, divide_batch

CORES = len(os.sched_getaffinity(0))


def divide_cpu() -> None:
    """A device for each core; a process that has used its devices keeps them."""
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", CORES)


def count_parts(num_envs: int) -> int:
    """Into how many equal parts a batch is divided: one for each core, or 1 if it does not divide or devices lack."""
    return CORES if len(jax.devices()) >= CORES and num_envs % (LANES * CORES) == 0 else 1


def compile_in_parts(function: Callable, number: int, in_axes: int | Sequence[int | None] = 0) -> Any:
    """The function, compiled, of a batch that is divided over so many devices."""
    return jax.jit(function) if number == 1 else divide_batch(function, in_axes, jax.devices()[:number])


def time_calls(call: Callable[[], Any], seconds: float) -> np.ndarray:
    """Calls per second, and per second of all cores' time, over at least so many seconds."""
    began, began_cores, number = time.perf_counter(), time.process_time(), 0
    while number == 0 or time.perf_counter() - began < seconds:
        call()
        number += 1
    return number / np.array([time.perf_counter() - began, time.process_time() - began_cores])


def summarise(values: np.ndarray) -> tuple[float, float, float]:
    """(smallest, median, largest)."""
    return float(values.min()), float(np.median(values)), float(values.max())
