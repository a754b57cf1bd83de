"""A model whose mass is an input of its step is the model compiled with that mass."""

import copy
import functools

import dynamics
import jax
import jax.numpy as jnp
import models
import mujoco
import numpy as np
import published
import pytest
import test_constraints
from constrained import converge

import envs
from envs.physics import compile_step, derive_fields, differing_fields
from envs.physics.fields import find_types, list_model_fields
from envs.physics.models import put_model
from envs.physics.numeric import evaluate
from envs.physics.step import make_scalar_program

MASSES = (1.0, 4.0, 16.0)
STATE = ("qpos", "qvel", "ctrl")
SERVO = '<position joint="slide" kp="50" dampratio="1"/>'
OPTION = models.LOOP_FREE.replace("/>", ' solver="Newton"/>')


def with_mass(mass, body=models.LIMITED):
    """A cart with a servo whose damping MuJoCo derives from the mass, a pole on it, and limits on both."""
    return mujoco.MjModel.from_xml_string(models.chain(body.replace('mass="2"', f'mass="{mass}"'), SERVO, OPTION))


@pytest.fixture(scope="module")
def variants():
    return [with_mass(mass) for mass in MASSES]


def test_what_follows_from_a_mass_is_found(variants):
    fields = differing_fields(variants)
    assert {"model.body_mass", "model.body_inertia", "model.dof_invweight0", "model.actuator_biasprm"} <= set(fields)
    assert not {"model.body_pos", "model.opt.gravity", "model.actuator_gainprm"} & set(fields)
    assert all(len(values) == len(MASSES) for values in fields.values())
    for i, model in enumerate(variants):
        np.testing.assert_allclose(fields["model.body_mass"][i], model.body_mass, rtol=1e-6)


def test_a_step_with_these_numbers_is_the_step_of_the_model_that_has_them(variants):
    """To 1e-12, from states within and beyond the limits; one step of the first model's equations for all."""
    with jax.enable_x64(True):
        fields = differing_fields(variants)
        step = jax.jit(
            jax.vmap(compile_step(variants[0], inputs=(*STATE, *fields)), in_axes=(0, 0, 0, *[None] * len(fields)))
        )
        states = [jnp.asarray(x) for x in models.random_states(variants[0], 50)]
        for i, model in enumerate(variants):
            ours = step(*states, *(values[i] for values in fields.values()))
            true = jax.jit(jax.vmap(compile_step(model)))(*states)
            for mine, other in zip(ours, true, strict=True):
                np.testing.assert_allclose(mine, other, rtol=1e-12, atol=1e-12)


def test_the_mass_alone_is_the_step_of_no_model(variants):
    """The trap that the fields are for."""
    with jax.enable_x64(True):
        step = compile_step(variants[0], inputs=(*STATE, "model.body_mass"))
        step = jax.jit(jax.vmap(step, in_axes=(0, 0, 0, None)))
        states = [jnp.asarray(x) for x in models.random_states(variants[0], 50)]
        _, alone = step(*states, jnp.asarray(variants[2].body_mass))
        _, true = jax.jit(jax.vmap(compile_step(variants[2])))(*states)
        assert np.abs(alone - true).max() > 1e-2


def test_models_of_another_structure_are_refused(variants):
    with pytest.raises(ValueError, match=r"model\.\S+ differs; models may differ only"):
        differing_fields([variants[0], models.make("double pendulum")])
    other = with_mass(1.0)
    other.jnt_limited[0] = not other.jnt_limited[0]
    with pytest.raises(ValueError, match=r"model.jnt_limited differs; models may differ only in real numbers"):
        differing_fields([variants[0], other])
    assert differing_fields([variants[0], with_mass(1.0)]) == {}


# --- derived fields ---------------------------------------------------------------------------------------------------

EQUALITIES = """<equality><connect body1="c" body2="f" anchor=".1 .2 .3"/><connect body1="b" anchor=".1 .2 .3"/>
<weld body1="a" body2="f" anchor=".1 .2 .3"/><weld body1="a" body2="e" relpose=".1 .2 .3 1 2 0 0"/></equality>
<actuator><muscle tendon="t2" lengthrange="1 3"/></actuator>"""
SLIDES = """<mujoco><worldbody><body euler="0 30 0"><joint type="slide" axis="1 0 0" armature="1"/>
<joint type="slide" axis="0 0 1"/><geom size=".1"/></body></worldbody></mujoco>"""
DERIVING = {
    "pendulum": lambda: envs.make("pendulum").model,
    "slides": lambda: mujoco.MjModel.from_xml_string(SLIDES),
    "Panda": lambda: models.panda(limits=True),
    "UR5e": lambda: published.load("universal_robots_ur5e/ur5e.xml"),
    "everything": lambda: mujoco.MjModel.from_xml_string(dynamics.write_mjcf(extra=dynamics.TENDONS + EQUALITIES)),
}
# What a step does not depend on, but for the acceleration of muscles.
IDLE = {"dof_length", "actuator_length0", "light_poscom0", "cam_poscom0", "cam_pos0", "cam_mat0", "bvh_aabb"}
MANY = ("body_pos", "body_quat", "dof_armature", "body_inertia", "jnt_pos")


def change(model, changed):
    """The model with these fields, and what `mj_setConst` makes of it."""
    model = copy.copy(model)
    for name, values in changed.items():
        getattr(model, name.removeprefix("model."))[:] = values
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def draw_changes(model, fields, seed=0):
    """Masses of half to twice the model's, and other fields 0.1 beside theirs."""
    random, changed = np.random.default_rng(seed), {"model.body_mass": model.body_mass}
    changed["model.body_mass"] = model.body_mass * random.uniform(0.5, 2, model.nbody)
    for name in fields:
        values = getattr(model, name)
        changed["model." + name] = values + 0.1 * random.uniform(0, 1, values.shape)
    if "body_quat" in fields:
        changed["model.body_quat"] /= np.linalg.norm(changed["model.body_quat"], axis=1, keepdims=True)
    return changed


@pytest.mark.parametrize(
    ("name", "fields"), [("pendulum", ()), ("slides", ()), ("Panda", ()), ("UR5e", MANY), ("everything", MANY)]
)
def test_derived_fields_are_those_of_mj_set_const(name, fields):
    """To 1e-10, and no field is missing that a step depends on."""
    model = DERIVING[name]()
    changed = draw_changes(model, fields)
    with jax.enable_x64(True):
        derived = derive_fields(model, changed)
    scale = changed["model.body_mass"] / np.maximum(model.body_mass, 1e-300)
    changed.setdefault("model.body_inertia", model.body_inertia * scale[:, None])
    true, before = change(model, changed), change(model, {})
    real = [name for name in dir(model) if np.asarray(getattr(model, name)).dtype.kind == "f"]
    idle = IDLE if (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_MUSCLE).any() else {*IDLE, "actuator_acc0"}
    differ = {f"model.{x}" for x in set(real) - idle if (getattr(true, x) != getattr(before, x)).any()}
    assert differ <= set(derived)
    for name, values in derived.items():
        np.testing.assert_allclose(values, getattr(true, name[6:]), rtol=1e-10, atol=1e-10, err_msg=name)


def test_what_the_changed_fields_have_no_influence_on_is_left_out():
    model = DERIVING["everything"]()
    derive = functools.partial(derive_fields, model)
    assert list(jax.eval_shape(derive, {"model.geom_friction": model.geom_friction})) == ["model.geom_friction"]
    found = jax.eval_shape(derive, {"model.body_mass": model.body_mass})
    assert list(found) == sorted(found)
    assert not {"model.eq_data", "model.tendon_length0"} & set(found)


RATIOS = """<actuator><position name="a" joint="slide" kp="50" dampratio="1"/>
<position name="b" tendon="t" kp="20" dampratio=".7" gear="2"/><position name="c" joint="slide" kp="50" kv="3"/>
</actuator><tendon><fixed name="t"><joint joint="slide" coef="1"/><joint joint="pole" coef=".5"/></fixed></tendon>"""


def test_servos_keep_their_ratio_of_damping():
    """As in the model compiled with that mass and gain; a given damping stays."""

    def compile_with(mass, stiffness):
        spec = mujoco.MjSpec.from_string(models.chain(models.LIMITED, more=RATIOS.replace('"20"', f'"{stiffness}"')))
        spec.geoms[0].mass = mass
        return spec.compile()

    model, other = compile_with(1.0, 20), compile_with(5.0, 70)
    given = {f"model.{x}": getattr(other, x).copy() for x in ("body_mass", "actuator_gainprm", "actuator_biasprm")}
    given["model.actuator_biasprm"][:, 2] = model.actuator_biasprm[:, 2]
    with jax.enable_x64(True):
        derived = derive_fields(model, given, dampratio=("a", "b"))
    assert abs(other.actuator_biasprm - model.actuator_biasprm)[:2, 2].min() > 0.1
    np.testing.assert_allclose(derived["model.actuator_biasprm"], other.actuator_biasprm, rtol=1e-10)


def test_derived_fields_have_derivatives():
    """With respect to a mass, under `vmap`: those of C MuJoCo by finite differences."""
    model = DERIVING["pendulum"]()
    scales = np.array([0.7, 1.0, 1.3])

    def find_weight(scale):
        return derive_fields(model, {"model.body_mass": scale * model.body_mass})["model.dof_invweight0"][0]

    def find_true(scale):
        return change(model, {x: scale * getattr(model, x) for x in ("body_mass", "body_inertia")}).dof_invweight0[0]

    with jax.enable_x64(True):
        slopes = jax.jit(jax.vmap(jax.grad(find_weight)))(scales)
    true = [(find_true(x + 1e-5) - find_true(x - 1e-5)) / 2e-5 for x in scales]
    np.testing.assert_allclose(slopes, true, rtol=1e-6)


def test_a_step_with_derived_fields_is_mujocos():
    """Of a free box that touches the ground: by equations and by C MuJoCo, to 1e-10."""
    xml = '<mujoco><option tolerance="0"/><worldbody><geom type="plane" size="1 1 1"/><body pos="0 0 .18">'
    xml += '<freejoint/><geom type="box" size=".1 .1 .2"/></body></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(xml)
    changed = {"model.body_mass": 3.0 * model.body_mass}
    true = change(model, changed | {"model.body_inertia": 3.0 * model.body_inertia})
    data = mujoco.MjData(true)
    data.qvel[:] = 0.5
    start = data.qpos.copy(), data.qvel.copy()
    mujoco.mj_step(true, data)
    with jax.enable_x64(True):
        fields = derive_fields(model, changed)
        inputs, given = ("qpos", "qvel", *fields), [np.asarray(x) for x in (*start, *fields.values())]
        by_equations = evaluate(make_scalar_program(model, inputs, ("qpos", "qvel")), [x[None] for x in given])
        by_c = compile_step(model, inputs=inputs, physics="mujoco")(*given)
    for mine in ([x[0] for x in by_equations], by_c):
        for x, other in zip(mine, (data.qpos, data.qvel), strict=True):
            np.testing.assert_allclose(x, other, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(
    ("changed", "dampratio", "words"),
    [
        ({"body_mass": 1.0}, (), "unknown field 'body_mass': did you mean 'model.body_mass'"),
        ({"model.body_mas": 1.0}, (), "did you mean 'model.body_mass'"),
        ({"model.light_intensity": np.zeros(0)}, (), "MJX treats model.light_intensity as a constant"),
        ({"model.body_mass": 1.0}, (), r"model.body_mass has the shape \(\)"),
        ({"model.body_mass": np.ones(3)}, ("b",), "'b' is no position servo with damping; those of the model: a"),
        ({}, ("model",), "'model' is no position servo"),
    ],
)
def test_fields_that_cannot_be_derived_are_named(changed, dampratio, words):
    servos = '<position name="a" joint="slide" kp="50" dampratio="1"/><motor name="b" joint="slide"/>'
    model = mujoco.MjModel.from_xml_string(models.chain(models.LIMITED, servos))
    with pytest.raises(ValueError, match=words):
        derive_fields(model, changed, dampratio)


# --- numbers of the model as inputs -----------------------------------------------------------------------------------

SPRUNG = 'stiffness="2 .3" damping=".3 .2" frictionloss="900" margin=".1" actuatorfrcrange="-2 2"'
BALL = """<body pos="0 .3 .2" gravcomp=".5"><freejoint/><geom name="ball" size=".1" condim="6" solref=".03 1"/>
<site name="s" pos="0 0 .1"/><camera name="eye" pos="0 .3 0"/></body><geom name="ground" type="plane" size="1 1 1"/>"""
EVERYTHING = (
    '<tendon><fixed name="t1" range="-.1 .2" frictionloss="900" armature=".1" damping=".2 .1" actuatorfrcrange="-1 1">'
    '<joint joint="a" coef=".7"/><joint joint="b" coef="-1"/></fixed>'
    '<spatial name="t2" stiffness="3 .2" range=".2 .6"><site site="w"/><site site="s1"/></spatial></tendon>'
    '<equality><connect body1="e" anchor=".1 .2 0"/><weld site1="w" site2="s" solref=".5 1"/></equality>'
    '<equality><joint joint1="a" joint2="b" polycoef=".1 .5 0 0 0"/><tendon tendon1="t1" tendon2="t2"/></equality>'
    '<contact><pair geom1="ground" geom2="foot" solreffriction=".03 1"/></contact>'
    '<actuator><position joint="c" gear="1 .3 .2" kp="3" kv=".1"/><muscle joint="a" lengthrange="-1 1"/>'
    '<motor tendon="t1" gear="30" ctrlrange="-1 1"/><motor cranksite="s2" slidersite="w" cranklength="2"/>'
    '<general joint="b" dyntype="filter" dynprm=".1" actrange="-.1 .1" forcerange="-1 1" gainprm="30"/></actuator>'
    '<sensor><accelerometer site="s2"/><magnetometer site="s1"/><e_potential/><camprojection camera="eye" site="s2"/>'
    "</sensor>"
)


def make_everything():
    """A chain, with a foot on the ground, and a ball, with all that a model may have; nothing in it is simple."""
    bodies = test_constraints.chain(SPRUNG, 'margin=".1"', 'stiffness="1 .2" damping=".1"') + BALL
    bodies = bodies.replace('<geom type="box"', '<geom name="foot" type="sphere"').replace("0 0 1", "0 0 .1", 1)
    option = 'cone="elliptic" density="1.2" viscosity=".7" wind="1 .3 .2" integrator="implicitfast" impratio="2"'
    text = test_constraints.write(bodies, EVERYTHING, option=option, flag='energy="enable"')
    model = mujoco.MjModel.from_xml_string(text.replace('pos="0 .3 .2"', 'pos="0 .3 .2" simple="false"'))
    for flags in (model.body_sameframe, model.geom_sameframe, model.site_sameframe):
        flags[:] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
    model.geom_rbound[model.geom_rbound > 0] = 1  # so that larger geoms lie within
    return model


# Fields with numbers of which 0 means that something is absent.
FIXED_ZEROS = ("solref", "solimp", "eq_data", "prm", "range", "gravcomp", "solreffriction", "solref_lim")
FIXED_ZEROS += ("solimp_lim", "solref_fri", "solimp_fri", "size")
# What MuJoCo reads only when it compiles a model, or draws it, or finds contacts; and what it expects to be consistent.
UNREAD = {"geom_rbound", "geom_aabb", "geom_rgba", "geom_gap", "pair_gap", "cam_mat0", "cam_pos0", "cam_poscom0"}
UNREAD |= {"cam_intrinsic", "opt.tolerance", "opt.ls_tolerance", "body_subtreemass", "dof_M0"}


def change_numbers(values, name, random):
    """All numbers up to 10 % larger or smaller, and what is 0 up to 0.05, where that is no mark of something absent."""
    values = values * random.uniform(0.9, 1.1, values.shape)
    if not name.endswith(FIXED_ZEROS):
        values = values + 0.05 * random.uniform(size=values.shape) * (values == 0)
    if name.endswith("lengthspring"):
        values = np.sort(values)
    if name.endswith(("quat", "axis")):
        values = values / np.linalg.norm(values, axis=-1, keepdims=True)
    return values


def find_owner(model, name):
    *path, field = name.removeprefix("model.").split(".")
    return functools.reduce(getattr, path, model), field


def read_fields(model, names):
    return [np.array(getattr(*find_owner(model, name)), float) for name in names]


def vary(model, name, random):
    """The model with one field changed."""
    model = converge(model)
    if name is not None:
        owner, field = find_owner(model, name)
        values = change_numbers(np.array(getattr(owner, field)), name, random)
        setattr(owner, field, float(values) if values.ndim == 0 else values)
    if name == "model.body_mass":  # which C MuJoCo compares with the mass of the subtree
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def step_by_mujoco(model, start):
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:], data.ctrl[:] = start
    mujoco.mj_step(model, data)
    return np.concatenate([data.qvel, data.act, data.sensordata])


def draw_start(model, random):
    """A state with the ball and the foot near the ground, and controls beyond their limits."""
    data = dynamics.draw_state(model, random, speed=1.0)
    data.qpos[-7:-4] = 0.3, 0.3, random.uniform(0.05, 0.1)
    return data.qpos, data.qvel, data.act, 3 * data.ctrl


def test_all_numbers_that_can_be_inputs_are_read():
    """A step with any one of them changed is that of C MuJoCo with the changed model."""
    model, random = make_everything(), np.random.default_rng(0)
    paths = [path for path, x in jax.tree_util.tree_leaves_with_path(put_model(model))]
    leaves = {"model." + jax.tree_util.keystr(path, simple=True, separator=".") for path in paths}
    names = [x for x in list_model_fields(model) if x in leaves and x.removeprefix("model.") not in UNREAD]
    names = [x for x, values in zip(names, read_fields(model, names), strict=True) if values.size]
    starts = [draw_start(model, random) for _ in range(8)]
    variants = [vary(model, name, random) for name in [None, *names]]
    true = np.stack([[step_by_mujoco(each, start) for start in starts] for each in variants])
    rows = [[*start, *read_fields(each, names)] for each in variants for start in starts]
    inputs = ("qpos", "qvel", "act", "ctrl", *names)
    with jax.enable_x64(True):
        program = make_scalar_program(model, inputs, ("qvel", "act", "sensordata"))
        types = find_types(model, inputs)
        given = [np.stack(x).reshape(-1, *kind.shape) for x, kind in zip(zip(*rows, strict=True), types, strict=True)]
        ours = np.concatenate(evaluate(program, given), axis=1).reshape(true.shape)
    size = np.maximum(1, np.abs(true).max(-1, keepdims=True))
    errors, effects = (np.abs(x / size).max((1, 2)) for x in (ours - true, true - true[0]))
    assert {name: error for name, error in zip([None, *names], errors, strict=True) if not error < 1e-9} == {}
    assert {name: effect for name, effect in zip(names, effects[1:], strict=True) if not effect > 1e-9} == {}
