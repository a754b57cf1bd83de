"""Takes out of a model what needs files that are not there: meshes, height fields, textures and skins.

Published robots often arrive without their meshes. Their motion does not need them where bodies have inertias of their
own; only looks and the collision of meshes are lost, and one logged line says so.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mujoco

logger = logging.getLogger(__name__)


def leave_out_missing_files(spec: mujoco.MjSpec) -> None:
    """Removes the assets whose files are missing, with the geoms made of them, and logs one line about it.

    Raises:
      ValueError: the inertia of a moving body would come from a missing mesh, or a sensor or tuple refers to one of the
        geoms.
    """
    assets = {"mesh": spec.meshes, "height field": spec.hfields, "texture": spec.textures, "skin": spec.skins}
    missing = {kind: [x for x in elements if _misses_file(spec, x)] for kind, elements in assets.items()}
    if not any(missing.values()) or _compiles(spec):
        return
    meshes, fields = ({x.name or Path(x.file).stem for x in missing[kind]} for kind in ("mesh", "height field"))
    geoms = [x for x in spec.geoms if x.meshname in meshes or x.hfieldname in fields]
    lighter = _find_lighter(spec, geoms)
    _check_references(spec, {x.name for x in geoms if x.name})
    logger.warning("%s: %s", spec.modelname, _describe(spec, missing, geoms, lighter))
    _remove(spec, missing, geoms)


def _compiles(spec: mujoco.MjSpec) -> bool:
    """Whether MuJoCo finds all files: it alone knows the folders of the models that another one attaches."""
    try:
        spec.copy().compile()
    except ValueError:
        return False
    return True


def _misses_file(spec: mujoco.MjSpec, asset) -> bool:
    return any(file not in spec.assets and not _find_path(spec, asset, file).exists() for file in _list_files(asset))


def _list_files(asset) -> list[str]:
    return [file for file in (asset.file, *getattr(asset, "cubefiles", ())) if file]


def _find_path(spec: mujoco.MjSpec, asset, file: str) -> Path:
    """Where MuJoCo looks for the file: an absolute path stays what it is."""
    compiler = getattr(asset, "compiler", None) or spec.compiler
    folder = compiler.texturedir if hasattr(asset, "cubefiles") else compiler.meshdir
    return Path(spec.modelfiledir, folder, Path(file).name if spec.strippath else file)


def _find_lighter(spec: mujoco.MjSpec, geoms) -> list[str]:
    """The moving bodies whose mass is less without the geoms, by name.

    Raises:
      ValueError: a body with joints has no mass without the geoms.
    """
    names = []
    for geom in geoms:
        body = geom.parent
        if _gives_mass(spec, geom) and _is_moving(body):
            names.append(body.name)
            left = [x for x in body.geoms if _gives_mass(spec, x) and not any(x is y for y in geoms)]
            if body.joints and not left:
                raise ValueError(
                    f"the inertia of body '{body.name}' would come from the mesh '{geom.meshname}', whose file is "
                    "missing: give the body an <inertial>"
                )
    return list(dict.fromkeys(names))


def _gives_mass(spec: mujoco.MjSpec, geom) -> bool:
    """Whether MuJoCo adds the geom to the inertia of its body; a mass that is not given is NaN."""
    import mujoco

    rule, kinds = spec.compiler.inertiafromgeom, mujoco.mjtInertiaFromGeom
    lowest, highest = spec.compiler.inertiagrouprange
    from_geoms = rule == kinds.mjINERTIAFROMGEOM_TRUE or (
        rule == kinds.mjINERTIAFROMGEOM_AUTO and not geom.parent.explicitinertial
    )
    massless = geom.mass == 0 or (geom.mass != geom.mass and geom.density == 0)
    is_field = geom.type == mujoco.mjtGeom.mjGEOM_HFIELD
    return bool(from_geoms and lowest <= geom.group <= highest and not massless and not is_field)


def _is_moving(body) -> bool:
    while body.name != "world":
        if body.joints:
            return True
        body = body.parent
    return False


def _check_references(spec: mujoco.MjSpec, names: set[str]) -> None:
    """Nobody but contact pairs may refer to the geoms."""
    import mujoco

    geom = mujoco.mjtObj.mjOBJ_GEOM
    for sensor in spec.sensors:
        named = [(sensor.objtype, sensor.objname), (sensor.reftype, sensor.refname)]
        lost = [name for kind, name in named if kind == geom and name in names]
        if lost:
            raise ValueError(f"the sensor '{sensor.name}' measures geom '{lost[0]}', whose file is missing")


def _describe(spec: mujoco.MjSpec, missing: dict[str, list], geoms, lighter: list[str]) -> str:
    """What is left out, in one line."""
    first = next(_list_assets(missing))
    counts = ", ".join(_count(len(elements), kind + " file") for kind, elements in missing.items() if elements)
    number = sum(map(len, missing.values()))
    example = f"{_list_files(first)[0]}{', ...' if number > 1 else ''}"
    line = f"{counts} {'is' if number == 1 else 'are'} missing ({example})"
    if not geoms:
        return f"{line} and left out, which changes nothing but looks"
    listed = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    colliding = sum(bool(x.contype or x.conaffinity or (x.name and x.name in listed)) for x in geoms)
    those = f"{'its' if number == 1 else 'their'} {_count(len(geoms), 'geom')}"
    line += f": {those}, {colliding or 'none'} of them for collision, {'is' if len(geoms) == 1 else 'are'} left out"
    if not lighter:
        return line
    more = f" and {len(lighter) - 1} more" if lighter[1:] else ""
    return f"{line}; their mass is missing in body '{lighter[0]}'{more}"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _remove(spec: mujoco.MjSpec, missing: dict[str, list], geoms) -> None:
    names = {x.name for x in geoms if x.name}
    pairs = [x for x in spec.pairs if names & {x.geomname1, x.geomname2}]
    textures = {x.name for x in missing["texture"]}
    for material in spec.materials:
        material.textures = ["" if name in textures else name for name in material.textures]
    for element in (*pairs, *geoms, *_list_assets(missing)):
        spec.delete(element)


def _list_assets(missing: dict[str, list]) -> Iterator:
    for elements in missing.values():
        yield from elements
