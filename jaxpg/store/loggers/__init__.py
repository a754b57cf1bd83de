"""Loggers besides `metrics.jsonl`: always TensorBoard, on request Weights & Biases and MLflow.

Each is a `Logger`, with one file per library, and its failures never stop a run. TensorBoard's file is written by the
training process itself. The others take seconds to import, wait for networks and databases, install hooks and write to
the terminal. So each runs in its own process, which reads the lines from `metrics.jsonl` (follower.py, sender.py).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Protocol

SERVICES = {
    "wandb": "jaxpg.store.loggers.weights_and_biases",
    "mlflow": "jaxpg.store.loggers.mlflow",
}


class LoggerError(Exception):
    """A failure of a logger; the text follows "note: NAME: "."""


class Logger(Protocol):
    """Starts when it is created, takes values by environment steps, and ends when it is closed."""

    def write(self, values: Mapping[str, float], step: int) -> None: ...

    def close(self) -> None: ...


class Service(Logger, Protocol):
    """A logger that a module in `SERVICES` creates with `begin(folder, name, config)`.

    The module's `packages()` are the packages that it requires.

    Attributes:
      last: the last step logged by an earlier part of the run; -1 if there is none.
    """

    last: int


class SafeLogger:
    """A logger whose failures do not stop a run: the first gives a note, and nothing more is logged.

    Args:
      begin: creates the logger.
      name: its name in the note.
      say: takes the note.
    """

    def __init__(self, begin: Callable[[], Logger], name: object, say: Callable[[str], None]):
        self._name, self._say = name, say
        self._logger: Logger | None = None
        with self._catch_failures():
            self._logger = begin()

    def write(self, values: Mapping[str, float], step: int) -> None:
        if self._logger is not None:
            with self._catch_failures():
                self._logger.write(values, step)

    def close(self) -> None:
        if self._logger is not None:
            with self._catch_failures():
                self._logger.close()

    @contextlib.contextmanager
    def _catch_failures(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._give_up(f"cannot be written ({error.strerror}); it gets no more metrics")
        except LoggerError as error:
            self._give_up(str(error))

    def _give_up(self, reason: str) -> None:
        self._logger = None
        self._say(f"note: {self._name}: {reason}")


def mean_values(line: Mapping[str, Any]) -> dict[str, float]:
    """The values for loggers in a line of metrics: means over the agents that have a number."""
    means = {name: _mean(value) for name, value in line.items() if name not in ("update", "steps")}
    return {name: mean for name, mean in means.items() if mean is not None}


def _mean(value: Any) -> float | None:
    numbers = [x for x in (value if isinstance(value, list) else [value]) if x is not None]
    return sum(numbers) / len(numbers) if numbers else None
