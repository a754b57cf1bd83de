"""A model whose mesh files are missing moves as with them, and one line says what was left out."""

import logging

import mujoco
import numpy as np
import published
import pytest

from envs.physics import MujocoModelError, compile_model, load_spec

INERTIA = '<inertial pos="0 0 0.1" mass="1" diaginertia="0.1 0.1 0.1"/>'
LOOKS = 'type="mesh" mesh="look" contype="0" conaffinity="0"'
BODY = '<joint axis="0 1 0"/>{inertia}<geom name="seen" {looks}/><geom name="felt" type="mesh" mesh="felt"/>'
VERTICES = "0 0 0 0.1 0 0 0 0.1 0 0 0 0.1"


def mjcf(body=BODY, inertia=INERTIA, looks=LOOKS, file='file="{}.stl"', more="", assets=""):
    meshes = "".join(f'<mesh name="{name}" {file.format(name)}/>' for name in ("look", "felt"))
    body = body.format(inertia=inertia, looks=looks)
    return f"""<mujoco model="robot"><compiler meshdir="parts"/><default><default class="heavy"><geom density="9"/>
    </default></default><asset>{meshes}{assets}</asset><worldbody><geom name="floor" type="plane" size="1 1 1"/>
    <body name="arm" pos="0 0 1">{body}</body></worldbody>{more}
    <keyframe><key name="home" qpos="1"/></keyframe></mujoco>"""


@pytest.fixture
def load(tmp_path, caplog):
    """Loads MJCF from a file, and returns the model with the logged lines."""

    def load(xml):
        (tmp_path / "robot.xml").write_text(xml)
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            model = compile_model(load_spec(tmp_path / "robot.xml"))
        return model, [record.getMessage() for record in caplog.records]

    return load


def names(model):
    return [model.geom(i).name for i in range(model.ngeom)]


def test_geoms_of_missing_meshes_are_left_out_and_the_motion_stays(load):
    model, (line,) = load(mjcf())
    assert names(model) == ["floor"]
    assert line == (
        "robot: 2 mesh files are missing (look.stl, ...): their 2 geoms, 1 of them for collision, are left out"
    )
    whole = mujoco.MjModel.from_xml_string(mjcf(file=f'vertex="{VERTICES}"'))
    states = []
    for each in (model, whole):
        data = mujoco.MjData(each)
        mujoco.mj_resetDataKeyframe(each, data, each.key("home").id)
        mujoco.mj_step(each, data, 50)
        states.append(data.qpos.copy())
    np.testing.assert_array_equal(*states)
    assert states[0] != 1


def test_meshes_that_are_there_stay(load, tmp_path):
    (tmp_path / "parts").mkdir()
    corners = np.reshape(VERTICES.split(), (4, 3))
    shape = "".join(f"v {' '.join(x)}\n" for x in corners) + "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "parts" / "look.obj").write_text(shape)
    model, (line,) = load(mjcf(file='file="{}.obj"'))
    assert names(model) == ["floor", "seen"]
    assert line.endswith("1 mesh file is missing (felt.obj): its 1 geom, 1 of them for collision, is left out")
    (tmp_path / "parts" / "felt.obj").write_text(shape)
    model, lines = load(mjcf(file='file="{}.obj"'))
    assert names(model) == ["floor", "seen", "felt"]
    assert lines == []


def test_meshes_of_an_attached_model_are_found_where_mujoco_finds_them(load, tmp_path):
    (tmp_path / "hand").mkdir()
    part = '<mujoco><compiler meshdir="m"/><asset><mesh name="x" file="x.obj"/></asset><worldbody><body name="b">'
    part += '<geom type="mesh" mesh="x"/></body></worldbody></mujoco>'
    (tmp_path / "hand" / "hand.xml").write_text(part)
    (tmp_path / "hand" / "m").mkdir()
    (tmp_path / "hand" / "m" / "x.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    whole = '<mujoco><asset><model name="h" file="hand/hand.xml"/></asset><worldbody>'
    model, lines = load(whole + '<attach model="h" body="b" prefix="p"/></worldbody></mujoco>')
    assert model.ngeom == 1
    assert lines == []


@pytest.mark.parametrize("number", [0, 1])
def test_an_inertia_that_came_from_a_missing_mesh(load, number):
    """Is refused where the body has no other, and otherwise named."""
    other = '<geom name="other" size="0.1"/>' * number
    xml = mjcf(body=BODY + other, inertia="")
    if not number:
        with pytest.raises(MujocoModelError, match=r"robot\.xml: the inertia of body 'arm'.*mesh 'look'.*<inertial>"):
            load(xml)
        return
    model, (line,) = load(xml)
    assert names(model) == ["floor", "other"]
    assert line.endswith("are left out; their mass is missing in body 'arm'")


@pytest.mark.parametrize(
    ("changes", "compiler"),
    [
        ({"looks": LOOKS + ' mass="0"', "body": BODY.replace('mesh="felt"', 'mesh="felt" density="0"')}, "0 5"),
        ({"looks": LOOKS + ' group="5"', "body": BODY.replace('mesh="felt"', 'mesh="felt" group="5"')}, "0 3"),
    ],
)
def test_geoms_without_mass_take_no_mass_with_them(load, changes, compiler):
    body = changes["body"] + '<geom name="other" size="0.1"/>'
    xml = mjcf(**(changes | {"body": body}), inertia="")
    _, (line,) = load(xml.replace('meshdir="parts"', f'meshdir="parts" inertiagrouprange="{compiler}"'))
    assert line.endswith("are left out")


def test_inertia_from_geoms_overrides_an_explicit_one(load):
    with pytest.raises(MujocoModelError, match="the inertia of body 'arm'"):
        load(mjcf().replace('meshdir="parts"', 'meshdir="parts" inertiafromgeom="true"'))


def test_what_belongs_to_a_geom_goes_with_it_or_is_refused(load):
    model, _ = load(mjcf(more='<contact><pair geom1="floor" geom2="felt"/></contact>'))
    assert model.npair == 0
    sensor = '<sensor><framepos name="where" objtype="geom" objname="seen"/></sensor>'
    with pytest.raises(MujocoModelError, match="sensor 'where' measures geom 'seen'"):
        load(mjcf(more=sensor))


def test_missing_textures_change_only_looks(load):
    assets = '<texture name="t" type="2d" file="t.png"/><material name="m" texture="t"/>'
    body = INERTIA + '<joint/><geom name="ball" size="0.1" material="m"/>'
    xml = mjcf(body=body, file=f'vertex="{VERTICES}"', assets=assets)
    model, (line,) = load(xml)
    assert names(model) == ["floor", "ball"]
    assert line == "robot: 1 texture file is missing (t.png) and left out, which changes nothing but looks"


@published.each_robot
def test_published_robots_load(name, caplog):
    model = published.load(name)
    assert len(caplog.records) == 1
    assert "left out" in caplog.records[0].getMessage()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 10)
    assert np.isfinite(data.qvel).all()
    assert not data.warning.number.any()
