"""What runs need of the system, and Windows has not: locks on files, names of open folders, limits of memory."""

from __future__ import annotations

from jaxpg.errors import UserError

try:
    import fcntl
    import resource
except ImportError:
    raise UserError("runs need Linux or macOS; on Windows start this command in WSL, see docs/runs.md") from None

__all__ = ["fcntl", "resource"]
