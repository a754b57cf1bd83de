"""Metrics for Weights & Biases."""

from __future__ import annotations

import errno
import json
import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxpg.store import files


def packages() -> tuple[str, ...]:
    """The packages that this logger needs."""
    return ("wandb",)


class WeightsAndBiases:
    """A W&B run: the configuration, the name of the run folder and the metrics, by environment steps.

    W&B itself adds the versions of Python and of its package, and the platform.

    W&B's own settings say where it goes: `wandb login`, WANDB_MODE, WANDB_PROJECT (by default `jaxpg`), WANDB_DIR (by
    default the run folder's `loggers/`) and others. It raises without a login, unless WANDB_MODE=offline.

    W&B refuses steps that decrease. The run's id and last step are kept in `wandb.json`. Online, W&B itself knows its
    last step. Offline, each part of a resumed run is a separate folder with the same id: together they have each step
    once, and `wandb sync` takes them in the order of their times.

    Args:
      folder: folder for `wandb.json` and W&B's own files.
      name: name of the run.
      config: options of the run.
    """

    def __init__(self, folder: Path, name: str, config: Mapping[str, Any]):
        os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
        import wandb

        self._path = folder / "wandb.json"
        record: dict[str, Any] = json.loads(files.read(self._path)) if os.path.lexists(self._path) else {"step": -1}
        self._id = record.get("id") or os.environ.get("WANDB_RUN_ID") or secrets.token_hex(4)
        self._run = wandb.init(
            id=self._id,
            resume="allow",
            name=name,
            config=dict(config),
            allow_val_change=True,  # some options may change on resume
            project=os.environ.get("WANDB_PROJECT", "jaxpg"),
            dir=os.environ.get("WANDB_DIR", _resolve(folder)),
            settings=_make_settings(wandb),
        )
        online = self._run.settings.mode == "online"
        self.last = self._run.starting_step - 1 if online else record["step"]
        self._save_step(self.last)

    def write(self, values: Mapping[str, float], step: int) -> None:
        """Adds values at a step, which must increase."""
        self._run.log(dict(values), step=step, commit=True)
        self._save_step(step)

    def close(self) -> None:
        self._run.finish()

    def _save_step(self, step: int) -> None:
        files.replace(self._path, json.dumps({"id": self._id, "step": step}).encode())


def _resolve(folder: Path) -> str:
    """The folder's resolved path, as W&B writes in its own process; raises OSError if it would follow a link."""
    if (folder / "wandb").is_symlink():
        raise OSError(errno.ELOOP, f"wandb: {files.LINK_REFUSED}")
    return str(folder.resolve())


def _make_settings(wandb: Any) -> Any:
    """Settings that send no code, packages, host name, measurements of the machine or console output."""
    machine = {"x_disable_stats": True, "x_disable_meta": True, "x_disable_machine_info": True, "host": ""}
    code = {"disable_code": True, "disable_git": True, "save_code": False, "x_save_requirements": False}
    return wandb.Settings(silent=True, console="off", disable_job_creation=True, **machine, **code)


begin = WeightsAndBiases
