"""The display of a run: a progress bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)


class Display:
    """Progress of a run: each agent takes `total_steps` environment steps, and has taken `steps` of them."""

    def __init__(self, total_steps: int, steps: int = 0, num_agents: int = 1):
        self.console = Console(highlight=False, soft_wrap=True)
        self._total, self._num_agents = total_steps, num_agents
        self._first_steps, self._began = steps, time.monotonic()
        self._bar = None
        if self.console.is_terminal:
            columns = (TextColumn("training"), BarColumn(bar_width=24), TaskProgressColumn(), TimeRemainingColumn())
            self._bar = Progress(*columns, TextColumn("{task.description}"), console=self.console)
            self._task = self._bar.add_task("", total=total_steps, completed=steps)

    def say(self, text: str) -> None:
        self.console.print(text, markup=False)

    @contextmanager
    def show_status(self, text: str) -> Iterator[None]:
        """Shows what the block is doing: with a running clock on a terminal, as a line elsewhere."""
        if not self.console.is_terminal:
            self.say(f"{text} ...")
            yield
            return
        columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn())
        with Progress(*columns, console=self.console, transient=True) as clock:
            clock.add_task(text, total=None)
            yield

    def start(self) -> None:
        """Starts the clock and the progress bar."""
        self._began = time.monotonic()
        if self._bar:
            self._bar.start()

    def update(self, line: dict[str, Any]) -> None:
        """Shows a line of metrics on the progress bar; one with an evaluation is also printed."""
        seconds = time.monotonic() - self._began
        rate = (line["steps"] - self._first_steps) / max(seconds, 1e-9)
        text = f"{rate * self._num_agents:,.0f} steps/s  return {format_metric(line.get('return'))}"
        if self._bar:
            self._bar.update(self._task, completed=line["steps"], description=text)
        if "eval_return" in line:
            left = (self._total - line["steps"]) / rate
            self.say(
                f"{line['steps'] / self._total:4.0%}  {line['steps']:>12,} steps  {text}  "
                f"deterministic {format_metric(line['eval_return'])}  {left:.0f} s left"
            )

    def stop(self) -> None:
        if self._bar:
            self._bar.stop()

    def show_table(self, rows: dict[str, str]) -> None:
        """The short table at the end."""
        width = max(map(len, rows)) + 2
        for name, value in rows.items():
            self.say(f"{name:<{width}}{value}")


def format_metric(value: Any) -> str:
    """A metric as text: the mean over several agents; n/a if there is no value yet."""
    numbers = [x for x in (value if isinstance(value, list) else [value]) if x is not None]
    return f"{sum(numbers) / len(numbers):.1f}" if numbers else "n/a"
