#!/usr/bin/env bash
# MuJoCo's enumerations equal NumPy's integers only from one side, so `value in (an enumeration's values)` is False.
#
# mujoco 3.17.0, numpy 2.4.0 (CPython 3.11 or newer).
#
# One would guess: equality is symmetric, and what equals a member of a tuple is in it.
# What happens: the type fields of a model are NumPy integers. `model.actuator_trntype[0] == mjtTrn.mjTRN_JOINT` is
# True; with the operands exchanged it is False, although both have the same hash. `in` compares the member with the
# value, in this order, so a check such as `kind in (JOINT, TENDON)` fails for every model, without an error. A Python
# integer is found, and so is the value by a comparison with each one.
#
# Output seen:
#   value == member: True, member == value: False, hashes equal: True
#   value in (member,): False, int(value) in (member,): True
#   value in {member}: False, any(value == each): True
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mujoco==3.17.0 numpy==2.4.0
cat > "$folder/program.py" <<'PYTHON'
import mujoco

model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body><joint name="a"/><geom size=".1"/></body></worldbody>
<actuator><motor joint="a"/></actuator></mujoco>""")
value, member = model.actuator_trntype[0], mujoco.mjtTrn.mjTRN_JOINT
print(f"value == member: {value == member}, member == value: {member == value}, ", end="")
print(f"hashes equal: {hash(value) == hash(member)}")
print(f"value in (member,): {value in (member,)}, int(value) in (member,): {int(value) in (member,)}")
print(f"value in {{member}}: {value in {member}}, any(value == each): {any(value == each for each in (member,))}")
PYTHON
cat > "$folder/expected" <<'TEXT'
value == member: True, member == value: False, hashes equal: True
value in (member,): False, int(value) in (member,): True
value in {member}: False, any(value == each): True
TEXT
(cd "$folder" && venv/bin/python program.py) | tee "$folder/seen"
diff "$folder/expected" "$folder/seen"
