"""The versions and the machine that compute a run: its bits depend on them and on the options."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax

from jaxpg.program.backend import count_threads

OUR_ENTRIES = ("jaxpg", "commit")  # may change without changing the bits
PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "orbax-checkpoint", "numpy")
PATIENCE = 1.0  # seconds for git


def collect_versions() -> dict[str, Any]:
    """What the bits of a run depend on besides its options; for a checkout of jaxpg also its commit."""
    ours = {"jaxpg": importlib.metadata.version("jaxpg"), "commit": find_commit()}
    packages = {name: importlib.metadata.version(name) for name in PACKAGES}
    machine = {"python": platform.python_version(), "machine": platform.machine(), "threads": count_threads()}
    devices = f"{jax.device_count()} {jax.default_backend()}"
    return ours | packages | machine | {"devices": devices, "xla_flags": os.environ.get("XLA_FLAGS", "")}


def find_commit() -> str | None:
    """The commit of the checkout that this package runs from, with "-dirty" after changes; None outside of one."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return None
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    describe = ["git", "-C", str(root), "describe", "--always", "--dirty", "--exclude=*", "--abbrev=40"]
    try:
        result = subprocess.run(
            describe,
            env=environment | {"GIT_OPTIONAL_LOCKS": "0"},  # read only
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return result.stdout.strip()


def find_changes(recorded: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """What has changed: name -> (old value, new value)."""
    current = {name: value for name, value in now.items() if name in recorded or name not in OUR_ENTRIES}
    return {name: (recorded.get(name), value) for name, value in current.items() if recorded.get(name) != value}


def describe_change(name: str, change: tuple[Any, Any]) -> str:
    """A description of a change, and what it means for a resumed run."""
    old, new = change
    meaning = (
        "the bits stay the same if the code computes the same"
        if name in OUR_ENTRIES
        else "the same run, but not the same bits"
    )
    return f"{name} was {old} and is {new}: {meaning}"
