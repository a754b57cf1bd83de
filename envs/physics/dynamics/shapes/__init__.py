"""Contacts between pairs of shapes, as C MuJoCo finds them, as functions of one pair."""

from __future__ import annotations

from collections.abc import Callable

from envs.physics.dynamics.shapes import boxes, capsule_box, capsule_cylinder, capsules, ellipsoids, planes, spheres
from envs.physics.dynamics.shapes.geometry import Contacts, Shape

__all__ = ["DEEPEST_ONLY", "NUM_CONTACTS", "PAIRS", "Contacts", "Shape"]

# For each pair of shapes, in the order of MuJoCo's types, the function of (first, second, margin) that gives their
# `Contacts`. Those that do not exist have a distance beyond the margin.
PAIRS: dict[tuple[str, str], Callable[..., Contacts]] = {
    ("plane", "sphere"): planes.touch_plane_sphere,
    ("plane", "capsule"): planes.touch_plane_capsule,
    ("plane", "ellipsoid"): planes.touch_plane_ellipsoid,
    ("plane", "cylinder"): planes.touch_plane_cylinder,
    ("plane", "box"): planes.touch_plane_box,
    ("sphere", "sphere"): spheres.touch_sphere_sphere,
    ("sphere", "capsule"): spheres.touch_sphere_capsule,
    ("sphere", "ellipsoid"): ellipsoids.touch_sphere_ellipsoid,
    ("sphere", "cylinder"): spheres.touch_sphere_cylinder,
    ("sphere", "box"): spheres.touch_sphere_box,
    ("capsule", "capsule"): capsules.touch_capsule_capsule,
    ("capsule", "ellipsoid"): ellipsoids.touch_capsule_ellipsoid,
    ("capsule", "cylinder"): capsule_cylinder.touch_capsule_cylinder,
    ("capsule", "box"): capsule_box.touch_capsule_box,
    ("ellipsoid", "ellipsoid"): ellipsoids.touch_ellipsoid_ellipsoid,
    ("box", "box"): boxes.touch_box_box,
}

# How many contacts each function gives.
NUM_CONTACTS: dict[tuple[str, str], int] = {
    ("plane", "sphere"): 1,
    ("plane", "capsule"): 2,
    ("plane", "ellipsoid"): 1,
    ("plane", "cylinder"): 4,
    ("plane", "box"): 4,
    ("sphere", "sphere"): 1,
    ("sphere", "capsule"): 1,
    ("sphere", "ellipsoid"): 1,
    ("sphere", "cylinder"): 1,
    ("sphere", "box"): 1,
    ("capsule", "capsule"): 2,
    ("capsule", "ellipsoid"): 1,
    ("capsule", "cylinder"): 1,
    ("capsule", "box"): 2,
    ("ellipsoid", "ellipsoid"): 1,
    ("box", "box"): 8,
}

# Pairs of which MuJoCo may find other contacts besides the deepest, unless the model's flag multiccd is off.
DEEPEST_ONLY: set[tuple[str, str]] = {("capsule", "cylinder")}
