#!/usr/bin/env bash
# MuJoCo, mj_step and mujoco.batch: a geom that is moved lies 5 cm deep in the ground, without a contact.
#
# mujoco 3.17.0, numpy 2.4.0 (CPython 3.11 or newer).
#
# One would guess: a changed `geom_pos` moves the geom, and where it then overlaps another one there is a contact.
# What happens: it depends on the geom. One whose frame was its body's does not move at all (`geom_sameframe`). Another
# moves, `mj_geomDistance` says -0.05 m, and no contact is found: the boxes in which MuJoCo looks for contacts
# ("midphase") are those of the compiled model. They are used where one of the two bodies has several geoms; between
# bodies of one geom each, the contact is found. No warning, and status 0 in mujoco.batch.
# The changed model needs `mj_setConst`, or `Batch.set_const()`, which `expand` asks for.
#
# Output seen:
#   second geom: distance -0.05 m, 0 contacts; without midphase 1; after mj_setConst 1
#   geom at its body's origin: distance 0.40 m, 0 contacts; without midphase 0; after mj_setConst 1
#   second geom in mujoco.batch: status 0, falls freely True; after set_const status 0, falls freely False
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mujoco==3.17.0 numpy==2.4.0
cat > "$folder/program.py" <<'PYTHON'
import mujoco
import mujoco.batch

GROUND = '<geom name="ground" type="box" size="1 1 .1" pos="0 0 -.1"/><geom type="box" size="1 1 .1" pos="0 0 -3"/>'
GEOMS = '<freejoint/><geom name="first" size=".1"/><geom name="second" size=".1" pos=".3 0 0"/>'
SCENE = f'<mujoco><worldbody>{GROUND}<body pos="0 0 .5">{GEOMS}</body></worldbody></mujoco>'
NO_MIDPHASE = int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)


def look(geom, flags=0, constants=False):
    """The distance to the ground in m, and the number of contacts, of a geom that is moved down by 0.45 m."""
    model = mujoco.MjModel.from_xml_string(SCENE)
    model.geom(geom).pos[2] -= 0.45
    model.opt.disableflags |= flags
    if constants:
        mujoco.mj_setConst(model, mujoco.MjData(model))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    return mujoco.mj_geomDistance(model, data, model.geom("ground").id, model.geom(geom).id, 1.0, None), data.ncon


def fall(constants):
    """The status, and whether the body falls freely in a simulation of a Batch."""
    model = mujoco.MjModel.from_xml_string(SCENE)
    batch = mujoco.batch.Batch(model, 1, 1)
    speed = batch.bind("qvel")
    batch.expand("geom_pos")[0, model.geom("second").id, 2] -= 0.45
    if constants:
        batch.set_const()
    batch.step()
    return f"status {batch.status[0]}, falls freely {abs(speed[0, 2] / model.opt.timestep + 9.81) < 1e-6}"


for name, words in (("second", "second geom"), ("first", "geom at its body's origin")):
    (distance, found), (_, free), (_, after) = look(name), look(name, NO_MIDPHASE), look(name, 0, True)
    print(f"{words}: distance {distance:.2f} m, {found} contacts; without midphase {free}; after mj_setConst {after}")
print(f"second geom in mujoco.batch: {fall(False)}; after set_const {fall(True)}")
PYTHON
cat > "$folder/expected" <<'TEXT'
second geom: distance -0.05 m, 0 contacts; without midphase 1; after mj_setConst 1
geom at its body's origin: distance 0.40 m, 0 contacts; without midphase 0; after mj_setConst 1
second geom in mujoco.batch: status 0, falls freely True; after set_const status 0, falls freely False
TEXT
(cd "$folder" && venv/bin/python program.py) | tee "$folder/seen"
diff "$folder/expected" "$folder/seen"
