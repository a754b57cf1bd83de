"""What computes a run: the bits depend on it besides the options."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax

from jaxpg.program.backend import num_threads

OWN = ("jaxpg", "commit")  # another one need not compute anything else
PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "orbax-checkpoint", "numpy")
PATIENCE = 1.0  # seconds that git has


def versions() -> dict[str, Any]:
    """What the bits of a run depend on besides its options; of jaxpg itself the commit, too, where it has one."""
    own = {"jaxpg": importlib.metadata.version("jaxpg"), "commit": commit()}
    packages = {name: importlib.metadata.version(name) for name in PACKAGES}
    machine = {"python": platform.python_version(), "machine": platform.machine(), "threads": num_threads()}
    devices = f"{jax.device_count()} {jax.default_backend()}"
    return own | packages | machine | {"devices": devices, "xla_flags": os.environ.get("XLA_FLAGS", "")}


def commit() -> str | None:
    """The commit of the checkout that this package runs from, with "-dirty" after changes; None where it is none."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return None
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    describe = ["git", "-C", str(root), "describe", "--always", "--dirty", "--exclude=*", "--abbrev=40"]
    try:
        found = subprocess.run(
            describe,
            env=environment | {"GIT_OPTIONAL_LOCKS": "0"},  # it only looks
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return found.stdout.strip()


def changes(recorded: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """What computes the run now and did not before: name -> (what it was, what it is)."""
    known = {name: value for name, value in now.items() if name in recorded or name not in OWN}
    return {name: (recorded.get(name), value) for name, value in known.items() if recorded.get(name) != value}


def described(name: str, change: tuple[Any, Any]) -> str:
    """A change in words, with what it means for a run that goes on."""
    was, now = change
    meaning = "the same bits where the code computes the same" if name in OWN else "the same run, but not the same bits"
    return f"{name} was {was} and is {now}: {meaning}"
