"""What scalar equations do not simulate is stepped by C MuJoCo, and named; nothing is ignored."""

import logging

import jax
import models
import mujoco
import numpy as np
import published
import pytest

from envs.physics import MujocoModelError, check_model, compile_step, describe, scalar
from envs.physics.collision import change_collision, describe_meshes, list_colliding_meshes, measure_fit
from envs.physics.features import unsupported_features
from envs.physics.models import import_mjx, put_model
from envs.physics.numeric import evaluate

DELAYED = '<motor joint="pole" delay="0.01" nsample="4"/>'
MOTOR = '<motor joint="pole" {}/>'
TOUCHING = '<mujoco>{}<worldbody><geom {} size="0.1"/><body><freejoint/><geom size="0.1"/></body></worldbody></mujoco>'
FLOAT = '<mujoco><option {}/><worldbody><body><freejoint/><geom size="0.1" {}/></body></worldbody></mujoco>'
ODD = [
    (models.chain(models.pole(), MOTOR.format('delay="0.01" nsample="4"')), "delay of actuators"),
    (models.chain(models.pole(), '<adhesion body="world" ctrlrange="0 1"/>'), "transmission type body"),
    (models.chain(models.pole(), option='<option integrator="discrete"/>'), 'the integrator "discrete"'),
    (models.chain(models.pole(), option='<option><flag sleep="enable"/></option>'), "sleeping islands"),
    (TOUCHING.format("", 'surfacevel="1 0 0 0 0 0"'), "surface velocity of geoms"),
    (TOUCHING.format("", 'adhesion="1"'), "adhesion of geoms"),
    (TOUCHING.format('<option noslip_iterations="3"/>', ""), "noslip iterations of the solver"),
    (TOUCHING.format('<option><flag diagexact="enable"/></option>', ""), "the flag diagexact"),
    (FLOAT.format('density="1"', 'fluidshape="ellipsoid"'), "fluid forces on ellipsoids"),
]
FELT = TOUCHING.format("", "").replace('<geom size="0.1"/></body>', '<geom size="0.1"/><site name="s"/></body>')


@pytest.mark.parametrize(("xml", "words"), ODD, ids=[words for _, words in ODD])
def test_what_is_not_simulated_is_named(xml, words):
    (feature,) = unsupported_features(mujoco.MjModel.from_xml_string(xml))
    assert words in feature


@pytest.mark.parametrize(
    ("sensor", "kind"),
    [
        ('contact name="x" site="s" num="2" data="found force"', "contact"),
        ('rangefinder name="x" site="s" data="dist normal"', "rangefinder"),
        ('distance name="x" geom1="g" body2="world"', "geomdist"),
    ],
)
def test_sensors_count_where_they_are_wanted(sensor, kind):
    felt = FELT.replace('<geom size="0.1"/><site', '<geom name="g" size="0.1"/><site')
    sensors = f'<sensor><touch name="y" site="s"/><{sensor}/><force site="s"/></sensor></mujoco>'
    model = mujoco.MjModel.from_xml_string(felt.replace("</mujoco>", sensors))
    assert unsupported_features(model) == unsupported_features(model, ("sensordata[y]",)) == []
    for output in ("sensordata", "sensordata[x]"):
        assert unsupported_features(model, ("qpos", output)) == [f"sensors of type {kind}"]
    alone = models.chain(models.pole(), more='<sensor><jointpos joint="pole"/></sensor>')
    assert unsupported_features(mujoco.MjModel.from_xml_string(alone), ("qpos", "sensordata")) == []


def test_forces_on_bodies_lack_the_pull_of_tendons_around_geoms():
    tendon = """<tendon><spatial stiffness="9"><site site="s"/><geom geom="g"/><site site="t"/></spatial></tendon>"""
    around = FELT.replace('<geom size="0.1"/><site', '<geom name="g" size="0.1"/><site').replace("</mujoco>", tendon)
    around = around.replace("<worldbody>", '<worldbody><site name="t" pos="0 0 1"/>')
    model = mujoco.MjModel.from_xml_string(around + "</mujoco>")
    assert unsupported_features(model, ("qpos",)) == []
    for output in ("cfrc_ext", "cfrc_ext[world]"):
        assert unsupported_features(model, (output,)) == ["cfrc_ext with tendons around geoms"]


@pytest.mark.parametrize(
    "xml",
    [
        models.chain(models.pole(), MOTOR.format('group="1"'), '<option actuatorgroupdisable="1"/>'),
        TOUCHING.format('<option><flag override="enable"/></option>', 'gap="0.1"'),
        TOUCHING.format('<option noslip_iterations="3"><flag constraint="disable"/></option>', ""),
        FLOAT.format("", 'fluidshape="ellipsoid"'),
        FLOAT.format('density="1"', ""),
        models.chain(models.pole(), option='<option><flag energy="enable" fwdinv="enable" island="disable"/></option>'),
    ],
)
def test_what_does_not_matter_is_no_feature(xml):
    assert unsupported_features(mujoco.MjModel.from_xml_string(xml)) == []


def test_features_of_sensors_count_where_sensors_are_wanted():
    sensor = '<sensor><jointpos joint="pole" delay="0.01" nsample="4"/></sensor>'
    model = mujoco.MjModel.from_xml_string(models.chain(models.pole(), more=sensor))
    assert unsupported_features(model) == []
    assert unsupported_features(model, ("qpos", "sensordata")) == ["delay of sensors"]


@pytest.mark.parametrize("name", [*models.SHIPPED, *models.MJCF, *models.CONSTRAINED])
def test_ordinary_models_have_no_such_feature(name):
    assert unsupported_features(models.make(name)) == []


@published.each_robot
def test_published_robots_have_no_such_feature(name):
    assert unsupported_features(published.load(name), ("sensordata",)) == []


def test_a_model_with_such_a_feature_moves_as_in_mujoco(caplog, monkeypatch):
    """Whereas MJX would leave the delay of the actuator out."""
    monkeypatch.setattr(scalar, "_warned", set())
    model = mujoco.MjModel.from_xml_string(models.chain(models.pole(), DELAYED))
    state = np.full(1, 0.3), np.ones(1), np.ones(1)
    with caplog.at_level(logging.WARNING):
        ours = compile_step(model, 20)(*state)
    for x, true in zip(ours, compile_step(model, 20, physics="mujoco")(*state), strict=True):
        np.testing.assert_array_equal(x, true)
    (record,) = caplog.records
    assert "because of: delay of actuators" in record.getMessage()
    assert abs(float(ours[1][0]) - float(compile_step(model, 20, physics="mjx")(*state)[1][0])) > 0.01


# --- the model as MJX gets it -----------------------------------------------------------------------------------------

REFUSED = {
    "elliptic cone": models.chain(models.pole(), option='<option cone="elliptic"><flag contact="disable"/></option>'),
    "implicit": models.chain(models.pole(), option='<option integrator="implicit"/>'),
    "implicitfast in a fluid": models.chain(models.pole(), option='<option integrator="implicitfast" density="1"/>'),
    "PGS": models.chain(models.pole(), option='<option solver="PGS"/>'),
    "energy": models.chain(models.pole(), option='<option><flag energy="enable"/></option>'),
    "slider and crank": models.chain(
        models.pole('<site name="crank"/>') + '<site name="slider" pos="1 0 0"/>',
        '<motor cranksite="crank" slidersite="slider" cranklength="0.5"/><adhesion body="world" ctrlrange="0 1"/>',
    ),
    "sparse": models.chain(models.pole(), option='<option jacobian="sparse"/>'),
    "cylinder and box": TOUCHING.format("", 'type="cylinder"')
    .replace('"0.1"', '"0.1 0.1 0.1"')
    .replace("<freejoint/><geom", '<freejoint/><geom type="box"'),
    "listed cylinder and box": models.chain(
        models.pole('<geom name="a" type="cylinder" size="0.1 0.1"/>') + '<geom name="b" type="box" size="1 1 1"/>',
        more='<contact><pair geom1="a" geom2="b"/></contact>',
    ),
    "rangefinder": models.chain(
        models.pole('<site name="eye"/>'), more='<sensor><rangefinder site="eye"/><clock/></sensor>'
    ),
    "distance sensor": models.chain(
        models.pole('<geom name="a" size="0.1"/>') + '<geom name="b" size="0.1" pos="1 0 0"/>',
        more='<sensor><fromto geom1="a" geom2="b" cutoff="9"/></sensor>',
    ),
}


def assert_smooth_part_is_mujocos(model):
    """Positions, inertias and bias forces in a random state, in float64."""
    mjx, random, data = import_mjx(), np.random.default_rng(0), mujoco.MjData(model)
    mujoco.mj_integratePos(model, data.qpos, random.normal(size=model.nv), 0.3)
    data.qvel[:] = random.normal(size=model.nv)
    mujoco.mj_forward(model, data)
    with jax.enable_x64(True):
        mjx_model = put_model(model)
        assert mjx_model.opt.jacobian == mjx.JacobianType.DENSE
        given = mjx.make_data(mjx_model).replace(qpos=jax.numpy.asarray(data.qpos), qvel=jax.numpy.asarray(data.qvel))

        def derive(values):
            for function in (mjx.kinematics, mjx.com_pos, mjx.crb, mjx.com_vel, mjx.rne):
                values = function(mjx_model, values)
            return values, mjx.full_m(mjx_model, values)

        ours, inertia = jax.jit(derive)(given)
    true = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, true)
    np.testing.assert_allclose(inertia, true, atol=1e-12)
    for name in ("xpos", "xmat", "xipos", "cdof", "geom_xpos", "site_xpos", "qfrc_bias"):
        x = np.asarray(getattr(ours, name))
        np.testing.assert_allclose(x, getattr(data, name).reshape(x.shape), atol=1e-12, err_msg=name)


@pytest.mark.parametrize("xml", REFUSED.values(), ids=REFUSED)
def test_mjx_refuses_nothing_that_it_does_not_need(xml):
    assert_smooth_part_is_mujocos(mujoco.MjModel.from_xml_string(xml))


@pytest.mark.parametrize("name", ["robotiq_2f85/2f85.xml", "unitree_go1/scene.xml", "universal_robots_ur5e/ur5e.xml"])
def test_published_robots_are_the_same_in_mjx(name):
    assert_smooth_part_is_mujocos(published.load(name))


@published.each_robot
def test_mjx_takes_published_robots(name):
    model = published.load(name)
    before = model.geom_type.copy(), model.opt.cone, model.opt.disableflags
    put_model(model)
    assert np.array_equal(before[0], model.geom_type)
    assert before[1:] == (model.opt.cone, model.opt.disableflags)


def test_what_mjx_has_no_form_of_is_refused_in_one_line():
    rope = '<flexcomp name="rope" type="grid" count="3 1 1" dim="1" spacing="0.1 0.1 0.1" mass="1"/>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{rope}</worldbody></mujoco>")
    with pytest.raises(MujocoModelError, match="MJX cannot step it: Flex"):
        put_model(model)
    assert unsupported_features(model) == ["flexible bodies (<flex>)"]
    state = model.qpos0, np.zeros(model.nv), np.zeros(0)
    assert np.isfinite(compile_step(model)(*state)[0]).all()


# --- collision of meshes ----------------------------------------------------------------------------------------------


def meshes(pair=""):
    """A long and a round cloud of points over the ground, turned and shifted, as meshes that collide."""
    random = np.random.default_rng(0)
    ball = random.normal(size=(150, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    long = 0.05 * ball + [0.2, 0, 0] * random.choice([-1, 1], (150, 1))
    brick = random.uniform(-1, 1, (150, 3)) * [0.1, 0.2, 0.15] + [0.1, 0, 0]
    assets, bodies = "", ""
    for place, (name, points) in enumerate({"long": long, "brick": brick}.items()):
        assets += f'<mesh name="{name}" vertex="{" ".join(f"{x:.5f}" for x in points.flat)}"/>'
        geom = f'<geom name="{name}" type="mesh" mesh="{name}" euler="20 {30 * place} 40" pos="0.1 0 0"/>'
        bodies += f'<body pos="0 {place} 1"><freejoint/>{geom}</body>'
    ground = '<geom name="ground" type="plane" size="5 5 1"/>'
    return mujoco.MjModel.from_xml_string(
        f"<mujoco><asset>{assets}</asset><worldbody>{ground}{bodies}</worldbody><contact>{pair}</contact></mujoco>"
    )


def lowest(model, steps=400):
    """The height of the lower body after a fall."""
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, steps)
    return data.xpos[1:, 2].min()


@pytest.mark.parametrize("pair", ["", '<pair geom1="ground" geom2="long"/>'])
def test_meshes_collide_as_is_chosen(pair):
    model = meshes(pair)
    assert [model.geom(x).name for x in list_colliding_meshes(model)] == ["long", "brick"]
    assert lowest(model) > -0.2
    for choice, falls in {"all": False, "hull": False, "primitives": True, "none": True}.items():
        changed = change_collision(model, choice)
        assert (lowest(changed) < -1) == falls, choice
        assert bool(describe_meshes(changed)) == (choice == "all")
    assert change_collision(model, "all") is model


def test_fitted_shapes_enclose_the_meshes():
    """A capsule about the long one, a box about the other, which no vertex leaves; and how far they stand out."""
    model = meshes()
    fitted = change_collision(model, "hull")
    kinds = [mujoco.mjtGeom(int(kind)).name for kind in fitted.geom_type]
    assert kinds == ["mjGEOM_PLANE", "mjGEOM_CAPSULE", "mjGEOM_BOX"]
    places = [mujoco.MjData(model), mujoco.MjData(fitted)]
    for each, data in zip((model, fitted), places, strict=True):
        mujoco.mj_kinematics(each, data)
    for geom, bound in ((1, 0.02), (2, 0.1)):
        mesh = model.geom_dataid[geom]
        points = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
        world = points @ places[0].geom_xmat[geom].reshape(3, 3).T + places[0].geom_xpos[geom]
        local = (world - places[1].geom_xpos[geom]) @ places[1].geom_xmat[geom].reshape(3, 3)
        radius, length = fitted.geom_size[geom, :2]
        if geom == 1:
            along = np.clip(local[:, 2:], -length, length) * [0, 0, 1]
            assert np.linalg.norm(local - along, axis=1).max() == pytest.approx(radius, abs=1e-6)
        else:
            assert (np.abs(local) <= fitted.geom_size[geom] + 1e-6).all()
        assert 0 < measure_fit(model, fitted, geom) < bound


def test_left_out_collision_is_said_once(caplog, monkeypatch):
    monkeypatch.setattr(scalar, "_warned", set())
    model = meshes()
    state = [np.asarray(x) for x in (model.qpos0, np.zeros(model.nv), np.zeros(0))]
    with caplog.at_level(logging.WARNING):
        falling = compile_step(model, 400)(*state)[0]
        compile_step(model, 2)
    (record,) = caplog.records
    assert "2 meshes would collide, which scalar equations leave out" in record.getMessage()
    assert falling[2] < -1
    assert compile_step(model, 400, physics="mujoco")(*state)[0][2] > 0
    assert compile_step(model, 400, physics="mujoco", collision="primitives")(*state)[0][2] < -1


# --- the check --------------------------------------------------------------------------------------------------------


def check(xml, **changes):
    return check_model(mujoco.MjModel.from_xml_string(xml), **changes)


def replace_step(monkeypatch, change):
    """Makes the step of the check a wrong one: `change` maps the named inputs and outputs, `[N, ...]`, to outputs."""

    def wrong(program, arguments):
        given = dict(zip(("qpos", "qvel", "qacc_warmstart", "ctrl"), arguments, strict=True))
        names = ("qpos", "qvel", "qacc_warmstart", "sensordata")
        return list(change(given, dict(zip(names, evaluate(program, arguments), strict=True))).values())

    monkeypatch.setattr("envs.physics.check.evaluate", wrong)


SERVO = '<position joint="pole" kp="1" ctrlrange="-1 200"/>'
SENSED = models.chain(
    models.pole(joint='damping="1"'),
    SERVO,
    more='<sensor><jointpos joint="pole"/><actuatorpos name="way" actuator="actuator"/></sensor>'
    '<keyframe><key qpos="2"/></keyframe>',
).replace("<position", '<position name="actuator"')


def test_a_right_step_passes_the_check():
    assert check(SENSED) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda given, made: made | {"sensordata": made["sensordata"] * [1, 1.01]}, "actuatorpos sensor 'way'"),
        (lambda given, made: made | {"qvel": made["qvel"] + 0.1 * (given["ctrl"] > 150)}, "qvel differs"),
        (lambda given, made: made | {"qvel": made["qvel"] + 0.1 * (given["ctrl"] <= -1)}, "qvel differs"),
        (lambda given, made: made | {"qvel": made["qvel"] - 0.1 * (given["qpos"] == 2)}, "qvel differs"),
        (lambda given, made: made | {"qpos": made["qpos"] * np.nan}, "qpos differs"),
    ],
    ids=["sensor", "large control", "limit", "keyframe", "NaN"],
)
def test_a_wrong_step_fails_the_check(change, words, monkeypatch):
    """In a sensor, under a control at an end of its range, from a keyframe alone."""
    replace_step(monkeypatch, change)
    (line,) = check(SENSED)
    assert words in line


def test_the_check_says_what_scalar_equations_leave_out():
    assert check_model(meshes(), num_steps=20) == [describe_meshes(meshes())]


def test_the_check_of_what_mujoco_steps_finds_nothing():
    assert check(models.chain(models.pole(), DELAYED)) == []


# --- the description --------------------------------------------------------------------------------------------------


def test_a_model_is_described():
    arm = describe(models.make("arm, upright"))
    assert (arm.name, arm.bodies, arm.dofs, arm.actuators, arm.pairs, arm.physics) == ("arm", 2, 2, 2, 0, "scalar")
    assert arm.equations > 20
    found = describe(meshes())
    assert (found.pairs, found.candidates, found.meshes, found.physics) == (3, 0, 2, "scalar")
    odd = describe(mujoco.MjModel.from_xml_string(models.chain(models.pole(), DELAYED)))
    assert (odd.physics, odd.equations) == ("mujoco", 0)
    assert odd.reason.startswith("delay of actuators")
