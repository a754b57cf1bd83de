"""The physics is MJX's and C MuJoCo's on the same MJCF, whichever way it is computed."""

import logging

import jax
import jax.numpy as jnp
import models
import mujoco
import numpy as np
import pytest
from constrained import converge
from hypothesis import given, settings
from hypothesis import strategies as st

import envs
from envs.base import ASSETS, MjxEnv
from envs.physics import (
    MujocoModelError,
    check_model,
    compile_model,
    compile_step,
    ignored_features,
    load_model,
    load_spec,
    scalar,
)

STATE = ("qpos", "qvel")


def in_float32(arrays):
    return [jnp.asarray(x, jnp.float32) for x in arrays]


def by_mjx(model, states):
    """The same by `mjx.step`, one state after the other: many models are very slow when they are batched."""
    step = jax.jit(compile_step(model, physics="mjx"))
    return [np.stack(x) for x in zip(*(step(*map(jnp.asarray, s)) for s in zip(*states, strict=True)), strict=True)]


def agree(ours, theirs, tolerance):
    for mine, true in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(mine, true, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("name", [*models.SHIPPED, *models.MJCF, "panda"])
def test_single_steps_in_float32(name):
    """10,000 random states and controls, one physics step: C MuJoCo's to 1e-5 of the largest velocity.

    The seven-joint arm's wrist is worse conditioned: `mjx.step` itself is off by 1.5e-5 there in float32.
    """
    tolerance = 3e-5 if name == "panda" else 1e-5
    model = models.make(name)
    states = models.random_states(model, 10_000)
    ours = jax.jit(jax.vmap(compile_step(model)))(*in_float32(states))
    for mine, true in zip(ours, models.by_mujoco(model, states), strict=True):
        size = np.maximum(1.0, np.abs(true).max(1, keepdims=True))
        np.testing.assert_allclose(mine / size, true / size, rtol=0, atol=tolerance)


@pytest.mark.parametrize("name", models.CONSTRAINED)
def test_constrained_steps_are_those_of_a_converged_solver(name):
    """Limits, friction loss, equalities, contacts: C MuJoCo's to 1e-9 of the largest velocity, in float64.

    The solver of the models themselves makes one round.
    """
    with jax.enable_x64(True):
        model = models.make(name)
        states = models.random_states(model, 100)
        ours = jax.jit(jax.vmap(compile_step(model)))(*map(jnp.asarray, states))
        for mine, true in zip(ours, models.by_mujoco(converge(model), states), strict=True):
            np.testing.assert_allclose(mine, true, rtol=0, atol=1e-9 * max(1.0, np.abs(true).max()))


@pytest.mark.study
@pytest.mark.parametrize("name", [*models.SHIPPED, *models.MJCF, "panda"])
def test_single_steps_are_mjxs(name):
    """10,000 random states and controls, without constraints: `mjx.step`'s to 1e-12 in float64."""
    model = models.make(name)
    states = models.random_states(model, 10_000)
    with jax.enable_x64(True):
        true = by_mjx(model, states)
        agree(jax.jit(jax.vmap(compile_step(model)))(*map(jnp.asarray, states)), true, 1e-12)


@pytest.mark.parametrize("name", models.SHIPPED)
def test_a_hundred_steps_in_float64(name):
    """C MuJoCo's to 1e-8, with a new random control at each step."""
    with jax.enable_x64(True):
        model = models.make(name)
        step = jax.jit(compile_step(model))
        (qpos,), (qvel,), _ = models.random_states(model, 1)
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = qpos, qvel
        for ctrl in models.random_states(model, 100, seed=1)[2]:
            qpos, qvel = step(jnp.asarray(qpos), jnp.asarray(qvel), jnp.asarray(ctrl))
            data.ctrl[:] = ctrl
            mujoco.mj_step(model, data)
        agree((qpos, qvel), (data.qpos, data.qvel), 1e-8)


@st.composite
def trees(draw):
    """MJCF of a random kinematic tree of two to four bodies with any joints and no contact."""
    numbers = st.floats(-1, 1).map(lambda x: round(x, 2))
    count = draw(st.integers(2, 4))
    parents = [-1] + [draw(st.integers(0, i - 1)) for i in range(1, count)]

    def body(i):
        kind = draw(st.sampled_from(["hinge", "slide", "ball", "none"] if i else ["hinge", "slide", "ball", "free"]))
        axis = draw(st.sampled_from(["1 0 0", "0 1 0", "0.6 0 0.8", "1 1 1"]))
        position = f"{draw(numbers)} {draw(numbers)} {draw(numbers)}"
        turn = draw(st.sampled_from(["1 0 0 0", "1 1 0 0", "1 0 -1 0", "0.9 0.1 0.3 -0.2"]))
        joint = {
            "free": "<freejoint/>",
            "none": "",
            "ball": f'<joint type="ball" damping="{draw(st.sampled_from([0, 0.2]))}"/>',
        }.get(kind, f'<joint type="{kind}" axis="{axis}" damping="{draw(st.sampled_from([0, 0.3]))}" armature="0.01"/>')
        children = "".join(body(j) for j in range(count) if parents[j] == i)
        return f'<body pos="{position}" quat="{turn}">{joint}<geom type="box" size="0.1 0.2 0.15"/>{children}</body>'

    return models.chain(body(0))


@settings(deadline=None, max_examples=2)
@given(trees(), st.integers(0, 100))
def test_random_trees(xml, seed):
    """C MuJoCo's to 1e-10, in float64."""
    with jax.enable_x64(True):
        model = mujoco.MjModel.from_xml_string(xml)
        states = models.random_states(model, 20, seed)
        agree(jax.vmap(compile_step(model))(*map(jnp.asarray, states)), models.by_mujoco(model, states), 1e-10)


def test_substeps_are_steps_with_the_control_held():
    model = envs.make("arm").model
    states = [x[0] for x in in_float32(models.random_states(model, 1))]
    once, thrice = jax.jit(compile_step(model)), jax.jit(compile_step(model, 3))
    state = states[:2]
    for _ in range(3):
        state = once(*state, states[2])
    agree(thrice(*states), state, 1e-6)


def test_other_inputs_and_outputs():
    """Parameters of the model as inputs, positions of sites as outputs, a substep's time: what MJX gives."""
    model = envs.make("arm", gravity=True).model
    inputs = ("qpos", "qvel", "ctrl", "time", "model.body_mass", "model.opt.gravity")
    outputs = ("site_xpos", "qvel", "time")
    mass, gravity = 2 * model.body_mass, np.array([0.0, 1.0, -3.0])
    arguments = in_float32([*(x[0] for x in models.random_states(model, 1)), 0.5, mass, gravity])
    ours, theirs = (
        jax.jit(compile_step(model, 2, inputs=inputs, outputs=outputs, physics=physics))(*arguments)
        for physics in ("scalar", "mjx")
    )
    agree(ours, theirs, 1e-5)
    assert ours[2] == pytest.approx(0.52)
    with pytest.raises(TypeError, match="qpos, qvel, ctrl, time"):
        compile_step(model, inputs=inputs)(*arguments[:3])


@pytest.mark.parametrize(
    ("name", "by_mjx"),
    [
        pytest.param("pendulum", True, marks=pytest.mark.study),
        ("arm, velocity", False),
        pytest.param("arm, velocity", True, marks=pytest.mark.study),
        pytest.param("free body", True, marks=pytest.mark.study),
    ],
)
def test_gradients_through_fifty_steps(name, by_mjx):
    """In float64: central differences' to 1e-5, and those of `mjx.step`, which take long to compile, to 1e-8."""
    with jax.enable_x64(True):
        model = models.make(name)
        qpos, qvel, ctrl = (jnp.asarray(0.3 * x[0]) for x in models.random_states(model, 1))

        def loss(step, qvel):
            state, _ = jax.lax.scan(lambda s, _: (step(*s, ctrl), None), (qpos, qvel), length=50)
            return jnp.sum(jnp.sin(state[0])) + jnp.sum(state[1] ** 2)

        step = compile_step(model)
        ours = jax.jit(jax.grad(lambda v: loss(step, v)))(qvel)
        value = jax.jit(lambda v: loss(step, v))
        nudges = 1e-6 * np.eye(len(qvel))
        numeric = [(value(qvel + nudge) - value(qvel - nudge)) / 2e-6 for nudge in nudges]
        agree([ours], [np.array(numeric)], 1e-5)
        if by_mjx:
            step = compile_step(model, physics="mjx")
            agree([ours], [jax.jit(jax.grad(lambda v: loss(step, v)))(qvel)], 1e-8)


def test_a_nan_in_the_state_stays_there():
    model = models.make("arm, torque")
    step = jax.jit(compile_step(model))
    states = [x[0] for x in in_float32(models.random_states(model, 1))]
    for i, x in enumerate(states):
        for place in range(len(x)):
            after = step(*states[:i], x.at[place].set(jnp.nan), *states[i + 1 :])
            assert np.isnan(np.concatenate(after)).any()


def test_what_has_no_equations_is_stepped_by_c_mujoco(caplog, monkeypatch):
    """A feature that only C MuJoCo has, here the delay of an actuator: its results, and one line that names it."""
    model = mujoco.MjModel.from_xml_string(
        models.chain(models.LIMITED, '<motor joint="slide" delay="0.01" nsample="5"/>')
    )
    states = models.random_states(model, 20)
    monkeypatch.setattr(scalar, "_warned", set())
    with caplog.at_level(logging.WARNING), jax.enable_x64(True):
        step = compile_step(model)
        compile_step(model)
        (record,) = caplog.records
        assert "is stepped by C MuJoCo" in record.getMessage()
        assert "delay of actuators" in record.getMessage()
        agree(jax.jit(jax.vmap(step))(*map(jnp.asarray, states)), models.by_mujoco(model, states), 0)


def compiled_text(step, model):
    arguments = map(jnp.asarray, models.random_states(model, 64))
    return jax.jit(jax.vmap(step)).lower(*arguments).compile().as_text()


def calls_lapack(step, model):
    return 'custom_call_target="lapack' in compiled_text(step, model)


@pytest.mark.parametrize("name", [*models.SHIPPED, "joint limits, Newton"])
def test_compiled_step_calls_neither_lapack_nor_ynnpack(name):
    """Some releases of jaxlib hang in batched calls of the one, others compute wrong sums by the other."""
    model = models.make(name)
    step = compile_step(model)
    assert not calls_lapack(step, model)
    assert "ynn_fusion" not in compiled_text(step, model)


def test_dense_matrices_by_mjx_call_lapack():
    """The search above finds what it looks for."""
    spec = load_spec(ASSETS / "arm.xml")
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    model = compile_model(spec)
    assert calls_lapack(compile_step(model, physics="mjx"), model)


@pytest.mark.study
@pytest.mark.parametrize("num_envs", [1_024, 16_384])
@pytest.mark.parametrize("name", ["pendulum", "arm, torque", "panda"])
def test_a_thousand_calls_end(name, num_envs):
    """Some jaxlib releases hang after some hundred calls of programs with LAPACK or YNNPACK in them."""
    model = models.make(name)
    qpos, qvel, ctrl = in_float32(models.random_states(model, num_envs))
    step = jax.jit(jax.vmap(compile_step(model)))
    for _ in range(1_000):
        qpos, qvel = step(qpos, qvel, 0.01 * ctrl)
    assert np.isfinite(qvel).all()


@pytest.mark.parametrize("physics", ["mjx", "mujoco"])
def test_environments_have_other_physics(physics):
    """`env.physics=mjx` and `mujoco` take the same steps, of several environments at once."""
    state = jax.vmap(envs.make("arm").reset)(jax.random.split(jax.random.key(0), 3))
    action = jnp.asarray([[0.4, -0.7], [1.0, 0.0], [-0.2, 0.5]])
    ours, theirs = (jax.jit(jax.vmap(envs.make("arm", physics=x).step))(state, action) for x in ("scalar", physics))
    agree(jax.tree.leaves(ours), jax.tree.leaves(theirs), 1e-5)


def test_unreadable_model_files_are_named(tmp_path):
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody><bdy/></worldbody></mujoco>")
    with pytest.raises(MujocoModelError, match=r"broken.xml.*bdy"):
        load_spec(broken)
    with pytest.raises(MujocoModelError, match=r"missing.xml"):
        load_spec(tmp_path / "missing.xml")


def test_bad_arguments_are_named():
    activated = models.chain(models.pole(), '<intvelocity joint="pole" actrange="-1 1"/>')
    with pytest.raises(ValueError, match="activation"):
        compile_step(mujoco.MjModel.from_xml_string(activated))
    with pytest.raises(ValueError, match="scalar, mjx, mujoco"):
        compile_step(models.make("cart-pole"), physics="c")
    unsupported = models.chain(models.pole(), option='<option integrator="implicit"/>')
    with pytest.raises(MujocoModelError, match="MJX cannot step it"):
        compile_step(mujoco.MjModel.from_xml_string(unsupported), physics="mjx")
    with pytest.raises(ValueError, match="all, hull, primitives, none"):
        compile_step(models.make("cart-pole"), collision="boxes")


def test_features_that_mjx_leaves_out_are_named():
    assert ignored_features(models.make("cart-pole")) == []
    odd = models.chain(
        models.pole('<site name="s"/>', joint='damping="0.1"').replace("<geom", '<geom gap="0.1"'),
        '<motor joint="pole" group="1"/>',
        '<option noslip_iterations="3" actuatorgroupdisable="1"/>',
        '<sensor><accelerometer site="s"/></sensor>',
    )
    found = ignored_features(mujoco.MjModel.from_xml_string(odd))
    for words in ("noslip", "groups of actuators", "accelerometer"):
        assert any(words in line for line in found), (words, found)


@pytest.mark.parametrize("name", ["arm, upright, velocity", "fixed tendon"])
def test_models_that_mjx_steps_as_mujoco_does_pass_the_check(name):
    assert check_model(models.make(name)) == []


def test_models_that_mjx_steps_otherwise_fail_the_check():
    """The damping of an actuator is left out: the check says so, and that it matters."""
    model = mujoco.MjModel.from_xml_string(models.chain(models.pole(), '<motor joint="pole" damping="3"/>'))
    left_out, difference = check_model(model, physics="mjx")
    assert "damping of actuators" in left_out
    assert "differs from C MuJoCo" in difference


def test_a_motion_that_diverges_in_mujoco_is_named(tmp_path, monkeypatch, capfd):
    """The check leaves no file of warnings behind."""
    monkeypatch.chdir(tmp_path)
    stiff = '<general joint="pole" biastype="affine" biasprm="0 -1e7 0" gainprm="1e7"/>'
    (line,) = check_model(mujoco.MjModel.from_xml_string(models.chain(models.pole(), stiff)))
    assert "C MuJoCo's own motion diverges in step" in line
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr().err == ""


def test_a_model_is_checked_when_it_is_first_loaded(tmp_path, caplog):
    """By `load_model` and by an environment over it: once in a process, whichever comes first."""
    path = tmp_path / "crane.xml"
    stiff = '<general joint="pole" biastype="affine" biasprm="0 -1e7 0" gainprm="1e7"/>'
    path.write_text(models.chain(models.pole(), stiff).replace("<mujoco", '<mujoco model="crane"'))
    load_model(path)
    (line,) = (record.getMessage() for record in caplog.records)
    assert line.startswith("crane: C MuJoCo's own motion diverges")
    MjxEnv(load_spec(path))
    assert len(caplog.records) == 1
    path.write_text(path.read_text().replace("1e7", "2e7"))
    MjxEnv(load_spec(path))
    assert len(caplog.records) == 2
