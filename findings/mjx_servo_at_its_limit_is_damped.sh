#!/usr/bin/env bash
# MJX, implicitfast: a servo whose force is at its limit still damps its joint, by ten times in one step.
#
# mujoco 3.17.0, mujoco-mjx 3.17.0, jax 0.10.1, jaxlib 0.10.1, numpy 2.4.0 (CPython 3.11 or newer).
#
# One would guess: MJX's integrators are C MuJoCo's, as with Euler, where both agree to rounding.
# What happens: a force that is clipped does not depend on the velocity, and C MuJoCo leaves it out of the derivative by
# which implicitfast integrates. MJX keeps the derivative of the force that is not clipped: M + h kv instead of M. Here
# the joint gets a tenth of its speed. Double precision; most robots are published with implicitfast and such servos.
#
# Output seen:
#   Euler: C MuJoCo 0.286 rad/s, MJX 0.286 rad/s
#   implicitfast: C MuJoCo 0.286 rad/s, MJX 0.028 rad/s
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

jax.config.update("jax_enable_x64", True)
SERVO = """<mujoco><option integrator="{}" timestep="0.002"/><worldbody><body><joint name="a" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" mass="1"/></body></worldbody>
<actuator><position joint="a" kp="2000" kv="400" forcerange="-10 10"/></actuator></mujoco>"""
for integrator in ("Euler", "implicitfast"):
    model = mujoco.MjModel.from_xml_string(SERVO.format(integrator))
    data = mujoco.MjData(model)
    data.ctrl[:] = 1.0
    other = jax.jit(mjx.step)(mjx.put_model(model), mjx.put_data(model, data))
    mujoco.mj_step(model, data)
    print(f"{integrator}: C MuJoCo {data.qvel[0]:.3f} rad/s, MJX {other.qvel[0]:.3f} rad/s")
PYTHON
cat > "$folder/expected" <<'TEXT'
Euler: C MuJoCo 0.286 rad/s, MJX 0.286 rad/s
implicitfast: C MuJoCo 0.286 rad/s, MJX 0.028 rad/s
TEXT
(cd "$folder" && venv/bin/python program.py) | tee "$folder/seen"
diff "$folder/expected" "$folder/seen"
