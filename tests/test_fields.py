"""What a step is asked for is checked against the model, in the same words whichever way it is computed."""

import functools

import jax
import jax.numpy as jnp
import models
import mujoco
import numpy as np
import pytest

import envs
from envs.physics import PHYSICS, compile_step
from envs.physics.fields import ADDED, OUTPUTS, find_types
from envs.physics.models import import_mjx, put_model

FREE = models.chain('<body pos="0 0 1"><freejoint/><geom size="0.1"/></body>')


@functools.cache
def arm_step(physics):
    return compile_step(envs.make("arm").model, physics=physics)


@functools.cache
def free_step(physics):
    return compile_step(mujoco.MjModel.from_xml_string(FREE), physics=physics)


@pytest.mark.parametrize("physics", PHYSICS)
@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        ([2, 2, 1], r"^ctrl has the shape \(1,\); in one environment it is \(2,\), and batches are made by jax.vmap"),
        ([2, 3, 1], r"^qvel has the shape \(3,\)"),
        ([2, 1, 3], r"^qvel has the shape \(1,\)"),
        ([2, 2, ()], r"^ctrl has the shape \(\);"),
        ([2, 2, (1, 2)], r"^ctrl has the shape \(1, 2\)"),
        ([(4, 2), (4, 2), (4, 2)], r"^qpos has the shape \(4, 2\); in one environment it is \(2,\)"),
    ],
)
def test_a_wrong_shape_is_named(physics, shapes, message):
    with pytest.raises(ValueError, match=message):
        arm_step(physics)(*map(jnp.zeros, shapes))


@pytest.mark.parametrize("physics", PHYSICS)
def test_positions_and_velocities_of_a_free_body_are_not_confused(physics):
    """Together they are as many numbers either way."""
    qpos, qvel, ctrl = jnp.zeros(7), jnp.zeros(6), jnp.zeros(0)
    assert [x.shape for x in jax.eval_shape(free_step(physics), qpos, qvel, ctrl)] == [(7,), (6,)]
    with pytest.raises(ValueError, match=r"^qpos has the shape \(6,\); in one environment it is \(7,\)"):
        free_step(physics)(qvel, qpos, ctrl)
    with pytest.raises(ValueError, match=r"^qpos has the shape \(6,\)"):
        jax.jit(jax.vmap(free_step(physics)))(jnp.zeros((5, 6)), jnp.zeros((5, 7)), jnp.zeros((5, 0)))


REAL = [np.ones(2, int), np.ones(2), np.ones(2, np.float16), [1, 1.0]]


@pytest.mark.parametrize("physics", PHYSICS)
def test_real_numbers_are_taken_and_no_others(physics):
    step, ones = arm_step(physics), jnp.ones(2)
    for same in REAL:
        after = jax.eval_shape(lambda qpos, qvel=same: step(qpos, qvel, qpos), ones)
        assert [x.dtype for x in after] == [jnp.float32, jnp.float32]
    for wrong in (ones > 0, ones + 1j):
        with pytest.raises(TypeError, match=rf"^ctrl has the dtype {wrong.dtype}"):
            step(ones, ones, wrong)
    with pytest.raises(TypeError, match="a function of qpos, qvel, ctrl; got 2 arguments"):
        step(ones, ones)


@pytest.mark.parametrize("physics", ["scalar", "mujoco"])
def test_real_numbers_are_what_they_are_in_float32(physics):
    step, ones = arm_step(physics), jnp.ones(2)
    for same in REAL:
        for ours, true in zip(step(ones, same, ones), step(ones, ones, ones), strict=True):
            np.testing.assert_array_equal(ours, true)


@pytest.mark.parametrize("physics", PHYSICS)
@pytest.mark.parametrize(
    ("inputs", "outputs", "message"),
    [
        (("qpos", "qvell", "ctrl"), ("qpos",), "unknown input 'qvell': did you mean 'qvel'"),
        (("qpos", "qvel", "control"), ("qpos",), "unknown input 'control': did you mean 'ctrl'"),
        (
            ("qpos", "qvel", "model.body_mas"),
            ("qpos",),
            "unknown input 'model.body_mas': did you mean 'model.body_mass'",
        ),
        (
            ("qpos", "qvel", "model.gravity"),
            ("qpos",),
            "unknown input 'model.gravity': did you mean 'model.opt.gravity'",
        ),
        (("qpos", "qvel", "model.opt.gravty"), ("qpos",), "did you mean 'model.opt.gravity'"),
        (("qpos", "qvel", "model.nq"), ("qpos",), "unknown input 'model.nq'"),
        (("qpos", "qvel", "qacc"), ("qpos",), "^qacc is computed by the step"),
        (("qpos", "qvel", "qpos"), ("qpos",), "^qpos is named twice"),
        ((), ("qpos",), "a step needs at least one input"),
        (("qpos", "qvel"), ("qpos", "sitexpos"), "unknown output 'sitexpos': did you mean 'site_xpos'"),
        (("qpos", "qvel"), ("model.body_mass",), "unknown output 'model.body_mass'"),
    ],
)
def test_a_wrong_name_is_named(physics, inputs, outputs, message):
    with pytest.raises(ValueError, match=message):
        compile_step(envs.make("arm").model, inputs=inputs, outputs=outputs, physics=physics)


@pytest.mark.parametrize(
    ("field", "physics", "message"),
    [
        ("model.light_intensity", "mjx", "MJX treats model.light_intensity as a constant"),
        ("model.light_intensity", "scalar", "MJX treats model.light_intensity as a constant"),
        ("model.hfield_data", "mujoco", "model.hfield_data: with physics 'mujoco' it cannot differ"),
    ],
)
def test_a_constant_of_the_model_is_named(field, physics, message):
    with pytest.raises(ValueError, match=message):
        compile_step(envs.make("arm").model, inputs=("qpos", "qvel", field), physics=physics)


def test_outputs_are_the_public_fields_of_mjx_data():
    """With its shapes; without the parts of a state that MJX does not use, and with fields that it does not have."""
    model = models.make("position and velocity servos")
    data = import_mjx().make_data(put_model(model))
    public = {name: x for name, x in vars(data).items() if not name.startswith("_")}
    assert set(OUTPUTS) == (set(public) - {"history", "plugin_state", "userdata"}) | set(ADDED)
    names = [name for name in OUTPUTS if name not in ADDED]
    for name, wanted in zip(names, find_types(model, names), strict=True):
        assert (public[name].shape, public[name].dtype) == (wanted.shape, wanted.dtype), name
