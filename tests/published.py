"""Published robots as they are handed on: without their meshes. Not part of the project, so tests skip without them."""

from pathlib import Path

import pytest

from envs.physics import compile_model, load_spec

FOLDER = Path(__file__).parents[2] / "shared" / "robots"
FRAGMENTS = ("filtered_cartesian_actuators", "joint_position_actuators", "keyframe_ctrl", "keyframe_no_act")
NAMES = [str(path.relative_to(FOLDER)) for path in sorted(FOLDER.glob("*/*.xml")) if path.stem not in FRAGMENTS]
each_robot = pytest.mark.parametrize("name", NAMES or [pytest.param("", marks=pytest.mark.skip("no robots here"))])


def load(name):
    if not (FOLDER / name).is_file():
        pytest.skip("no robots here")
    return compile_model(load_spec(FOLDER / name))
