#!/usr/bin/env bash
# mujoco.batch, sensor e_kinetic with the flag energy: the value is the kinetic energy of another simulation.
#
# mujoco 3.17.0, numpy 2.4.0 (CPython 3.11 or newer).
#
# One would guess: simulations of a batch are independent, and `<flag energy="enable"/>` only adds `mjData.energy`.
# What happens: with the flag, a step computes the energy after the sensors are read, and the sensor takes what is in
# `mjData.energy` from before. In a loop of mj_step it is one step older than without the flag. A batch computes its
# simulations one after the other in the same mjData: there it is the energy of the simulation before. Nothing says so.
# Without the flag the values are right. Four pendulums that turn with 1, 2, 3 and 4 rad/s, one thread:
#
# Output seen:
#   without the flag: [0.53 2.13 4.79 8.51]
#   with the flag: [0.53 0.53 2.13 4.79]
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mujoco==3.17.0 numpy==2.4.0
cat > "$folder/program.py" <<'PYTHON'
import mujoco, mujoco.batch
import numpy as np

PENDULUM = """<mujoco><option timestep="0.01">FLAG</option><worldbody><body><joint axis="0 1 0"/>
<geom size=".1" pos=".5 0 0"/></body></worldbody><sensor><e_kinetic/></sensor></mujoco>"""


def measure(flag):
    """The sensor's values after one step of four pendulums that turn with 1, 2, 3 and 4 rad/s."""
    model = mujoco.MjModel.from_xml_string(PENDULUM.replace("FLAG", flag))
    batch = mujoco.batch.Batch(model, 4, 1)
    values = batch.bind("sensordata")
    batch.bind("qvel")[:, 0] = [1, 2, 3, 4]
    batch.step()
    return values.ravel().round(2)


without, with_flag = measure(""), measure('<flag energy="enable"/>')
print(f"without the flag: {without}\nwith the flag: {with_flag}")
assert np.allclose(without, without[0] * np.array([1, 4, 9, 16]), rtol=0.02)
assert np.array_equal(with_flag[1:], without[:3])
PYTHON
"$folder/venv/bin/python" "$folder/program.py"
