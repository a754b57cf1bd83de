#!/usr/bin/env bash
# mujoco.batch: a simulation that has diverged and was restarted has status 0, and only its count of warnings tells.
#
# mujoco 3.17.0, numpy 2.4.0 (CPython 3.11 or newer).
#
# One would guess: `Batch.status` is not 0 where MuJoCo has declared a simulation unstable, or its numbers show it.
# What happens: by default MuJoCo restarts it within the step. A joint at 0.5 rad with a speed of 1e12 rad/s is at
# 1e-4 rad and 0.06 rad/s a step later: small, finite and wrong, with status 0. The count of the warning BADQVEL alone
# says so, and that of a user's earlier steps is gone, as the restart sets all other counts to 0. One NaN among the
# controls sets all controls of that simulation to 0, with status 0 as well.
#
# Output seen:
#   too fast: position 0.0001, status 0, counted BADQVEL
#   earlier count of CNSTRFULL: 0
#   one NaN control of two: speeds equal to those without any control, status 0, counted BADCTRL
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mujoco==3.17.0 numpy==2.4.0
cat > "$folder/program.py" <<'PYTHON'
import mujoco
import mujoco.batch
import numpy as np

ARM = """<mujoco><worldbody><body><joint name="a" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" mass="1"/><body pos=".5 0 0"><joint name="b" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" mass="1"/></body></body></worldbody>
<actuator><motor joint="a"/><motor joint="b"/></actuator></mujoco>"""
model = mujoco.MjModel.from_xml_string(ARM)
kinds = mujoco.mjtWarning
mujoco.set_mju_user_warning(lambda text: None)  # or each would be written into a file in the working directory


def stepped(**fields):
    batch = mujoco.batch.Batch(model, 1, 1)
    speed = batch.bind("qvel")
    batch.warning[0, int(kinds.mjWARN_CNSTRFULL), 1] = 7
    for name, values in fields.items():
        batch.bind(name)[0] = values
    batch.step(np.ones(1, bool), 1)
    counts = batch.warning[0, :, 1]
    counted = [name for name in ("BADQVEL", "BADCTRL") if counts[int(getattr(kinds, f"mjWARN_{name}"))]]
    return batch, speed[0].copy(), counts, " ".join(counted)


batch, _, counts, counted = stepped(qpos=[0.5, 0.0], qvel=[1e12, 0.0])
print(f"too fast: position {batch.bind('qpos')[0, 0]:.4f}, status {batch.status[0]}, counted {counted}")
print(f"earlier count of CNSTRFULL: {counts[int(kinds.mjWARN_CNSTRFULL)]}")
batch, speed, _, counted = stepped(ctrl=[np.nan, 1.0])
same = "equal" if np.array_equal(speed, stepped()[1]) else "not equal"
print(f"one NaN control of two: speeds {same} to those without any control, status {batch.status[0]}, counted {counted}")
PYTHON
cat > "$folder/expected" <<'TEXT'
too fast: position 0.0001, status 0, counted BADQVEL
earlier count of CNSTRFULL: 0
one NaN control of two: speeds equal to those without any control, status 0, counted BADCTRL
TEXT
(cd "$folder" && venv/bin/python program.py) | tee "$folder/seen"
diff "$folder/expected" "$folder/seen"
