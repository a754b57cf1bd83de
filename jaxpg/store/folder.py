"""The run folder and its files.

config.yaml         all options
versions.json       versions and machine
metrics.jsonl       one line for each chunk of updates
tb/                 the same for TensorBoard
loggers/            files of other loggers, if any
checkpoints/        the whole training state, the newest few
best/               the best policy so far
learning_curve.png  the curve
report.html         the run as a page: curves, episodes to watch, options
video.mp4           episodes as a video, if rendered
lock                the process that is training in it
"""

from __future__ import annotations

import contextlib
import os
import re
import stat
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxpg.config.configuration import Config
from jaxpg.errors import UserError
from jaxpg.store import files, lock, versions_file
from jaxpg.store.files import UNFINISHED
from jaxpg.store.lines import parse_lines

MAX_TASK_LENGTH = 100  # characters of the task in a folder's name: file systems allow 255 bytes
PATTERN_CHARACTERS = "\\[]*?"  # characters with a special meaning in paths of orbax and tensorstore


class RunFolder:
    """The paths of a run, below its original folder name."""

    def __init__(self, path: str | Path):
        self._given = Path(path)
        self.config = self._given / "config.yaml"
        self.versions = self._given / "versions.json"
        self.metrics = self._given / "metrics.jsonl"
        self.tensorboard = self._given / "tb"
        self.loggers = self._given / "loggers"
        self.checkpoints = self._given / "checkpoints"
        self.best = self._given / "best"
        self.learning_curve = self._given / "learning_curve.png"
        self.report = self._given / "report.html"

    @property
    def path(self) -> Path:
        """The folder's path; if this process has locked the folder, its present path after a move."""
        return files.find_path(self._given)


def choose(config: Config) -> RunFolder:
    """The run folder `run_dir`, not yet created; without one, a new folder `runs/<env>-<algo>-s<seed>-<time>`.

    Raises:
      UserError: the name cannot be printed on one line, or orbax cannot handle it.
    """
    run = config.run
    if run.run_dir is not None:
        folder = RunFolder(run.run_dir)
    else:
        task = re.sub(r"[^\w.-]", "_", config.task)[:MAX_TASK_LENGTH].lstrip(".-")
        stamp = time.strftime("%Y%m%d-%H%M%S")
        folder = RunFolder(_make_new(Path("runs") / f"{task}-{config.choices['algo']}-s{run.seed}-{stamp}"))
    _check_name(folder.path)
    return folder


def _make_new(path: Path) -> Path:
    """Creates a folder of that name, with a number appended if runs start in the same second."""
    with _report_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    folder, number = path, 1
    while True:
        with _report_errors(path), contextlib.suppress(FileExistsError):
            folder.mkdir()
            return folder
        number += 1
        folder = path.with_name(f"{path.name}-{number}")


def _check_name(path: Path) -> None:
    """Raises UserError for a name that cannot be printed, or from which orbax cannot read."""
    if not str(path).isprintable():
        raise UserError(f"run_dir={str(path)!r}: expected printable characters in UTF-8")
    patterns = sorted(set(PATTERN_CHARACTERS) & set(str(path.absolute())))
    if patterns and not files.has_descriptor_paths():
        raise UserError(
            f"{path}: on this system checkpoints cannot be kept below a folder with {patterns[0]} in its name"
        )


def check_empty(folder: RunFolder) -> None:
    """Raises UserError if the folder is not empty, or cannot be one."""
    if _list_names(folder.path):
        advice = ""
        if _has_numbers(folder.checkpoints):
            advice = f", or resume={folder.path}"
        elif _ended_early(folder):
            advice = ", or add resume=auto to begin here again"
        raise UserError(f"{folder.path} is not empty: choose another run_dir{advice}")


def check_nothing_to_lose(folder: RunFolder) -> None:
    """Raises UserError if the folder holds more than a run leaves that ended before its first checkpoint."""
    if not _ended_early(folder):
        check_empty(folder)


def _ended_early(folder: RunFolder) -> bool:
    """Whether a run of ours began there, and ended before its first checkpoint."""
    return _is_run(folder) and not _has_numbers(folder.checkpoints) and not _has_numbers(folder.best)


def has_checkpoints(folder: RunFolder) -> bool:
    """Whether the folder holds a run with a checkpoint."""
    return _has_config(folder) and _has_numbers(folder.checkpoints)


def _has_numbers(path: Path) -> bool:
    """Whether there is a checkpoint, sound or not: its name is a number."""
    return any(name.isdigit() for name in _list_names(path))


def _list_names(path: Path) -> list[str]:
    """The names in a folder, except for what a killed process leaves: its lock and unfinished files."""
    with _report_errors(path):
        names = [entry.name for entry in path.iterdir()] if path.exists() else []
    return [name for name in names if name != lock.NAME and not name.endswith(UNFINISHED)]


def _is_run(folder: RunFolder) -> bool:
    """Whether one of our runs began there: it writes `versions.json` first."""
    try:
        return "jaxlib" in versions_file.read(folder.versions)
    except UserError:
        return False


@contextlib.contextmanager
def own(folder: RunFolder, say: Callable[[str], None]) -> Iterator[None]:
    """Creates the folder if needed and locks it in the block; its paths lead there even if it is moved.

    Args:
      folder: the run folder.
      say: takes a note if the folder cannot be locked.

    Raises:
      UserError: another process owns the folder, or it cannot be created or written.
    """
    path = folder.path
    with contextlib.ExitStack() as stack:
        with _report_errors(path):
            path.mkdir(parents=True, exist_ok=True)
            descriptor = stack.enter_context(lock.hold(path, say))
        stack.enter_context(files.redirect(path, descriptor))
        for place in (folder.checkpoints, folder.best):
            _check_no_links(place)
        yield


def _check_no_links(place: Path) -> None:
    """Raises UserError if the path is not a folder, or links are in it through which files would be changed."""
    try:
        with files.open_folder(place) as descriptor:
            files.check_no_links(descriptor)
    except FileNotFoundError:
        pass
    except OSError as error:
        raise UserError(f"{place}: not a folder for checkpoints ({error.strerror})") from error


@contextlib.contextmanager
def _report_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise UserError(f"{path}: cannot write a run folder there ({error.strerror})") from error


def find(path: str) -> RunFolder:
    """The run folder at `path`; raises UserError if there is none, or only a later jaxpg can read it."""
    folder = RunFolder(path)
    if not _has_config(folder):
        raise UserError(f"{path} is not a run folder: it has no config.yaml")
    return folder


def _has_config(folder: RunFolder) -> bool:
    """Whether there is a `config.yaml`.

    Raises:
      UserError: that cannot be found out, it is not a file, or a later jaxpg has written the run.
    """
    try:
        mode = os.lstat(folder.config).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as error:
        raise UserError(f"{folder.path} cannot be read as a run folder ({error.strerror})") from error
    if not stat.S_ISREG(mode):
        reason = files.LINK_REFUSED if stat.S_ISLNK(mode) else "it is not a file"
        raise UserError(f"{folder.config}: cannot be read ({reason})")
    versions_file.check_format(folder.versions)
    return True


def read_metrics(folder: RunFolder, agents: int | None = None) -> list[dict[str, Any]]:
    """The sound lines of `metrics.jsonl`; empty if there is no such file.

    Args:
      folder: the run folder.
      agents: number of agents; None: that of most lines.

    Raises:
      UserError: the file exists but cannot be read.
    """
    return parse_lines(read_metrics_text(folder), agents)[0]


def read_metrics_text(folder: RunFolder) -> str:
    """The text of `metrics.jsonl`; invalid bytes become a character that no sound line contains."""
    try:
        return files.read(folder.metrics).decode(errors="replace")
    except FileNotFoundError:
        return ""
    except OSError as error:
        raise UserError(f"{folder.metrics}: cannot be read ({error.strerror})") from error


def to_json(values: np.ndarray) -> Any:
    """A number, or a list of them for several agents; None for values that are not finite."""
    numbers = [float(x) if np.isfinite(x) else None for x in np.atleast_1d(values)]
    return numbers[0] if len(numbers) == 1 else numbers
