#!/usr/bin/env bash
# mujoco.batch: a body whose mass is set to ten times falls with 98.1 m/s^2, or not, depending on what hangs on it.
#
# mujoco 3.17.0, numpy 2.4.0 (CPython 3.11 or newer).
#
# One would guess: masses that differ between the simulations of a Batch act at once. `expand` asks for `set_const()`
# after such fields, "so that the constants derived from it follow", such as weights of constraints: secondary numbers.
# What happens: the mass matrix of a body alone in space ("simple") is one of these constants, `dof_M0`. Without
# `set_const()`, ten times the mass and inertia give ten times the weight on the old inertia: the ball falls ten times
# too fast, with status 0 and without a warning. With a child of 1 g on a hinge the same lines are right.
# `mj_step` does the same with a model whose `body_mass` is changed. `simple="false"` or `set_const()` helps.
#
# Output seen:
#   ball alone: 9.8 and 98.1 m/s^2; after set_const 9.8 and 9.8 m/s^2; mj_step 98.1 m/s^2
#   ball with a child: 9.8 and 9.8 m/s^2; after set_const 9.8 and 9.8 m/s^2; mj_step 9.8 m/s^2
#   ball alone, simple="false": 9.8 and 9.8 m/s^2; after set_const 9.8 and 9.8 m/s^2; mj_step 9.8 m/s^2
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mujoco==3.17.0 numpy==2.4.0
cat > "$folder/program.py" <<'PYTHON'
import mujoco
import mujoco.batch
import numpy as np

BALL = '<body name="ball" {}><freejoint/><geom size=".1" mass="1"/>{}</body>'
CHILD = '<body><joint/><geom size=".01" mass="1e-3"/></body>'


def fall(model, constants):
    """Accelerations downwards of a ball and of one of ten times its mass, in two simulations of a Batch, in m/s^2."""
    batch = mujoco.batch.Batch(model, 2, 1)
    speed, heavier = batch.bind("qvel"), np.array([1.0, 10.0])[:, None]
    batch.body("ball").mass = model.body("ball").mass * heavier
    batch.body("ball").inertia = model.body("ball").inertia * heavier
    if constants:
        batch.set_const()
    batch.step()
    assert not batch.status.any()
    return "{:.1f} and {:.1f} m/s^2".format(*-speed[:, 2] / model.opt.timestep)


NOT_SIMPLE = 'simple="false"'
for name, options, child in (("alone", "", ""), ("with a child", "", CHILD), (f"alone, {NOT_SIMPLE}", NOT_SIMPLE, "")):
    text = f"<mujoco><worldbody>{BALL.format(options, child)}</worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(text)
    seen = f"ball {name}: {fall(model, False)}; after set_const {fall(model, True)}"
    model.body("ball").mass *= 10
    model.body("ball").inertia *= 10
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    print(f"{seen}; mj_step {-data.qvel[2] / model.opt.timestep:.1f} m/s^2")
PYTHON
cat > "$folder/expected" <<'TEXT'
ball alone: 9.8 and 98.1 m/s^2; after set_const 9.8 and 9.8 m/s^2; mj_step 98.1 m/s^2
ball with a child: 9.8 and 9.8 m/s^2; after set_const 9.8 and 9.8 m/s^2; mj_step 9.8 m/s^2
ball alone, simple="false": 9.8 and 9.8 m/s^2; after set_const 9.8 and 9.8 m/s^2; mj_step 9.8 m/s^2
TEXT
(cd "$folder" && venv/bin/python program.py) | tee "$folder/seen"
diff "$folder/expected" "$folder/seen"
