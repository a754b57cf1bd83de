"""An export writes all of its files or none, and over nothing that is the user's; they compile whatever names are."""

import itertools
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from stored import a_policy

from envs.base import Interface
from jaxpg import export as command_line
from jaxpg.deploy import c
from jaxpg.deploy.controller import make_controller
from jaxpg.deploy.exporter import FORMATS
from jaxpg.deploy.identifiers import MAX_LENGTH, make_identifier
from jaxpg.deploy.sealing import NO_SEAL, add_seal, is_sealed
from jaxpg.errors import UserError

OPTIONS = ("env=quadratic", "network.widths=[4]", "network=mlp")


@pytest.fixture
def export(monkeypatch):
    """`export(*arguments)`: the command, of a policy that is drawn."""
    stored = a_policy(*OPTIONS)
    monkeypatch.setattr("jaxpg.store.policies.load", lambda *_: stored)
    monkeypatch.setattr("jaxpg.deploy.exporter.describe_origin", lambda *_: {"policy": "drawn"})
    monkeypatch.setattr("jaxpg.deploy.controller.NUM_OBSERVATIONS", 200)
    return lambda *arguments: command_line.main(["run=somewhere", *arguments])


FILES = {
    "c": {"quadratic.h", "main.c", "Makefile"},
    "onnx": {"quadratic.onnx"},
    "stablehlo": {"quadratic.stablehlo", "quadratic.mlir"},
}


def test_the_files_of_every_format_are_known():
    assert set(FILES) >= set(FORMATS)


@pytest.mark.parametrize("form", FILES)
def test_the_users_files_stay(form, export, tmp_path):
    for name in FILES[form]:
        (tmp_path / name).write_text("mine")
        with pytest.raises(UserError, match=rf"holds {name}, not written by an export or changed since: nothing is"):
            export(f"format={form}", f"out={tmp_path}")
        assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "mine")]
        (tmp_path / name).unlink()


@pytest.mark.parametrize("form", FILES)
def test_what_an_export_has_written_is_replaced_until_it_is_changed(form, export, tmp_path):
    for _ in range(2):
        export(f"format={form}", f"out={tmp_path}")
        assert {path.name for path in tmp_path.iterdir()} == FILES[form]
        assert all(is_sealed(path.read_bytes()) for path in tmp_path.iterdir())
    changed = tmp_path / min(FILES[form])
    content = bytearray(changed.read_bytes())
    content[-3] ^= 1
    changed.write_bytes(content)
    with pytest.raises(UserError, match=f"holds {changed.name}, .*; choose another out=DIR, or overwrite=true"):
        export(f"format={form}", f"out={tmp_path}")
    assert changed.read_bytes() == content
    export(f"format={form}", f"out={tmp_path}", "overwrite=true")
    assert is_sealed(changed.read_bytes())


@given(st.binary(max_size=50), st.binary(max_size=50), st.integers(0), st.integers(1, 255))
def test_a_seal_breaks_with_any_byte(before, after, place, change):
    content = bytearray(add_seal(before + NO_SEAL.encode() + after))
    assert is_sealed(content)
    content[place % len(content)] ^= change
    assert not is_sealed(content)
    assert not is_sealed(before + after)


def test_links_are_not_followed(export, tmp_path):
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    out.mkdir()
    export(f"out={elsewhere}")
    before = (elsewhere / "main.c").read_bytes()
    (out / "main.c").symlink_to(elsewhere / "main.c")
    with pytest.raises(UserError, match=r"holds main\.c"):
        export(f"out={out}")
    export(f"out={out}", "overwrite=true")
    assert not (out / "main.c").is_symlink()
    assert (elsewhere / "main.c").read_bytes() == before


@pytest.mark.parametrize("out", ["", "export", "export/robot", "export/robot/left"])
@pytest.mark.usefixtures("export")
def test_a_link_in_the_place_of_a_runs_folder_is_not_followed(out, tmp_path):
    run, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    run.mkdir()
    elsewhere.mkdir()
    (run / "config.yaml").write_text("")
    (run / "best").mkdir()
    (run / "export").symlink_to(elsewhere)
    with pytest.raises(UserError, match="it is a link"):
        command_line.main([f"run={run}", "overwrite=true", *[f"out={run / out}"] * bool(out)])
    assert not [*elsewhere.iterdir()]


@pytest.mark.parametrize("missing", ["onnx", "onnxruntime", "flatbuffers"])
def test_all_formats_or_none(missing, export, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(UserError, match=f"needs {missing}.*pip install"):
        export("format=all", f"out={tmp_path / 'out'}")
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written_is_one_line(export, tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(UserError, match="cannot be written"):
        export(f"out={tmp_path / 'out'}")


def test_a_folder_in_a_files_place_is_one_line(export, tmp_path):
    (tmp_path / "main.c").mkdir()
    with pytest.raises(UserError, match=r"main\.c is a folder there"):
        export(f"out={tmp_path}", "overwrite=true")
    assert [path.name for path in tmp_path.iterdir()] == ["main.c"]


# --- names ------------------------------------------------------------------------------------------------------------

NAMES = ["2link", "double", "math", "Makefile", "", "-", "humanoid/v1", "Rücken", "机器人", "_x", "a policy"]
NAMES += ["myPOLICY", "policy", "main", "a" * 300, 'x"y', "a\nb", "stdio.h", "NaN"]


def a_controller(name=None, observations=("x",), commands=("u",), number=1.0):
    stored = a_policy(*OPTIONS)
    interface = Interface(tuple(observations), tuple(commands), (2.0,))
    control = make_controller(stored._replace(interface=interface), {"policy": "drawn", "run": observations[0]})
    *layers, last = control.layers
    control = control._replace(layers=[*layers, last._replace(bias=np.array([number], np.float32))])
    return control if name is None else control._replace(name=make_identifier(name))


@pytest.mark.parametrize("name", NAMES)
def test_any_name_of_an_environment_compiles(name, tmp_path):
    control = a_controller(name)
    paths = c.write(control, tmp_path)
    assert c.load(control, tmp_path)(np.zeros((3, 1))).shape == (3, 1)
    assert all(len(path.name) <= MAX_LENGTH + 20 and path.name.isascii() for path in paths)
    compiled_as_cpp(tmp_path, f'#include "{paths[0].name}"\nint main() {{ return 0; }}\n')


def compiled_as_cpp(folder, text):
    (folder / "program.cpp").write_text(text)
    flags = ["-Wall", "-Wextra", "-Werror", f"-I{folder}"]  # and <math.h> is still the system's
    subprocess.run(["g++", *flags, "-fsyntax-only", folder / "program.cpp"], check=True)


@given(st.text())
def test_an_identifier_is_one(name):
    word = make_identifier(name)
    assert word.isidentifier()
    assert word.isascii()
    assert not word.startswith("_")
    assert make_identifier(word) == word


NASTY = ["*/ int x = 1; /*", "ends in a backslash\\", "ends in a trigraph??/", "two\nlines", "// comment", "/*"]
NASTY += ["\u202e reversed", "\udc80", "\x00", "a policy's POLICY", "%s %d", "{x}", "\\\n*/", "* /*/", '#include "x"']
NASTY += ["°C, Ω, µ", "*\u2028/", "???/", "speed  \\  "]


@pytest.mark.parametrize("place", ["observations", "commands"])
def test_any_name_of_a_number_compiles(place, tmp_path):
    for name in NASTY:
        control = a_controller(**{place: (name,)})
        c.write(control, tmp_path)
        c.load(control, tmp_path)
    assert "a policy's POLICY" in (c.write(a_controller(**{place: ("a policy's POLICY",)}), tmp_path)[0]).read_text()


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.text(st.sampled_from("*/\\?\n\r\t 'a°\u2029"), max_size=12))
def test_any_text_stays_in_its_comment(tmp_path, name):
    control = a_controller(observations=(name,))
    c.write(control, tmp_path)
    c.load(control, tmp_path)


BOTH = """
#include <stdio.h>
#include "left_arm.h"
#include "right_arm.h"
#include "left_arm.h"
int main(void) {
    float s[LEFT_ARM_OBSERVATIONS] = {0}, command[2];
    if (!left_arm_command(s, command) || !right_arm_command(s, command + 1)) return 1;
    printf("%.9g %.9g\\n", (double)command[0], (double)command[1]);
    return 0;
}
"""


def test_two_controllers_in_one_program(tmp_path):
    numbers = {"left_arm": -0.75, "right_arm": 0.5}
    controls = [a_controller(name, number=number) for name, number in numbers.items()]
    for control in controls:
        c.write(control, tmp_path)
    (tmp_path / "both.c").write_text(BOTH)
    found = c.compile_example(controls[0], tmp_path / "both.c")(np.zeros((0, 1)))
    expected = [c.load(control, tmp_path)(np.zeros((1, 1)))[0, 0] for control in reversed(controls)]
    np.testing.assert_allclose(found[0, 1], expected[0])
    assert found[0, 0] != found[0, 1]


@pytest.mark.parametrize("other", ["arm", "Arm"])
def test_two_of_one_name_are_an_error(other, tmp_path):
    for number, name in enumerate(("arm", other)):
        (tmp_path / str(number)).mkdir()
        c.write(a_controller(name, number=number), tmp_path / str(number))
    same = '#include "0/arm.h"\n#include "0/arm.h"\nint main(void) { return 0; }\n'
    (tmp_path / "same.c").write_text(same)
    c.compile_example(a_controller("arm"), tmp_path / "same.c")
    (tmp_path / "two.c").write_text(same.replace('0/arm.h"\nint', f'1/{other}.h"\nint'))
    with pytest.raises(RuntimeError, match=r"two controllers are called .* here: export one of them with name="):
        c.compile_example(a_controller("arm"), tmp_path / "two.c")


def test_a_name_of_ones_own(export, tmp_path):
    export("format=all", "name=left_arm", f"out={tmp_path}")
    ours = {"left_arm.h", "main.c", "Makefile", "left_arm.onnx", "left_arm.stablehlo", "left_arm.mlir"}
    assert {path.name for path in tmp_path.iterdir()} == ours
    assert "left_arm_command" in (tmp_path / "main.c").read_text()
    for name in ("2arms", "left-arm", "math"):
        with pytest.raises(UserError, match=rf"name={name}: not a prefix for C .* try name=\w+"):
            export(f"name={name}", f"out={tmp_path}")


@pytest.mark.parametrize("limits", [np.array([2.0]), [2.0], (2,), np.float32([2.0])])
def test_limits_of_any_sequence(limits, tmp_path):
    stored = a_policy(*OPTIONS)
    for names in itertools.chain([("x",)], [["x"]]):
        control = make_controller(stored._replace(interface=Interface(names, names, limits)), {})
        text = c.write(control, tmp_path)[0].read_text()
        assert "command[0]: x, at most 2 either way" in text


@pytest.mark.parametrize(
    ("interface", "message"),
    [
        (Interface(("x", "y"), ("u",), (1.0,)), r"interface\.observations has 2 entries, expected 1"),
        (Interface(("x",), (), (1.0,)), r"interface\.commands has 0 entries"),
        (Interface(("x",), ("u",), (1.0, 2.0)), r"interface\.limits has 2 entries"),
        (Interface(("x",), ("u",), (np.nan,)), "its limits contain numbers that are not finite"),
    ],
)
def test_an_interface_that_does_not_fit_is_one_line(interface, message):
    with pytest.raises(UserError, match=message):
        make_controller(a_policy(*OPTIONS)._replace(interface=interface), {})


def test_a_policy_of_nan_is_one_line():
    stored = a_policy(*OPTIONS)
    normalizer = stored.policy.normalizer._replace(mean=np.array([np.nan], np.float32))
    with pytest.raises(UserError, match="its observation statistics contain numbers that are not finite"):
        make_controller(stored._replace(policy=stored.policy._replace(normalizer=normalizer)), {})
