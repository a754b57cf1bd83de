"""OpenGL without a screen: which of MuJoCo's backends works on this machine.

MuJoCo reads MUJOCO_GL once, when it is imported, and the import itself fails where the library is not there. So each
backend is tried in a process of its own, before anything here imports mujoco. Which one was found is handed on as a
value: its context comes from the backend's own module, whatever a mujoco that was imported earlier has chosen.
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
MUJOCOS_OWN = ""  # where MuJoCo knows better: on a Mac, and where the user has told it something else
SECONDS = 120  # after which an attempt has failed
ATTEMPT = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).render()"


def backend(environment: Mapping[str, str], works: Callable[[str], bool], system: str = sys.platform) -> str:
    """The backend to draw with: what MUJOCO_GL names, else the first of EGL and OSMesa that works.

    Args:
      environment: variables of the process.
      works: `works(MUJOCO_GL)`, whether MuJoCo draws with it.
      system: as in `sys.platform`.

    Returns:
      "egl", "osmesa", or "" for MuJoCo's own choice, which then is not one of these.

    Raises:
      UserError: the one that the user has chosen does not work, or none does.
    """
    asked = environment.get("MUJOCO_GL", "").strip().lower()
    if asked:
        if not works(asked):
            raise UserError(f"MUJOCO_GL={asked}: MuJoCo cannot draw with it here; {_remedy(asked)}unset it")
        return asked if asked in HEADLESS else MUJOCOS_OWN
    for name in HEADLESS if system == "linux" else (MUJOCOS_OWN,):
        if works(name):
            return name
    raise UserError(f"there is no OpenGL to draw with, neither EGL nor OSMesa: {' or '.join(INSTALL.values())}")


def _remedy(asked: str) -> str:
    return f"{INSTALL[asked]}, or " if asked in INSTALL else ""


def works(name: str) -> bool:
    """Whether MuJoCo draws with this value of MUJOCO_GL; one that fails, in whichever way, does so elsewhere."""
    attempt, environment = [sys.executable, "-c", ATTEMPT], os.environ | {"MUJOCO_GL": name}
    try:
        ended = subprocess.run(attempt, env=environment, capture_output=True, check=False, timeout=SECONDS)
    except subprocess.TimeoutExpired:
        return False
    return ended.returncode == 0


def context(name: str, width: int, height: int) -> Any:
    """An OpenGL context of this backend, made current; to be freed by its `free`."""
    import mujoco

    kind = importlib.import_module(f"mujoco.{name}").GLContext if name else mujoco.GLContext
    made = kind(width, height)
    made.make_current()
    return made
