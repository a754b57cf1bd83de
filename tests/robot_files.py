"""Robots written by tests: their files, and the compiled functions of their environments."""

import atexit
import functools
import shutil
import tempfile
from pathlib import Path

import jax


@functools.cache
def write(text):
    """The path of a file with this MJCF, which the end of the process removes."""
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder)
    (folder / "robot.xml").write_text(text)
    return str(folder / "robot.xml")


@functools.cache
def jit(env, name):
    """A method of an environment, compiled once."""
    return jax.jit(getattr(env, name))


def start(env, seed=0):
    """The state after a reset."""
    return jit(env, "reset")(jax.random.key(seed))
