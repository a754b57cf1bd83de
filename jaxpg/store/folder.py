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
import itertools
import json
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
from jaxpg.store import files, lock
from jaxpg.store.files import UNFINISHED
from jaxpg.store.lines import sound
from jaxpg.store.versions import versions

LONGEST_TASK = 100  # letters of the task's name in a folder's: file systems take 255 bytes
PATTERNS = "\\[]*?"  # what orbax and tensorstore take for more than a letter
MOST_THREADS = 4096  # of XLA that versions.json can ask for: more than any machine has cores


class RunFolder:
    """The paths of one run, by the name that its folder was given."""

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
        """The folder; one that this process owns is followed where it is moved."""
        return files.whereabouts(self._given)


def planned(config: Config) -> RunFolder:
    """The run folder asked for, of which nothing is made yet; or else `runs/<env>-<algo>-s<seed>-<time>`, which is.

    Raises:
      UserError: its name cannot be written in a line of text, or is not one for orbax.
    """
    run = config.run
    if run.run_dir is not None:
        folder = RunFolder(run.run_dir)
    else:
        task = re.sub(r"[^\w.-]", "_", config.task)[:LONGEST_TASK].lstrip(".-")
        stamp = time.strftime("%Y%m%d-%H%M%S")
        folder = RunFolder(_made(Path("runs") / f"{task}-{config.choices['algo']}-s{run.seed}-{stamp}"))
    _check_name(folder.path)
    return folder


def _made(path: Path) -> Path:
    """A new folder of that name, or of one with a number after it: runs that begin in one second have their own."""
    with _reported(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        for number in itertools.count(1):
            folder = path if number == 1 else path.with_name(f"{path.name}-{number}")
            with contextlib.suppress(FileExistsError):
                folder.mkdir()
                return folder


def _check_name(path: Path) -> None:
    """Raises UserError for a name that configuration and messages cannot have, or from which orbax cannot read."""
    if not str(path).isprintable():
        raise UserError(f"run_dir={str(path)!r}: expected letters that can be printed, in UTF-8")
    odd = sorted(set(PATTERNS) & set(str(path.absolute())))
    if odd and not files.hides_names():
        raise UserError(f"{path}: on this system checkpoints cannot be kept below a folder with {odd[0]} in its name")


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
    return _has_config(folder) and _has_numbers(folder.checkpoints)


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
    """The folder, made where there is none, is this process's inside: what is written to its paths goes there.

    Args:
      folder: of the run.
      say: takes a note, where the folder cannot be locked.

    Raises:
      UserError: it is another's, or cannot be made or written to.
    """
    path = folder.path
    with contextlib.ExitStack() as stack:
        with _reported(path):
            path.mkdir(parents=True, exist_ok=True)
            descriptor = stack.enter_context(lock.held(path, say))
        stack.enter_context(files.owned(path, descriptor))
        for place in (folder.checkpoints, folder.best):
            _check_own(place)
        yield


def _check_own(place: Path) -> None:
    """Raises UserError where checkpoints would be written and removed through links, or there is no folder for them."""
    try:
        with files.opened(place) as descriptor:
            files.check_no_links(descriptor)
    except FileNotFoundError:
        pass
    except OSError as error:
        raise UserError(f"{place}: not a folder for checkpoints ({error.strerror})") from error


@contextlib.contextmanager
def _reported(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise UserError(f"{path}: cannot write a run folder there ({error.strerror})") from error


def replace(path: str | Path, content: str | bytes) -> None:
    """Writes a file that others, and who comes after a kill or a power failure, see as it was or whole.

    A link of that name is replaced, and what it leads to stays as it is; a folder in a run folder is no link.

    Args:
      path: the file, in a folder that is there.
      content: text is written as UTF-8; what no text has, but a file's name may, as an escape.

    Raises:
      UserError: it cannot be written.
    """
    data = content.encode("utf-8", "backslashreplace") if isinstance(content, str) else content
    try:
        files.replace(Path(path), data)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror})") from error


def read(path: Path) -> str:
    """The text of a file.

    Raises:
      UserError: there is none, or it is a link in a run folder, no file, or no text.
    """
    try:
        return files.read(path).decode()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: cannot be read (it is no text in UTF-8)") from error


def find(path: str) -> RunFolder:
    """The run folder at `path`; raises UserError where there is none."""
    folder = RunFolder(path)
    if not _has_config(folder):
        raise UserError(f"{path} is not a run folder: it has no config.yaml")
    return folder


def _has_config(folder: RunFolder) -> bool:
    """Whether there is one; raises UserError where the system does not tell, or it is no file."""
    try:
        mode = os.lstat(folder.config).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as error:
        raise UserError(f"{folder.path} cannot be read as a run folder ({error.strerror})") from error
    if not stat.S_ISREG(mode):
        reason = files.A_LINK if stat.S_ISLNK(mode) else "it is no file"
        raise UserError(f"{folder.config}: cannot be read ({reason})")
    return True


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
        recorded = json.loads(read(folder.versions))
    except (ValueError, RecursionError) as error:
        raise UserError(f"{folder.versions}: cannot be read ({error})") from error
    if not isinstance(recorded, dict) or not _is_number_of_threads(recorded.get("threads", 1)):
        expected = f"an object whose threads is at least 1, and at most {MOST_THREADS}"
        raise UserError(f"{folder.versions}: not what a run writes there, {expected}")
    earlier = recorded.get("earlier", [])
    if not isinstance(earlier, list) or not all(isinstance(part, dict) for part in earlier):
        raise UserError(f"{folder.versions}: not what a run writes there, a list of objects as earlier")
    return recorded


def _is_number_of_threads(value: Any) -> bool:
    return type(value) is int and 1 <= value <= MOST_THREADS


def read_metrics(folder: RunFolder, agents: int | None = None) -> list[dict[str, Any]]:
    """The sound lines of `metrics.jsonl`; empty where there is no such file.

    Args:
      folder: of the run.
      agents: that it has; None: as many as in most lines.

    Raises:
      UserError: it is there and cannot be read.
    """
    return sound(metrics_text(folder), agents)[0]


def metrics_text(folder: RunFolder) -> str:
    """What `metrics.jsonl` has; bytes that are no text become a letter that is in no sound line."""
    try:
        return files.read(folder.metrics).decode(errors="replace")
    except FileNotFoundError:
        return ""
    except OSError as error:
        raise UserError(f"{folder.metrics}: cannot be read ({error.strerror})") from error


def jsonable(values: np.ndarray) -> Any:
    """A number, or a list of them where there are several agents; what is not finite becomes None."""
    numbers = [float(x) if np.isfinite(x) else None for x in np.atleast_1d(values)]
    return numbers[0] if len(numbers) == 1 else numbers
