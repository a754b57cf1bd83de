"""The project's commands as the experiments run them."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"


def train(folder: Path, *arguments: str) -> float:
    """Runs `python -m jaxpg.train` into `folder`; returns the seconds from start to end of the process."""
    began = time.monotonic()
    subprocess.run([sys.executable, "-m", "jaxpg.train", *arguments, f"run_dir={folder}"], check=True)
    return time.monotonic() - began


def evaluate(folder: Path, *arguments: str) -> dict[str, Any]:
    """Runs `python -m jaxpg.evaluate` on `folder`; returns what it found."""
    command = [sys.executable, "-m", "jaxpg.evaluate", f"run={folder}", "json=true", *arguments]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return json.loads(output.splitlines()[-1])


def write_json(name: str, content: Any) -> None:
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / name).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
