"""A model whose mass is an input of its step is the model compiled with that mass."""

import jax
import jax.numpy as jnp
import models
import mujoco
import numpy as np
import pytest

from envs.physics import compile_step, differing_fields

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
