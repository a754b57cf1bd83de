#!/usr/bin/env bash
# MJX: a sensor of an actuator's force reads 0 in a model without constraints, although the force is there.
#
# mujoco 3.17.0, mujoco-mjx 3.17.0, jax 0.10.1, jaxlib 0.10.1, numpy 2.4.0 (CPython 3.11 or newer).
#
# One would guess: `actuatorfrc` is `Data.actuator_force`, which no constraint has to do with.
# What happens: where the model can have no constraint row, MJX ends its forward dynamics before it reads the sensors of
# forces and accelerations; they keep their initial 0. A joint limit that is far away makes the same sensor right. So a
# policy trained without limits learns from zeros, and adding an unrelated limit changes its observations.
#
# Output seen:
#   no limit: force 1.5, sensor C MuJoCo 1.5, MJX 0.0
#   a joint limit: force 1.5, sensor C MuJoCo 1.5, MJX 1.5
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mujoco==3.17.0 mujoco-mjx==3.17.0 jax==0.10.1 jaxlib==0.10.1 numpy==2.4.0
cat > "$folder/program.py" <<'PYTHON'
import contextlib, io

import jax, mujoco

with contextlib.redirect_stdout(io.StringIO()):  # two lines about a GPU backend
    from mujoco import mjx

ARM = """<mujoco><worldbody><body><joint name="a" axis="0 1 0" {}/>
<geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" mass="1"/></body></worldbody>
<actuator><motor name="m" joint="a"/></actuator><sensor><actuatorfrc actuator="m"/></sensor></mujoco>"""
for name, limit in (("no limit", ""), ("a joint limit", 'range="-90 90"')):
    model = mujoco.MjModel.from_xml_string(ARM.format(limit))
    data = mujoco.MjData(model)
    data.ctrl[:] = 1.5
    other = jax.jit(mjx.step)(mjx.put_model(model), mjx.put_data(model, data))
    mujoco.mj_step(model, data)
    force, sensor = other.actuator_force[0], other.sensordata[0]
    print(f"{name}: force {force:.1f}, sensor C MuJoCo {data.sensordata[0]:.1f}, MJX {sensor:.1f}")
PYTHON
cat > "$folder/expected" <<'TEXT'
no limit: force 1.5, sensor C MuJoCo 1.5, MJX 0.0
a joint limit: force 1.5, sensor C MuJoCo 1.5, MJX 1.5
TEXT
(cd "$folder" && venv/bin/python program.py) | tee "$folder/seen"
diff "$folder/expected" "$folder/seen"
