"""Metrics for TensorBoard."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

FLUSH_INTERVAL = 10.0  # seconds; each flush waits for the disk


class TensorBoard:
    """Scalars in an event file, written by the caller's own thread.

    tensorboardX's SummaryWriter has a thread for it: where the disk is full that ends with a traceback, and then the
    training waits for ever to hand its values over.

    Args:
      folder: where the event file will be.
      purge_step: what TensorBoard has from an earlier part of the run at this step or later, it forgets.

    Raises:
      OSError: here and below, the file cannot be written.
    """

    def __init__(self, folder: Path, purge_step: int):
        self._writer = _writer(folder, purge_step)
        self._flushed = time.monotonic()

    def write(self, values: Mapping[str, float], step: int) -> None:
        """Adds values at a step, counted in environment steps."""
        self._writer.write_event(_event(values, step))
        if time.monotonic() - self._flushed > FLUSH_INTERVAL:
            self._writer.flush()
            self._flushed = time.monotonic()

    def close(self) -> None:
        self._writer.close()


def _writer(folder: Path, purge_step: int):
    from tensorboardX.event_file_writer import EventsWriter
    from tensorboardX.proto.event_pb2 import Event, SessionLog

    folder.mkdir(exist_ok=True)
    writer = EventsWriter(str(folder / "events"))
    start = SessionLog(status=SessionLog.START)
    writer.write_event(Event(step=purge_step, wall_time=time.time(), session_log=start))
    writer.flush()
    return writer


def _event(values: Mapping[str, float], step: int):
    from tensorboardX.proto.event_pb2 import Event
    from tensorboardX.proto.summary_pb2 import Summary

    scalars = [Summary.Value(tag=name, simple_value=value) for name, value in values.items()]
    return Event(step=step, wall_time=time.time(), summary=Summary(value=scalars))
