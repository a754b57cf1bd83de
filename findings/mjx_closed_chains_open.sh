#!/usr/bin/env bash
# MJX, connect and weld: a closed chain that moves fast opens, as a term of the constraint is missing.
#
# mujoco 3.17.0, mujoco-mjx 3.17.0, jax 0.10.1, jaxlib 0.10.1, numpy 2.4.0 (CPython 3.11 or newer).
#
# One would guess: the rows of the constraint are C MuJoCo's, as MJX takes `connect` and `weld` without a word.
# What happens: J(q) qvel = 0 asks for J qacc = -dJ/dt qvel. C MuJoCo has this product of velocities in the reference
# acceleration, MJX does not. While a chain is slow nothing shows. This four-bar linkage moves freely, with a crank of
# 20 rad/s that fits the constraint. After 0.1 s its ends are 49 mm apart, with C MuJoCo 3 mm. Double precision.
#
# Output seen:
#   after 1 step: coupler -20.07 rad/s, MJX -20.01 rad/s
#   after 100 steps: gap 3 mm, MJX 49 mm
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mujoco==3.17.0 mujoco-mjx==3.17.0 jax==0.10.1 jaxlib==0.10.1 numpy==2.4.0
cat > "$folder/program.py" <<'PYTHON'
import contextlib, io

import jax, mujoco, numpy as np

with contextlib.redirect_stdout(io.StringIO()):  # two lines about a GPU backend
    from mujoco import mjx

jax.config.update("jax_enable_x64", True)
FOUR_BAR = """<mujoco><option timestep="0.001" gravity="0 0 0"/>
<default><geom type="capsule" size=".02" mass="1" contype="0" conaffinity="0"/></default>
<worldbody><body><joint axis="0 1 0"/><geom fromto="0 0 0 0 0 .3"/>
<body pos="0 0 .3"><joint axis="0 1 0"/><geom fromto="0 0 0 .5 0 0"/>
<body name="rocker" pos=".5 0 0"><joint axis="0 1 0"/><geom fromto="0 0 0 0 0 -.4"/></body></body></body></worldbody>
<equality><connect body1="rocker" anchor="0 0 -.4"/></equality></mujoco>"""
model = mujoco.MjModel.from_xml_string(FOUR_BAR)
data = mujoco.MjData(model)
data.qvel[:] = 20, -20, 15  # J qvel = 0
step, mjx_model, other = jax.jit(mjx.step), mjx.put_model(model), mjx.put_data(model, data)


def gap(qpos):
    """Distance of the rocker's end from the point that holds it [mm]."""
    probe = mujoco.MjData(model)
    probe.qpos[:] = qpos
    mujoco.mj_kinematics(model, probe)
    end = probe.body("rocker").xpos + probe.body("rocker").xmat.reshape(3, 3) @ [0, 0, -0.4]
    return 1000 * np.linalg.norm(end - [0.5, 0, -0.1])


for number in range(1, 101):
    mujoco.mj_step(model, data)
    other = step(mjx_model, other)
    if number == 1:
        print(f"after 1 step: coupler {data.qvel[1]:.2f} rad/s, MJX {other.qvel[1]:.2f} rad/s")
print(f"after 100 steps: gap {gap(data.qpos):.0f} mm, MJX {gap(other.qpos):.0f} mm")
PYTHON
cat > "$folder/expected" <<'TEXT'
after 1 step: coupler -20.07 rad/s, MJX -20.01 rad/s
after 100 steps: gap 3 mm, MJX 49 mm
TEXT
(cd "$folder" && venv/bin/python program.py) | tee "$folder/seen"
diff "$folder/expected" "$folder/seen"
