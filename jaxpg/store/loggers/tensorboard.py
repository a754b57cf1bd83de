"""Metrics for TensorBoard."""

from __future__ import annotations

import contextlib
import os
import re
import struct
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from jaxpg.store import files

FLUSH_INTERVAL = 10.0  # seconds; each flush waits for the disk


class TensorBoard:
    """Scalars in an event file, written by the caller's own thread.

    tensorboardX's SummaryWriter writes in a thread of its own: on a full disk that ends with a traceback, and then the
    training would hang.

    Args:
      folder: folder of the event file.
      purge_step: TensorBoard drops what earlier parts of the run logged at this step or later.

    Raises:
      OSError: here and in all methods, the file cannot be written.
    """

    def __init__(self, folder: Path, purge_step: int):
        from tensorboardX.proto.event_pb2 import Event, SessionLog

        self._file = _Records(folder)
        with self._close_on_failure():
            self._file.write(Event(wall_time=time.time(), file_version="brain.Event:2").SerializeToString())
            start = SessionLog(status=SessionLog.START)
            self._file.write(Event(step=purge_step, wall_time=time.time(), session_log=start).SerializeToString())
            self._file.flush()
        self._flushed = time.monotonic()

    def write(self, values: Mapping[str, float], step: int) -> None:
        """Adds values at a step, counted in environment steps."""
        with self._close_on_failure():
            self._file.write(_make_event(values, step).SerializeToString())
            if time.monotonic() - self._flushed > FLUSH_INTERVAL:
                self._file.flush()
                self._flushed = time.monotonic()

    def close(self) -> None:
        with self._close_on_failure():
            self._file.flush()
            self._file.close()

    @contextlib.contextmanager
    def _close_on_failure(self) -> Iterator[None]:
        """Otherwise Python would try to write the rest when it frees the file, and since 3.13 print a traceback."""
        try:
            yield
        except OSError:
            with contextlib.suppress(OSError):
                self._file.close()
            raise


class _Records:
    """A new file of records, as tensorboardX's RecordWriter writes them, which takes some file names for URLs."""

    def __init__(self, folder: Path):
        with files.open_folder(folder, make=True) as place:
            new = os.O_WRONLY | os.O_CREAT | os.O_EXCL
            self._file = os.fdopen(files.open_at(place, _next_name(os.listdir(place)), new), "wb")
        self.flush, self.close = self._file.flush, self._file.close

    def write(self, content: bytes) -> None:
        length = struct.pack("<Q", len(content))
        self._file.write(length + _checksum(length) + content + _checksum(content))


def _checksum(content: bytes) -> bytes:
    from tensorboardX.record_writer import masked_crc32c

    return struct.pack("<I", masked_crc32c(content))


def _next_name(names: Sequence[str]) -> str:
    """The name of the next event file; TensorBoard reads them in the order of their names.

    tensorboardX's own names begin with the time: if the clock was set back, a later part of the run would come before
    an earlier one, and be dropped.
    """
    numbers = [int(found[1]) for name in names if (found := re.match(r"events_(\d{6})\.", name))]
    return f"events_{max(numbers, default=0) + 1:06d}.out.tfevents"


def _make_event(values: Mapping[str, float], step: int):
    from tensorboardX.proto.event_pb2 import Event
    from tensorboardX.proto.summary_pb2 import Summary

    scalars = [Summary.Value(tag=name, simple_value=value) for name, value in values.items()]
    return Event(step=step, wall_time=time.time(), summary=Summary(value=scalars))
