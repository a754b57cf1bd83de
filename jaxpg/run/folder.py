"""The run folder: what is in it, and under which name.

config.yaml         the options, complete
versions.json       what computed it
metrics.jsonl       one line for each chunk of updates
tb/                 the same for TensorBoard
loggers/            what other loggers keep there, where they are asked for
checkpoints/        the whole training state, the newest few
best/               the best policy so far
learning_curve.png  the curve
report.html         the run as a page: curves, episodes to watch, options
video.mp4           episodes as a video, where one was asked for
lock                who is training in it, for as long as it does
"""

from __future__ import annotations

import contextlib
import errno
import importlib.metadata
import itertools
import json
import os
import platform
import re
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxpg.run import lock
from jaxpg.run.config import Config
from jaxpg.run.errors import UserError
from jaxpg.run.files import UNFINISHED, replace
from jaxpg.run.loggers import UntilItFails, values_of
from jaxpg.run.loggers.follower import Follower
from jaxpg.run.loggers.tensorboard import TensorBoard

LONGEST_TASK = 100  # letters of the task's name in a folder's: file systems take 255 bytes
RECORDED_PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "orbax-checkpoint", "numpy")


class RunFolder:
    """The paths of one run."""

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.config = self.path / "config.yaml"
        self.versions = self.path / "versions.json"
        self.metrics = self.path / "metrics.jsonl"
        self.tensorboard = self.path / "tb"
        self.loggers = self.path / "loggers"
        self.checkpoints = self.path / "checkpoints"
        self.best = self.path / "best"
        self.learning_curve = self.path / "learning_curve.png"
        self.report = self.path / "report.html"


def planned(config: Config) -> RunFolder:
    """The run folder asked for, of which nothing is made yet; or else `runs/<env>-<algo>-s<seed>-<time>`, which is.

    Raises:
      UserError: it has a name that orbax takes for a pattern.
    """
    run = config.run
    if run.run_dir is not None:
        folder = RunFolder(run.run_dir)
    else:
        task = re.sub(r"[^\w.-]", "_", config.task)[:LONGEST_TASK].lstrip(".-")
        stamp = time.strftime("%Y%m%d-%H%M%S")
        folder = RunFolder(_made(Path("runs") / f"{task}-{config.choices['algo']}-s{run.seed}-{stamp}"))
    if set("[]") & set(str(folder.path.resolve())):
        raise UserError(f"{folder.path}: checkpoints cannot be kept below a folder with [ or ] in its name")
    return folder


def _made(path: Path) -> Path:
    """A new folder of that name, or of one with a number after it: runs that begin in the same second have their own."""
    with _reported(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        for number in itertools.count(1):
            folder = path if number == 1 else path.with_name(f"{path.name}-{number}")
            with contextlib.suppress(FileExistsError):
                folder.mkdir()
                return folder


def check_empty(folder: RunFolder) -> None:
    """Raises UserError where something is in the folder already, or where there can be none."""
    if _names(folder.path):
        raise UserError(f"{folder.path} is not empty: take another run_dir, or resume={folder.path}")


def check_nothing_to_lose(folder: RunFolder) -> None:
    """Raises UserError where there is more in the folder than a run leaves that ended before its first checkpoint."""
    if not _is_run(folder) or _has_numbers(folder.checkpoints) or _has_numbers(folder.best):
        check_empty(folder)


def has_checkpoints(folder: RunFolder) -> bool:
    """Whether it is the folder of a run with something to resume."""
    return folder.config.is_file() and _has_numbers(folder.checkpoints)


def _has_numbers(path: Path) -> bool:
    """Whether a checkpoint is there, sound or not: its name is its number."""
    return any(name.isdigit() for name in _names(path))


def _names(path: Path) -> list[str]:
    """What is in a folder, but for what a process leaves that was killed: its lock and unfinished files."""
    with _reported(path):
        names = [entry.name for entry in path.iterdir()] if path.exists() else []
    return [name for name in names if name != lock.NAME and not name.endswith(UNFINISHED)]


def _is_run(folder: RunFolder) -> bool:
    """Whether a run of ours began there: `versions.json` is the first that it writes."""
    try:
        return "jaxlib" in read_versions(folder)
    except UserError:
        return False


@contextlib.contextmanager
def owned(folder: RunFolder, say: Callable[[str], None]) -> Iterator[None]:
    """The folder, made where there is none, is this process's inside.

    Args:
      folder: of the run.
      say: takes a note, where the folder cannot be locked.

    Raises:
      UserError: it is another's, or cannot be made or written to.
    """
    with contextlib.ExitStack() as stack:
        with _reported(folder.path):
            folder.path.mkdir(parents=True, exist_ok=True)
            stack.enter_context(lock.held(folder.path, say))
        yield


@contextlib.contextmanager
def _reported(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise UserError(f"{path}: cannot write a run folder there ({error.strerror})") from error


def find(path: str) -> RunFolder:
    """The run folder at `path`; raises UserError where there is none."""
    folder = RunFolder(path)
    if not folder.config.is_file():
        raise UserError(f"{path} is not a run folder: it has no config.yaml")
    return folder


def versions() -> dict[str, Any]:
    """What the bits of a run depend on besides its options."""
    packages = {name: importlib.metadata.version(name) for name in RECORDED_PACKAGES}
    machine = {"python": platform.python_version(), "machine": platform.machine(), "threads": num_threads()}
    devices = f"{jax.device_count()} {jax.default_backend()}"
    return packages | machine | {"devices": devices, "xla_flags": os.environ.get("XLA_FLAGS", "")}


def write_versions(folder: RunFolder) -> None:
    """Writes `versions.json`, the first file of a run."""
    replace(folder.versions, json.dumps(versions(), indent=1))


def change_versions(folder: RunFolder, recorded: dict[str, Any], now: dict[str, Any]) -> None:
    """Records what goes on with a run; what computed it before stays in `versions.json` too, as `earlier`."""
    before = {name: value for name, value in recorded.items() if name != "earlier"}
    replace(folder.versions, json.dumps({**now, "earlier": [*recorded.get("earlier", []), before]}, indent=1))


def read_versions(folder: RunFolder) -> dict[str, Any]:
    """What computed the run; raises UserError if the file cannot be read, or is not as `write_versions` left it."""
    try:
        recorded = json.loads(folder.versions.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"{folder.versions}: cannot be read ({error})") from error
    threads = recorded.get("threads", 1) if isinstance(recorded, dict) else None
    if type(threads) is not int or threads < 1:
        raise UserError(f"{folder.versions}: not what a run writes there, an object whose threads is at least 1")
    return recorded


def num_threads() -> int:
    """XLA's threads: results of large reductions depend on their number, so it is pinned and recorded."""
    return int(os.environ.get("PJRT_NPROC") or len(os.sched_getaffinity(0)))


class MetricsLog:
    """`metrics.jsonl`, TensorBoard and other loggers; on resume, lines after the checkpoint are taken back.

    Lines that cannot be written wait in memory, and are written before the next one. The file is opened anew for each:
    the folder may be another's, or gone.

    Args:
      folder: the run.
      update: updates made so far; later lines are removed.
      say: takes notes of what cannot be written.
      loggers: names of the others, in `SERVICES`.

    Raises:
      UserError: the file cannot be written when the run begins.
    """

    def __init__(self, folder: RunFolder, update: int, say: Callable[[str], None], loggers: Sequence[str] = ()):
        kept = [line for line in read_metrics(folder) if line["update"] <= update]
        text = "".join(map(_json_line, kept))
        replace(folder.metrics, text)
        self._path, self._say = folder.metrics, say
        self._size = len(text)  # of the whole lines in the file; in ASCII a character is a byte
        self._waiting = ""
        purge_step = kept[-1]["steps"] + 1 if kept else 0
        self._loggers = [UntilItFails(partial(TensorBoard, folder.tensorboard, purge_step), folder.tensorboard, say)]
        for name in dict.fromkeys(loggers):
            begin = partial(Follower, name, folder.metrics, folder.config, folder.loggers)
            self._loggers.append(UntilItFails(begin, name, say))
        self.seconds = kept[-1]["seconds"] if kept else 0.0

    def write(self, line: dict[str, Any]) -> None:
        """Adds one line; values are numbers, or lists of them with one for each agent."""
        first = not self._waiting
        self._waiting += _json_line(line)
        try:
            self.flush()
        except OSError as error:
            if first:
                self._say(f"note: {self._path}: cannot be written ({error.strerror}); lines wait until it can")
        values = values_of(line)
        for logger in self._loggers:
            logger.write(values, line["steps"])

    def flush(self) -> None:
        """Writes the lines that wait; raises OSError where the file has not got all of them."""
        if not self._waiting:
            return
        with self._path.open("r+b") as file:
            if file.seek(0, os.SEEK_END) < self._size:
                raise OSError(errno.EIO, "lines that were written are not there any more")
            file.truncate(self._size)  # what a failure has left of a line
            file.seek(self._size)
            file.write(self._waiting.encode())
        self._size += len(self._waiting)
        self._waiting = ""

    def close(self) -> None:
        for logger in self._loggers:
            logger.close()


def read_metrics(folder: RunFolder) -> list[dict[str, Any]]:
    """The lines of `metrics.jsonl`, without a torn last one; empty where there is no file."""
    lines = []
    for text in folder.metrics.read_text(encoding="utf-8").splitlines() if folder.metrics.exists() else []:
        try:
            lines.append(json.loads(text))
        except json.JSONDecodeError:
            break
    return lines


def jsonable(values: np.ndarray) -> Any:
    """A number, or a list of them where there are several agents; what is not finite becomes None."""
    numbers = [float(x) if np.isfinite(x) else None for x in np.atleast_1d(values)]
    return numbers[0] if len(numbers) == 1 else numbers


def _json_line(line: dict[str, Any]) -> str:
    return json.dumps(line, allow_nan=False) + "\n"
