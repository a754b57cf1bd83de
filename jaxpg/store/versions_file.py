"""`versions.json`, the versions and machine that computed a run, and the format of its folder."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

from jaxpg.errors import UserError
from jaxpg.store import files, run_files
from jaxpg.store.versions import collect_versions

FORMAT = 1  # of run folders; raised by a change that earlier versions cannot read
MAX_THREADS = 4096  # that the file can request: more than any machine has cores


def check_format(path: Path) -> None:
    """Raises UserError if the run has a later format; whether `versions.json` is sound is not asked here."""
    with contextlib.suppress(OSError, ValueError, RecursionError):
        recorded = json.loads(files.read(path))
        written = recorded.get("format", FORMAT) if isinstance(recorded, dict) else FORMAT
        if type(written) is int and written > FORMAT:
            raise UserError(
                f"{path.parent} was written by a later jaxpg (format {written}; this one reads up to {FORMAT}): update "
                "jaxpg to use it"
            )


def write(path: Path) -> None:
    """Writes `versions.json`, the first file of a run."""
    run_files.replace(path, json.dumps({"format": FORMAT, **collect_versions()}, indent=1))


def change(path: Path, recorded: dict[str, Any], now: dict[str, Any]) -> None:
    """Records the versions that continue a run; the previous ones stay in `versions.json` as `earlier`."""
    previous = {name: value for name, value in recorded.items() if name != "earlier"}
    earlier = [*recorded.get("earlier", []), previous]
    run_files.replace(path, json.dumps({"format": FORMAT, **now, "earlier": earlier}, indent=1))


def read(path: Path) -> dict[str, Any]:
    """The contents of `versions.json`; raises UserError if it cannot be read or is malformed."""
    try:
        recorded = json.loads(run_files.read(path))
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: cannot be read ({error})") from error
    if not isinstance(recorded, dict) or not _is_number_of_threads(recorded.get("threads", 1)):
        expected = f"expected an object with threads from 1 to {MAX_THREADS}"
        raise UserError(f"{path}: not written by a run: {expected}")
    earlier = recorded.get("earlier", [])
    if not isinstance(earlier, list) or not all(isinstance(part, dict) for part in earlier):
        raise UserError(f"{path}: not written by a run: expected a list of objects as earlier")
    return recorded


def _is_number_of_threads(value: Any) -> bool:
    return type(value) is int and 1 <= value <= MAX_THREADS
