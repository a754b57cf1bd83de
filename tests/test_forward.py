"""`compile_forward`: what follows from a state, against C MuJoCo's `mj_forward`."""

import jax
import mujoco
import numpy as np
import pytest

from envs.physics import compile_forward
from envs.physics.forward import normalize_quaternions

# RK4 ends a step with the evaluation of another state
MODEL = """<mujoco><option integrator="RK4"/><worldbody><body name="b"><freejoint/>
<geom type="box" size=".1 .2 .3" contype="0" conaffinity="0"/><site name="s" pos="0 0 .3"/><body pos="0 0 .3">
<joint name="j"/>
<geom type="capsule" fromto="0 0 0 0 0 .4" size=".03" contype="0" conaffinity="0"/></body></body></worldbody>
<actuator><motor joint="j"/></actuator><sensor><accelerometer site="s"/></sensor></mujoco>"""
POSES = ("xpos", "xquat", "site_xpos", "subtree_com", "cvel")


@pytest.fixture
def simulation():
    """A model, and its data in a random state with everything that follows from it."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    data.qpos, data.qvel, data.ctrl = random.normal(size=model.nq), random.normal(size=model.nv), 0.7
    mujoco.mj_forward(model, data)
    return model, data


@pytest.mark.parametrize("physics", ["scalar", "mujoco"])
@pytest.mark.parametrize("outputs", [POSES, (*POSES, "sensordata", "qacc")], ids=["poses", "forces"])
def test_fields_are_those_of_the_state(simulation, physics, outputs):
    model, data = simulation
    inputs = ("qpos", "qvel", "ctrl")
    with jax.enable_x64(True):
        compute = compile_forward(model, inputs=inputs, outputs=outputs, physics=physics)
        found = jax.jit(compute)(*(getattr(data, name) for name in inputs))
    for name, value in zip(outputs, found, strict=True):
        np.testing.assert_allclose(value, getattr(data, name), atol=1e-12, err_msg=name)


def test_poses_need_no_forces_and_may_be_traced(simulation):
    """Made and called while a caller is traced; the model's derivative of the position is in its Jacobian."""
    model, data = simulation

    def find_site(qpos):
        return compile_forward(model, inputs=("qpos",), outputs=("site_xpos",))(qpos)[0][0]

    with jax.enable_x64(True):
        jacobian = jax.jit(jax.jacfwd(find_site))(data.qpos)
    np.testing.assert_allclose(jacobian[:, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(jacobian[:, 7], 0.0, atol=1e-12)  # the joint behind the site


def test_a_quaternion_is_made_of_unit_length_and_the_rest_stays(simulation):
    model, data = simulation
    expected = data.qpos.copy()
    mujoco.mj_normalizeQuat(model, expected)
    assert np.abs(expected - data.qpos).max() > 0.1
    with jax.enable_x64(True):
        np.testing.assert_allclose(normalize_quaternions(model, data.qpos), expected, atol=1e-15)
