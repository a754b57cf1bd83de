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
import itertools
import json
import os
import re
import stat
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from jaxpg.run import files, lock
from jaxpg.run.config import Config
from jaxpg.run.errors import UserError
from jaxpg.run.files import UNFINISHED
from jaxpg.run.lines import json_line, sound
from jaxpg.run.loggers import UntilItFails, values_of
from jaxpg.run.loggers.follower import Follower
from jaxpg.run.loggers.tensorboard import TensorBoard
from jaxpg.run.versions import versions

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
        self._folder, self._where, self._say = folder, folder.path, say
        kept = self._take_back(update)
        self._waiting = ""
        purge_step = kept[-1]["steps"] + 1 if kept else 0
        self._loggers = [UntilItFails(partial(TensorBoard, folder.tensorboard, purge_step), folder.tensorboard, say)]
        for name in dict.fromkeys(loggers):
            begin = partial(Follower, name, folder.loggers)
            self._loggers.append(UntilItFails(begin, name, say))
        self.seconds = kept[-1]["seconds"] if kept else 0.0

    def _take_back(self, update: int) -> list[dict[str, Any]]:
        """The lines up to an update, which are then all that the file has."""
        lines, damaged = sound(_metrics_text(self._folder))
        for number in damaged:
            self._say(f"note: {self._folder.metrics}: line {number} is damaged and left out; the others are kept")
        kept = [line for line in lines if line["update"] <= update]
        text = "".join(map(json_line, kept))
        replace(self._folder.metrics, text)
        self._size = len(text)  # of the whole lines in the file; in ASCII a character is a byte
        return kept

    def write(self, line: dict[str, Any]) -> None:
        """Adds one line; values are numbers, or lists of them with one for each agent."""
        self._say_where()
        first = not self._waiting
        self._waiting += json_line(line)
        try:
            self.flush()
        except OSError as error:
            if first:
                self._say(
                    f"note: {self._folder.metrics}: cannot be written ({error.strerror}); lines wait until it can"
                )
        values = values_of(line)
        for logger in self._loggers:
            logger.write(values, line["steps"])

    def _say_where(self) -> None:
        """A note where the folder has been moved."""
        where = self._folder.path
        if where != self._where:
            self._say(f"note: {self._where} was moved: the run goes on in {where}")
            self._where = where

    def flush(self) -> None:
        """Writes the lines that wait; raises OSError where the file has not got all of them."""
        if not self._waiting:
            return
        with files.opened_in(self._folder.metrics, os.O_RDWR) as file:
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
    """The sound lines of `metrics.jsonl`; empty where there is no such file.

    Raises:
      UserError: it is there and cannot be read.
    """
    return sound(_metrics_text(folder))[0]


def _metrics_text(folder: RunFolder) -> str:
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
