"""Where a robot's model comes from: shipped with the library, a file, or MuJoCo Menagerie.

panda                       a model of envs/assets
path/to/robot.xml           an MJCF file, with all that it includes
menagerie:NAME              a robot of MuJoCo Menagerie, which is downloaded
menagerie:NAME/ENTRY        one of its files
"""

from __future__ import annotations

import logging
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from envs.hints import pip_install, python_command
from envs.options import OptionError, describe_unknown, find_nearest
from envs.physics import load_spec

if TYPE_CHECKING:
    import mujoco

logger = logging.getLogger(__name__)

ASSETS = Path(__file__).parent.parent / "assets"
SHIPPED_ROBOTS = ("panda", "ur5e", "so100")
MENAGERIE = "menagerie:"
MOST_NAMED = 5  # robots that a message names


def load_robot(source: str, shipped: tuple[str, ...] = SHIPPED_ROBOTS) -> mujoco.MjSpec:
    """The editable specification of a robot; what has no name in it gets one.

    Args:
      source: the name of a shipped robot, the path of an MJCF file, or `menagerie:NAME`; see the module.
      shipped: names of the models of envs/assets that fit the task; by default the arms.

    Raises:
      OptionError: there is no such robot (with the nearest name) or file, or Menagerie cannot be reached.
      MujocoModelError: the file is not MJCF.
    """
    path = find_file(source, shipped)
    _check_format(path)
    spec = load_spec(path)
    if not spec.option.timestep > 0:
        line = f'its <option timestep="{spec.option.timestep:g}"/> must be above 0 seconds, such as 0.002'
        raise OptionError([f"env.robot={source}: {line}"])
    for line in _list_short_keyframes(spec):
        logger.warning("%s: %s", spec.modelname, line)
    name_parts(spec)
    return spec


def find_file(source: str, shipped: tuple[str, ...] = SHIPPED_ROBOTS) -> Path:
    """The MJCF file of a robot; raises OptionError as `load_robot`."""
    if source.startswith(MENAGERIE):
        return _find_in_menagerie(source.removeprefix(MENAGERIE))
    if source in shipped:
        return ASSETS / f"{source}.xml"
    path = Path(source).expanduser()
    if path.is_file():
        return path
    if path.suffix or len(path.parts) > 1 or (source and path.is_dir()):
        what = "is a folder; name the robot's .xml file in it" if path.is_dir() else "there is no such file"
        raise OptionError([f"env.robot={source}: {what}"])
    raise OptionError([f"{describe_unknown('robot', source, shipped)}; or give path/to/robot.xml, or {MENAGERIE}NAME"])


def _check_format(path: Path) -> None:
    """Raises OptionError for a URDF, which says nothing of actuators."""
    try:
        with path.open("rb") as file:
            root = next(ElementTree.iterparse(file, events=("start",)))[1].tag
    except (ElementTree.ParseError, StopIteration, ValueError):
        return  # MuJoCo says what is wrong
    if root == "robot":
        code = '"import mujoco, sys; print(mujoco.MjSpec.from_file(sys.argv[1]).to_xml())"'
        command = f"{python_command()} -c {code} {shlex.quote(str(path))} > robot.xml"
        raise OptionError([f"env.robot={path}: a URDF has no actuators; make MJCF of it and add them: {command}"])


def _list_short_keyframes(spec) -> list[str]:
    """Lines about keyframes with too few positions, which MuJoCo completes from the initial pose, qpos0."""
    import mujoco

    sizes = {mujoco.mjtJoint.mjJNT_FREE: 7, mujoco.mjtJoint.mjJNT_BALL: 4}
    number = sum(sizes.get(joint.type, 1) for joint in spec.joints)
    short = {key.name: len(key.qpos) for key in spec.keys if 0 < len(key.qpos) < number}
    return [
        f"keyframe '{name}' has {size} of {number} positions; the others are those of the initial pose, qpos0"
        for name, size in short.items()
    ]


def name_parts(spec: mujoco.MjSpec) -> None:
    """Gives joints, actuators, bodies and sites without a name their kind and number, so that they can be named."""
    kinds = {"joint": spec.joints, "actuator": spec.actuators, "body": spec.bodies, "site": spec.sites}
    for kind, parts in kinds.items():
        taken = {part.name for part in parts}
        for number, part in enumerate(parts):
            if not part.name:
                part.name = next(name for name in _list_names(kind, number) if name not in taken)
                taken.add(part.name)


def _list_names(kind: str, number: int):
    """The names to try for a part: joint0, joint0_, joint0__, ..."""
    name = f"{kind}{number}"
    while True:
        yield name
        name += "_"


def _find_in_menagerie(name: str) -> Path:
    """The file of `NAME` or `NAME/ENTRY`; without an entry, of the robot alone, without a floor."""
    source = f"env.robot={MENAGERIE}{name}"
    try:
        import mujoco_menagerie  # pyright: ignore[reportMissingImports] # an extra of its own
    except ImportError:
        raise OptionError([f"{source} needs mujoco-menagerie: {pip_install('mujoco-menagerie')}"]) from None
    robot, _, entry = name.partition("/")
    if robot not in mujoco_menagerie.names():
        raise OptionError([f"{source}: {_describe_unknown_robot(robot, mujoco_menagerie.names())}"])
    found = mujoco_menagerie.get(robot)
    if entry and entry not in found.entry_names:
        raise OptionError([f"{source}: {describe_unknown('entry', entry, found.entry_names)}"])
    try:
        return Path(found.xml(entry or found.default_model))
    except (mujoco_menagerie.MenagerieError, OSError) as error:
        line = f"it cannot be downloaded ({_flatten(error)}); a file on the disk needs no network"
        raise OptionError([f"{source}: {line}"]) from error


def _describe_unknown_robot(name: str, known: Sequence[str]) -> str:
    """The robots that have the name in theirs, as `panda` in `franka_emika_panda`; else as `describe_unknown`."""
    alike = [other for other in known if name and name in other]
    if 0 < len(alike) <= MOST_NAMED:
        return f"unknown robot '{name}': did you mean {' or '.join(map(repr, alike))}?"
    if find_nearest(name, known) is None:
        return f"unknown robot '{name}': `{python_command()} -m mujoco_menagerie names` lists them"
    return describe_unknown("robot", name, known)


def _flatten(error: Exception) -> str:
    return " ".join(str(error).split())
