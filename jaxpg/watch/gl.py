"""OpenGL without a screen: finds the backend of MuJoCo that works on this machine.

MuJoCo reads MUJOCO_GL once, when it is imported, and the import fails if the library is missing. So each backend is
tried in a separate process, before anything here imports mujoco. Contexts come from the backend's own module, whatever
backend an earlier import of mujoco has chosen.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from typing import Any

from jaxpg.errors import UserError

HEADLESS = ("egl", "osmesa")  # tried in this order
INSTALL = {"egl": "apt-get install libegl1 libgl1-mesa-dri", "osmesa": "apt-get install libosmesa6"}
MUJOCO_DEFAULT = ""  # left to MuJoCo: on a Mac, and if the user has chosen another backend
TIMEOUT = 120  # seconds
ATTEMPT = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).render()"


def find_backend(
    environment: Mapping[str, str], works: Callable[[str], bool], system: str = sys.platform
) -> str | None:
    """The backend to draw with: the one that MUJOCO_GL names, else the first of EGL and OSMesa that works.

    Args:
      environment: environment variables.
      works: `works(MUJOCO_GL)`, whether MuJoCo can draw with it.
      system: as `sys.platform`.

    Returns:
      "egl", "osmesa", or "" for another backend, chosen by MuJoCo; None if none works.

    Raises:
      UserError: the backend that the user has chosen does not work.
    """
    name = environment.get("MUJOCO_GL", "").strip().lower()
    if name:
        if not works(name):
            raise UserError(f"MUJOCO_GL={name}: MuJoCo cannot draw with it here; {_remedy(name)}unset it")
        return name if name in HEADLESS else MUJOCO_DEFAULT
    for name in HEADLESS if system == "linux" else (MUJOCO_DEFAULT,):
        if works(name):
            return name
    return None


def _remedy(name: str) -> str:
    return f"{INSTALL[name]}, or " if name in INSTALL else ""


def is_working(name: str) -> bool:
    """Whether MuJoCo can draw with this value of MUJOCO_GL; tried in another process, as it may crash."""
    command, environment = [sys.executable, "-c", ATTEMPT], os.environ | {"MUJOCO_GL": name}
    try:
        result = subprocess.run(command, env=environment, capture_output=True, check=False, timeout=TIMEOUT)
    except subprocess.TimeoutExpired:
        return False
    return result.returncode == 0


def make_context(name: str, width: int, height: int) -> Any:
    """An OpenGL context of this backend, made current; the caller frees it with `free`."""
    import mujoco

    kind = importlib.import_module(f"mujoco.{name}").GLContext if name else mujoco.GLContext
    context = kind(width, height)
    context.make_current()
    return context
