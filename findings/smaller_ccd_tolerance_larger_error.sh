#!/usr/bin/env bash
# MuJoCo: a smaller ccd_tolerance makes the distances of contacts worse, by ten thousand times.
#
# mujoco 3.17.0, numpy 2.4.0 (CPython 3.11 or newer).
#
# One would guess: `ccd_tolerance` bounds the error of a contact's distance, so a smaller one, with iterations enough,
# gives a smaller error.
# What happens: with the default 1e-6 the depth of a sphere in an ellipsoid is right to 4e-9 m. With 1e-9 or less, and
# 500 iterations, it is wrong by up to 5e-5 m, 50 times the default tolerance and 5 % of the depth. No warning.
# Spheres are put 1 mm deep into an ellipsoid, along 300 of its normals, so that the distance is -1 mm by construction.
#
# Output seen:
#   tolerance 1e-06, 35 iterations: error up to 4e-09 m
#   tolerance 1e-06, 500 iterations: error up to 4e-09 m
#   tolerance 1e-09, 500 iterations: error up to 5e-05 m
#   tolerance 1e-12, 500 iterations: error up to 5e-05 m
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mujoco==3.17.0 numpy==2.4.0
cat > "$folder/program.py" <<'PYTHON'
import mujoco
import numpy as np

SCENE = """<mujoco><option ccd_tolerance="{}" ccd_iterations="{}"/><worldbody><geom type="ellipsoid" size=".1 .2 .3"/>
<body><freejoint/><geom type="sphere" size=".05"/></body></worldbody></mujoco>"""
HALF_AXES, RADIUS, DEPTH = np.array([0.1, 0.2, 0.3]), 0.05, 0.001
directions = np.random.default_rng(1).normal(size=(300, 3))
directions /= np.linalg.norm(directions, axis=1, keepdims=True)
normals = directions / HALF_AXES
normals /= np.linalg.norm(normals, axis=1, keepdims=True)
centres = directions * HALF_AXES + normals * (RADIUS - DEPTH)
for tolerance, iterations in ((1e-6, 35), (1e-6, 500), (1e-9, 500), (1e-12, 500)):
    model = mujoco.MjModel.from_xml_string(SCENE.format(tolerance, iterations))
    data, errors = mujoco.MjData(model), []
    for centre in centres:
        data.qpos[:3] = centre
        mujoco.mj_forward(model, data)
        errors.append(abs(data.contact.dist[0] + DEPTH))
    print(f"tolerance {tolerance}, {iterations} iterations: error up to {max(errors):.0e} m")
PYTHON
cat > "$folder/expected" <<'TEXT'
tolerance 1e-06, 35 iterations: error up to 4e-09 m
tolerance 1e-06, 500 iterations: error up to 4e-09 m
tolerance 1e-09, 500 iterations: error up to 5e-05 m
tolerance 1e-12, 500 iterations: error up to 5e-05 m
TEXT
(cd "$folder" && venv/bin/python program.py) | tee "$folder/seen"
diff "$folder/expected" "$folder/seen"
