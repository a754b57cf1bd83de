"""Where metrics go besides `metrics.jsonl`: TensorBoard always, Weights & Biases and MLflow where they are asked for.

Each is a `Logger`, one file for each library, and its failures never stop a run. TensorBoard's file is written by the
training process itself. The others take seconds to import and wait for networks and databases, install hooks and talk
to the terminal: each has a process of its own, which reads the lines from `metrics.jsonl` (follower.py, sender.py).
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
    """What has become of a logger; its text goes on after "note: NAME: "."""


class Logger(Protocol):
    """Begins when it is made; takes values, counted in environment steps; ends when it is closed."""

    def write(self, values: Mapping[str, float], step: int) -> None: ...

    def close(self) -> None: ...


class Service(Logger, Protocol):
    """A logger that a module in `SERVICES` makes, as `begin(folder, name, config)`.

    The module's `packages()` are those that it cannot do without.

    Attributes:
      last: the last step that it has had from an earlier part of the run; -1 where there is none.
    """

    last: int


class UntilItFails:
    """A logger whose failures do not stop a run: there is one note, and nothing more is written to it.

    Args:
      begin: makes the logger.
      name: what the note calls it.
      say: takes the note.
    """

    def __init__(self, begin: Callable[[], Logger], name: object, say: Callable[[str], None]):
        self._name, self._say = name, say
        self._logger: Logger | None = None
        with self._noted():
            self._logger = begin()

    def write(self, values: Mapping[str, float], step: int) -> None:
        if self._logger is not None:
            with self._noted():
                self._logger.write(values, step)

    def close(self) -> None:
        if self._logger is not None:
            with self._noted():
                self._logger.close()

    @contextlib.contextmanager
    def _noted(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._give_up(f"cannot be written ({error.strerror}); it gets no more metrics")
        except LoggerError as error:
            self._give_up(str(error))

    def _give_up(self, reason: str) -> None:
        self._logger = None
        self._say(f"note: {self._name}: {reason}")


def values_of(line: Mapping[str, Any]) -> dict[str, float]:
    """What loggers get of a line of metrics: means over the agents that have a number; without it, no value."""
    means = {name: _mean(value) for name, value in line.items() if name not in ("update", "steps")}
    return {name: mean for name, mean in means.items() if mean is not None}


def _mean(value: Any) -> float | None:
    numbers = [x for x in (value if isinstance(value, list) else [value]) if x is not None]
    return sum(numbers) / len(numbers) if numbers else None
