"""POSIX modules that runs need and Windows lacks: file locks, names of open folders, memory limits."""

from __future__ import annotations

from jaxpg.errors import UserError

try:
    import fcntl
    import resource
except ImportError:
    raise UserError("runs need Linux or macOS; on Windows start this command in WSL, see docs/runs.md") from None

__all__ = ["fcntl", "resource"]
