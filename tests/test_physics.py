"""The environments' physics is C MuJoCo's on the same MJCF."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs.base import ASSETS
from envs.physics import MujocoModelError, compile_model, load_spec, mjx_step

MODELS = {
    "pendulum": ("pendulum", {}),
    "arm, torque": ("arm", {}),
    "arm, velocity": ("arm", {"control": "velocity"}),
    "arm, upright": ("arm", {"gravity": True}),
    "arm, upright, velocity": ("arm", {"gravity": True, "control": "velocity"}),
}


@pytest.fixture(scope="module", params=MODELS)
def model(request):
    name, options = MODELS[request.param]
    return envs.make(name, **options).model


def random_states(model, n, seed=0):
    random = np.random.default_rng(seed)
    limit = model.actuator_ctrlrange[:, 1]
    return (
        random.uniform(-np.pi, np.pi, (n, model.nq)),
        random.normal(size=(n, model.nv)),
        limit * random.uniform(-1.2, 1.2, (n, model.nu)),
    )


def mujoco_step(model, data, qpos, qvel, ctrl):
    mujoco.mj_resetData(model, data)
    data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, ctrl
    mujoco.mj_step(model, data)
    return data.qpos.copy(), data.qvel.copy()


def test_single_steps_in_float32(model):
    """10,000 random states and controls, one physics step: to 1e-5."""
    states = random_states(model, 10_000)
    ours = jax.jit(jax.vmap(mjx_step(model, 1)))(*(jnp.asarray(x, jnp.float32) for x in states))
    data = mujoco.MjData(model)
    theirs = [mujoco_step(model, data, *arrays) for arrays in zip(*states, strict=True)]
    for mine, true in zip(ours, zip(*theirs, strict=True), strict=True):
        np.testing.assert_allclose(mine, np.stack(true), rtol=1e-5, atol=1e-5)


def test_a_hundred_steps_in_float64(model):
    """To 1e-8, with a new random control at each step."""
    with jax.enable_x64(True):
        step = jax.jit(mjx_step(model, 1))
        (qpos,), (qvel,), _ = random_states(model, 1)
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = qpos, qvel
        for ctrl in random_states(model, 100, seed=1)[2]:
            qpos, qvel = step(jnp.asarray(qpos), jnp.asarray(qvel), jnp.asarray(ctrl))
            data.ctrl[:] = ctrl
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(qpos, data.qpos, rtol=0, atol=1e-8)
        np.testing.assert_allclose(qvel, data.qvel, rtol=0, atol=1e-8)


def test_substeps_are_steps_with_the_control_held():
    model = envs.make("arm").model
    qpos, qvel, ctrl = (jnp.asarray(x[0], jnp.float32) for x in random_states(model, 1))
    once, thrice = jax.jit(mjx_step(model, 1)), jax.jit(mjx_step(model, 3))
    state = (qpos, qvel)
    for _ in range(3):
        state = once(*state, ctrl)
    for a, b in zip(thrice(qpos, qvel, ctrl), state, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)


def calls_lapack(model):
    arguments = (jnp.asarray(x, jnp.float32) for x in random_states(model, 64))
    return 'custom_call_target="lapack' in jax.jit(jax.vmap(mjx_step(model, 1))).lower(*arguments).compile().as_text()


def test_compiled_step_makes_no_lapack_call(model):
    """Some jaxlib releases hang when batched LAPACK calls fill their thread pool."""
    assert not calls_lapack(model)


def test_dense_matrices_would_call_lapack():
    """The search above finds what it looks for."""
    spec = load_spec(ASSETS / "arm.xml")
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    assert calls_lapack(compile_model(spec))


def test_unreadable_model_files_are_named(tmp_path):
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody><bdy/></worldbody></mujoco>")
    with pytest.raises(MujocoModelError, match=r"broken.xml.*bdy"):
        load_spec(broken)
    with pytest.raises(MujocoModelError, match=r"missing.xml"):
        load_spec(tmp_path / "missing.xml")


def test_models_with_activation_states_are_refused():
    xml = """<mujoco><worldbody><body><joint name="j"/><geom size="0.1"/></body></worldbody>
    <actuator><intvelocity joint="j" actrange="-1 1"/></actuator></mujoco>"""
    with pytest.raises(ValueError, match="activation"):
        mjx_step(mujoco.MjModel.from_xml_string(xml), 1)
