"""What runs need of the system, and Windows has not: locks on files, and names of open folders."""

from __future__ import annotations

from jaxpg.errors import UserError

try:
    import fcntl
except ImportError:
    raise UserError("runs need Linux or macOS; on Windows start this command in WSL, see docs/runs.md") from None

__all__ = ["fcntl"]
