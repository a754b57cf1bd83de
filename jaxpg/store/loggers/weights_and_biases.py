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
    return ("wandb",)


class WeightsAndBiases:
    """A W&B run: the configuration, the name of the run folder and the metrics, by environment steps.

    W&B itself adds the versions of Python and of its package, and the platform.

    Where it goes is up to W&B's own settings: `wandb login`, WANDB_MODE, WANDB_PROJECT (by default `jaxpg`), WANDB_DIR
    (by default the run folder's `loggers/`) and others. Without a login, and without WANDB_MODE=offline, it raises.

    W&B refuses steps that go back. The run's id and the last step are kept in `wandb.json`. On line, W&B itself says
    which step is its last. Off line, each part of a resumed run is a folder of its own, with the same id: together
    they have each step once, and `wandb sync` takes them in the order of their times.

    Args:
      folder: for `wandb.json` and W&B's own files.
      name: of the run.
      config: of the run.
    """

    def __init__(self, folder: Path, name: str, config: Mapping[str, Any]):
        os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
        import wandb

        self._kept = folder / "wandb.json"
        kept = json.loads(files.read(self._kept)) if os.path.lexists(self._kept) else {"step": -1}
        self._id = kept.get("id") or os.environ.get("WANDB_RUN_ID") or secrets.token_hex(4)
        self._run = wandb.init(
            id=self._id,
            resume="allow",
            name=name,
            config=dict(config),
            allow_val_change=True,  # of options that may change on resume
            project=os.environ.get("WANDB_PROJECT", "jaxpg"),
            dir=os.environ.get("WANDB_DIR", _own(folder)),
            settings=_settings(wandb),
        )
        online = self._run.settings.mode == "online"
        self.last = self._run.starting_step - 1 if online else kept["step"]
        self._keep(self.last)

    def write(self, values: Mapping[str, float], step: int) -> None:
        """Adds values at a step, which is larger than those before it."""
        self._run.log(dict(values), step=step, commit=True)
        self._keep(step)

    def close(self) -> None:
        self._run.finish()

    def _keep(self, step: int) -> None:
        files.replace(self._kept, json.dumps({"id": self._id, "step": step}).encode())


def _own(folder: Path) -> str:
    """The name of this folder, for W&B writes in a process of its own; raises OSError where it would follow a link."""
    if (folder / "wandb").is_symlink():
        raise OSError(errno.ELOOP, f"wandb: {files.A_LINK}")
    return str(folder.resolve())


def _settings(wandb: Any) -> Any:
    """No code, no list of packages, no host name or measurements of the machine, no copy of what is printed."""
    machine = {"x_disable_stats": True, "x_disable_meta": True, "x_disable_machine_info": True, "host": ""}
    code = {"disable_code": True, "disable_git": True, "save_code": False, "x_save_requirements": False}
    return wandb.Settings(silent=True, console="off", disable_job_creation=True, **machine, **code)


begin = WeightsAndBiases
