"""The fields of any state, and inverse dynamics: C MuJoCo's in float64, whichever way they are computed."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from constrained import converge
from dynamics import TENDONS, compile_unconstrained, draw_state, write_mjcf

from envs.physics import compile_forward, compile_inverse, compile_step, scalarize
from envs.physics.dynamics.program import trace_fields, trace_step
from envs.physics.fields import ADDED, INPUTS, JACOBIANS, KINEMATICS, OUTPUTS
from envs.physics.numeric import evaluate

ARM = write_mjcf(
    """<body name="upper"><joint name="shoulder" axis="0 1 0" range="-60 60"/><geom type="capsule" size=".04"
    fromto="0 0 0 .4 0 0"/><body name="fore" pos=".4 0 0"><joint name="elbow" axis="0 1 0" damping=".1"/><geom name="g"
    type="capsule" size=".03" fromto="0 0 0 .3 0 0"/><site name="hand" pos=".3 0 0"/></body></body>""",
    """<actuator><motor joint="shoulder"/></actuator>
    <sensor><jointpos name="angle" joint="elbow"/><gyro name="imu" site="hand"/></sensor>""",
)


def read_field(model, d, name):
    """A field of C MuJoCo's data, or what its functions give."""
    if name not in JACOBIANS:
        return np.array(getattr(d, name), float)
    kind, which = name.split("_jac")
    compute = {"site": mujoco.mj_jacSite, "body": mujoco.mj_jacBody}[kind]
    jacobians = np.zeros((getattr(model, f"n{kind}"), 2, 3, model.nv))
    for number, (jacp, jacr) in enumerate(jacobians):
        compute(model, d, jacp, jacr, number)
    return jacobians[:, "pr".index(which)]


def check(names, ours, true, tolerance=1e-12):
    for name, mine, theirs in zip(names, ours, true, strict=True):
        size = max(1.0, np.abs(theirs).max(initial=0.0))
        np.testing.assert_allclose(
            np.reshape(np.asarray(mine), theirs.shape) / size, theirs / size, atol=tolerance, err_msg=name
        )


def draw_states(model, number):
    random = np.random.default_rng(0)
    states = [draw_state(model, random) for _ in range(number)]
    for d in states:
        d.qfrc_applied[:] = random.normal(size=model.nv)
        d.xfrc_applied[1:] = random.normal(size=(model.nbody - 1, 6))
    return states


def gather(states, names):
    return [np.stack([np.array(getattr(d, name), float) for d in states]) for name in names]


@pytest.mark.parametrize("kind", ["forward", "step"])
def test_every_output_is_c_mujocos(kind):
    """All joints, tendons with armature, a fluid, friction loss and applied forces: nothing is left at 0."""
    actuators = '<actuator><motor joint="j1" gear="3"/><general joint="j5" dyntype="integrator"/></actuator>'
    sensors = '<sensor><force site="s3"/><e_kinetic/></sensor>'
    text = write_mjcf(extra=TENDONS + actuators + sensors, options='density="3" viscosity=".1" wind="1 2 3"')
    text = text.replace('<body name="c"', '<body name="c" gravcomp=".5"')
    text = text.replace('<joint name="j5"', '<joint name="j5" actuatorgravcomp="true" frictionloss=".1"')
    model = converge(mujoco.MjModel.from_xml_string(text))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    names = [name for name in OUTPUTS if name != "eq_active" and (kind == "step" or name not in INPUTS)]
    names = [name for name in names if name not in ("mocap_pos", "mocap_quat", "qfrc_inverse")]
    inputs = ("qpos", "qvel", "act", "ctrl", "time", "qacc_warmstart", "qfrc_applied", "xfrc_applied")
    states = draw_states(model, 10)
    with jax.enable_x64(True):
        program = {"forward": trace_fields, "step": trace_step}[kind](model, inputs, tuple(names))
    ours = evaluate(program, gather(states, inputs))
    for d in states:
        before = d.qvel.copy()
        getattr(mujoco, f"mj_{kind}")(model, d)
        after, d.qvel[:] = d.qvel.copy(), before
        mujoco.mj_rnePostConstraint(model, d)
        d.qvel[:] = after
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    if kind == "step":  # the energy is that of the state before, as all but the state
        names.remove("energy")
        del ours[-len(ADDED)]
    else:
        [mujoco.mj_forward(model, d) for d in states]
    true = [np.stack([read_field(model, d, name) for d in states]) for name in names]
    check(names, ours, true, 1e-10)
    for name, x in zip(names, true, strict=True):
        assert x.any(), name


def test_positions_need_nothing_else():
    """What follows from qpos has few equations, whatever the model has besides, also what only C MuJoCo simulates."""
    text = write_mjcf(extra='<actuator><motor joint="j1" delay=".01" nsample="3"/></actuator>')
    model = mujoco.MjModel.from_xml_string(text)
    program = trace_fields(model, ("qpos",), ("site_xpos[s1]",))
    assert len(program) < 40
    assert not any(stage.body for stage in program.stages)
    states = draw_states(model, 5)
    kinematics = [name for name in KINEMATICS if name != "ten_length"]
    with jax.enable_x64(True):
        ours = evaluate(trace_fields(model, ("qpos",), tuple(kinematics)), gather(states, ("qpos",)))
    for d in states:
        mujoco.mj_forward(model, d)
    check(kinematics, ours, [np.stack([read_field(model, d, name) for d in states]) for name in kinematics])


def test_a_jacobian_is_the_derivative():
    """d site_xpos / d qpos = jacp for hinges, also by C MuJoCo's step, whose fields belong to the state before it."""
    model = mujoco.MjModel.from_xml_string(ARM)
    with jax.enable_x64(True):
        qpos = jnp.array([0.3, -0.7])
        place = compile_forward(model, outputs=("site_xpos[hand]", "site_jacp[hand]", "site_jacr[hand]"))
        position, jacp, jacr = jax.jit(place)(qpos)
        assert position.shape == (3,)
        np.testing.assert_allclose(jacp, jax.jacfwd(lambda q: place(q)[0])(qpos), atol=1e-14)
        np.testing.assert_allclose(jacr, [[0, 0], [1, 1], [0, 0]], atol=1e-14)
        for physics in ("scalar", "mujoco"):
            step = compile_step(model, outputs=("qpos", "site_xpos[hand]", "site_jacp[hand]"), physics=physics)
            after, behind, lagging = jax.jit(step)(qpos, jnp.ones(2), jnp.zeros(1))
            np.testing.assert_allclose(behind, position, atol=1e-14)
            np.testing.assert_allclose(lagging, jacp, atol=1e-14)
            assert np.abs(place(after)[0] - position).max() > 1e-3


def test_a_velocity_of_the_hand_is_followed():
    """Damped least squares as in docs/physics.md: without damping, and away from singularities, jacp qvel = twist."""
    model = mujoco.MjModel.from_xml_string(ARM)

    def follow(J, twist):
        factor = jax.scipy.linalg.cho_factor(J @ J.T + 1e-12 * jnp.eye(2))
        return J.T @ jax.scipy.linalg.cho_solve(factor, twist)

    with jax.enable_x64(True):
        follow = scalarize(follow, jnp.zeros((2, 2)), jnp.zeros(2))
        (jacp,) = compile_forward(model, outputs=("site_jacp[hand]",))(jnp.array([0.3, -0.7]))
        J = jacp[np.array([0, 2])]
        np.testing.assert_allclose(J @ follow(J, jnp.array([0.1, -0.2])), [0.1, -0.2], atol=1e-9)


@pytest.mark.parametrize("constraints", [False, True])
def test_inverse_dynamics_are_c_mujocos(constraints):
    """qfrc_inverse of random accelerations, with limits, friction loss, an equality and a contact if there are any."""
    text = write_mjcf(extra=TENDONS + '<equality><connect body1="e" body2="c" anchor="0 .1 0"/></equality>')
    text = text.replace('<freejoint name="fj"/>', '<freejoint name="fj"/><geom name="foot" size=".2"/>')
    text = text.replace('name="j1"', 'name="j1" range="-10 10" frictionloss=".3"')
    text = text.replace("<worldbody>", '<worldbody><geom name="floor" type="plane" size="3 3 1" pos="0 0 .7"/>')
    text = text.replace("<worldbody>", "<default><geom contype='0'/></default><worldbody>")
    text = text.replace("</mujoco>", '<contact><pair geom1="floor" geom2="foot" condim="4"/></contact></mujoco>')
    model = converge(mujoco.MjModel.from_xml_string(text)) if constraints else compile_unconstrained(text)
    states = draw_states(model, 10)
    for d in states:
        d.qacc[:] = 3 * np.random.default_rng(1).normal(size=model.nv)
    names = ("qfrc_inverse", "qfrc_constraint", "site_xpos[s4]")
    with jax.enable_x64(True):
        program = trace_fields(model, ("qpos", "qvel", "qacc"), names, inverse=True)
        assert not any(stage.body for stage in program.stages), "no solver"
        arguments = gather(states, ("qpos", "qvel", "qacc"))
        ours = evaluate(program, arguments)
        theirs = jax.vmap(compile_inverse(model, outputs=names, physics="mujoco"))(*arguments)
    for d in states:
        mujoco.mj_inverse(model, d)
    true = [(d.qfrc_inverse, d.qfrc_constraint, d.site("s4").xpos) for d in states]
    true = [np.stack(x) for x in zip(*true, strict=True)]
    check(names, ours, true)
    check(names, theirs, true, 0)
    assert true[1].any() == constraints


def test_inverse_and_forward_dynamics_are_inverse():
    """The acceleration that a force gives needs that force: qfrc_inverse(q, v, qacc(q, v, tau)) = tau, with a limit."""
    model = mujoco.MjModel.from_xml_string(ARM)
    with jax.enable_x64(True):
        forward = jax.jit(compile_forward(model, inputs=("qpos", "qvel", "qfrc_applied"), outputs=("qacc",)))
        inverse = jax.jit(compile_inverse(model))
        for qpos in ([0.3, -0.7], [1.3, 0.2]):
            qpos, qvel, force = jnp.array(qpos), jnp.array([1.0, -2.0]), jnp.array([3.0, -1.0])
            (qacc,) = forward(qpos, qvel, force)
            np.testing.assert_allclose(inverse(qpos, qvel, qacc)[0], force, rtol=1e-9)


def test_where_geoms_may_touch_c_mujoco_computes_it():
    """Of watched pairs, in the same call, for the environments that need it."""
    bodies = "".join(f'<body pos="{i} 0 0"><freejoint/><geom type="cylinder" size=".2 .2"/></body>' for i in range(2))
    model = converge(mujoco.MjModel.from_xml_string(write_mjcf(bodies, options='gravity="0 0 0"')))
    qpos = np.tile(model.qpos0, (3, 1))
    qpos[:, 7] = [0.3, 1.0, 0.35]
    with jax.enable_x64(True):
        by_both = [
            jax.vmap(compile_forward(model, outputs=("cfrc_ext", "qacc", "energy"), physics=physics))(qpos)
            for physics in ("scalar", "mujoco")
        ]
        inverse = [
            jax.vmap(compile_inverse(model, inputs=("qpos",), physics=physics))(qpos)[0]
            for physics in ("scalar", "mujoco")
        ]
    for ours, true in zip(*by_both, strict=True):
        np.testing.assert_allclose(ours, true, atol=1e-9 * np.abs(true).max())
    np.testing.assert_allclose(inverse[0], inverse[1], atol=1e-9 * np.abs(inverse[1]).max())
    assert (np.abs(by_both[0][0]).max((1, 2)) > 1).tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("outputs", "message"),
    [
        (("site_xpos[hnd]",), r"^site_xpos\[hnd\]: unknown site 'hnd': did you mean 'hand'\?"),
        (("xpos[fire]",), r"unknown body 'fire': did you mean 'fore'"),
        (("cam_xpos[eye]",), r"unknown camera 'eye': the model has none with a name"),
        (("energy[hand]",), r"^energy\[hand\]: the parts of energy have no names"),
        (("site_xpoos[hand]",), r"unknown output 'site_xpoos': did you mean 'site_xpos'"),
        (("site_jac",), r"unknown output 'site_jac'"),
    ],
)
def test_a_wrong_part_is_named(outputs, message):
    model = mujoco.MjModel.from_xml_string(ARM)
    for compile_function in (compile_step, compile_forward):
        with pytest.raises(ValueError, match=message):
            compile_function(model, outputs=outputs)


def test_what_cannot_be_asked_for_is_named():
    model = mujoco.MjModel.from_xml_string(ARM)
    with pytest.raises(ValueError, match="qacc is computed by the step; the inputs can be"):
        compile_forward(model, inputs=("qpos", "qacc"))
    with pytest.raises(ValueError, match="energy is not computed here; the outputs can be qfrc_inverse"):
        compile_inverse(model, outputs=("energy",))
    with pytest.raises(ValueError, match=r"site_jacp: mjx.step does not compute it; physics 'scalar' and 'mujoco' do"):
        compile_step(model, outputs=("qpos", "site_jacp[hand]"), physics="mjx")
    with pytest.raises(ValueError, match="physics is 'mjx'; it must be one of scalar, mujoco"):
        compile_forward(model, physics="mjx")
    with pytest.raises(ValueError, match=r"qpos has the shape \(3,\); in one environment it is \(2,\)"):
        compile_forward(model)(jnp.zeros(3))


@pytest.mark.parametrize("physics", ["scalar", "mujoco"])
def test_parts_of_fields(physics):
    """Rows of objects, and the numbers of joints and sensors."""
    model = mujoco.MjModel.from_xml_string(ARM)
    names = ("qpos[elbow]", "qvel[elbow]", "xmat[fore]", "sensordata[imu]", "sensordata[angle]", "geom_xpos[g]")
    names += ("qfrc_bias[shoulder]", "body_jacp[fore]", "cfrc_ext[fore]", "time")
    with jax.enable_x64(True):
        step = compile_step(model, 2, outputs=names, physics=physics)
        values = dict(zip(names, step(jnp.array([0.3, -0.7]), jnp.ones(2), jnp.ones(1)), strict=True))
    d = mujoco.MjData(model)
    d.qpos[:], d.qvel[:], d.ctrl[:] = [0.3, -0.7], 1, 1
    for _ in range(2):
        mujoco.mj_step(model, d)
    jacobian = read_field(model, d, "body_jacp")[model.body("fore").id]
    true = [d.joint("elbow").qpos, d.joint("elbow").qvel, d.body("fore").xmat.reshape(3, 3), d.sensor("imu").data]
    true += [d.sensor("angle").data, d.geom("g").xpos, d.joint("shoulder").qfrc_bias, jacobian, np.zeros(6), d.time]
    for (name, value), wanted in zip(values.items(), true, strict=True):
        assert value.shape == np.shape(wanted), name
        np.testing.assert_allclose(value, wanted, atol=1e-12, err_msg=name)
