"""The run folder: what is in it, and under which name.

config.yaml         the options, complete
versions.json       what computed it
metrics.jsonl       one line for each chunk of updates
tb/                 the same for TensorBoard
checkpoints/        the whole training state, the newest few
best/               the best policy so far
learning_curve.png  the curve
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import time
from pathlib import Path
from typing import Any

import numpy as np

from jaxpg.run.config import Config
from jaxpg.run.errors import UserError

RECORDED_PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "orbax-checkpoint", "numpy")


class RunFolder:
    """The paths of one run."""

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.config = self.path / "config.yaml"
        self.versions = self.path / "versions.json"
        self.metrics = self.path / "metrics.jsonl"
        self.tensorboard = self.path / "tb"
        self.checkpoints = self.path / "checkpoints"
        self.best = self.path / "best"
        self.learning_curve = self.path / "learning_curve.png"


def create(config: Config) -> RunFolder:
    """A new run folder: the one asked for, or `runs/<env>-<algo>-s<seed>-<time>`.

    Raises:
      UserError: the folder is in use, cannot be made, or has a name that orbax takes for a pattern.
    """
    run = config.run
    if run.run_dir is not None:
        folder = RunFolder(run.run_dir)
    else:
        name = config.env.name if config.choices["env"] == "brax" else config.choices["env"]
        stamp = time.strftime("%Y%m%d-%H%M%S")
        folder = RunFolder(Path("runs") / f"{name}-{config.choices['algo']}-s{run.seed}-{stamp}")
    if set("[]") & set(str(folder.path.resolve())):
        raise UserError(f"{folder.path}: checkpoints cannot be kept below a folder with [ or ] in its name")
    try:
        if folder.path.exists() and any(folder.path.iterdir()):
            raise UserError(f"{folder.path} is not empty: take another run_dir, or resume={folder.path}")
        folder.path.mkdir(parents=True, exist_ok=True)
        folder.versions.write_text(json.dumps(versions(), indent=1), encoding="utf-8")
    except OSError as error:
        raise UserError(f"{folder.path}: cannot write a run folder there ({error.strerror})") from error
    return folder


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
    return packages | machine | {"xla_flags": os.environ.get("XLA_FLAGS", "")}


def read_versions(folder: RunFolder) -> dict[str, Any]:
    """What computed the run; raises UserError if the file cannot be read."""
    try:
        return json.loads(folder.versions.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"{folder.versions}: cannot be read ({error})") from error


def num_threads() -> int:
    """XLA's threads: results of large reductions depend on their number, so it is pinned and recorded."""
    return int(os.environ.get("PJRT_NPROC") or len(os.sched_getaffinity(0)))


class MetricsLog:
    """`metrics.jsonl` and TensorBoard; on resume, lines after the checkpoint are taken back.

    Args:
      folder: the run.
      update: updates made so far; later lines are removed.
    """

    def __init__(self, folder: RunFolder, update: int = 0):
        from tensorboardX import SummaryWriter

        kept = [line for line in read_metrics(folder) if line["update"] <= update]
        self._file = folder.metrics.open("w", encoding="utf-8")
        self._file.writelines(_json_line(line) for line in kept)
        self._tensorboard = SummaryWriter(str(folder.tensorboard), purge_step=kept[-1]["steps"] + 1 if kept else 0)
        self.seconds = kept[-1]["seconds"] if kept else 0.0

    def write(self, line: dict[str, Any]) -> None:
        """Adds one line; values are numbers, or lists of them with one for each agent."""
        self._file.write(_json_line(line))
        self._file.flush()
        for name, value in line.items():
            mean = _mean(value)
            if name not in ("update", "steps") and mean is not None:
                self._tensorboard.add_scalar(name, mean, line["steps"])

    def close(self) -> None:
        self._file.close()
        self._tensorboard.close()


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


def _mean(value: Any) -> float | None:
    numbers = [x for x in (value if isinstance(value, list) else [value]) if x is not None]
    return sum(numbers) / len(numbers) if numbers else None
