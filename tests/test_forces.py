"""Positions, forces and accelerations without constraints are C MuJoCo's to 1e-12 in float64."""

import dynamics
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from dynamics import BODIES, TENDONS, compile_unconstrained, draw_state, find_errors, mjx

from envs.physics.dynamics import forward, linear_algebra
from envs.physics.dynamics.kinematics import find_jacobians
from envs.physics.features import unsupported_features
from envs.physics.interpreter import trace
from envs.physics.models import put_model

FIELDS = [
    "qacc",
    "qfrc_smooth",
    "qfrc_passive",
    "qfrc_gravcomp",
    "qfrc_bias",
    "qfrc_actuator",
    "actuator_force",
    "act_dot",
    "actuator_length",
    "ten_length",
]
POSES = [
    "cdof",
    "cvel",
    "cam_xpos",
    "cam_xmat",
    "xpos",
    "xquat",
    "xmat",
    "xipos",
    "ximat",
    "xanchor",
    "subtree_com",
    "geom_xpos",
    "geom_xmat",
    "site_xpos",
    "site_xmat",
]


def write(*args, **options):
    return dynamics.write_mjcf(*args, **options)


def act(*actuators):
    return "<actuator>" + "".join(f"<{actuator}/>" for actuator in actuators) + "</actuator>"


@pytest.fixture(autouse=True)
def in_float64():
    with jax.enable_x64(True):
        yield


def agree(text, fields=FIELDS, tolerance=1e-12, **options):
    errors = find_errors(compile_unconstrained(text), fields, name="forward", **options)
    assert all(error < tolerance for error in errors.values()), errors  # which is False for NaN


COMPENSATED = BODIES.replace('name="b"', 'name="b" gravcomp="1"').replace('name="c"', 'name="c" gravcomp=".5"')
POLYNOMIAL = BODIES.replace('damping=".3" stiffness="2"', 'damping=".3 .2 .1" stiffness="2 .3 .4"')
POLYNOMIAL = POLYNOMIAL.replace('stiffness=".4" damping=".1"', 'stiffness=".4 .2" damping=".1 .3"')
POLYNOMIAL_TENDONS = TENDONS.replace('stiffness="20" damping="1.5"', 'stiffness="20 3 1" damping="1.5 .3 .2"')
SPRUNG = BODIES.replace("<freejoint", '<joint type="free" stiffness="3" damping=".2"')
MOCAP = """<body mocap="true" pos="1 0 .2" quat="1 .2 .3 .4"><geom size=".1"/><body pos="0 0 .2">
  <joint type="slide" axis="1 1 0" pos=".1 0 .2"/><geom size=".1" pos=".1 .2 0"/><site pos=".2 0 0"/></body></body>"""
AT_JOINTS = act(
    'motor joint="j1" gear="3" ctrlrange="-1 1"', 'position joint="j5" kp="30" kv="2" forcerange="-3 3"',
    'velocity joint="j3" kv="3" forcerange="-.5 .5"', 'motor joint="j4" gear="1 .3 .2"',
    'motor jointinparent="j4" gear="1 .3 .2"', 'position joint="j4" kp="3" gear="0 0 1"',
    'motor joint="fj" gear="1 .3 .2 .4 .5 .6"', 'motor jointinparent="fj" gear="1 .3 .2 .4 .5 .6"',
    'general joint="j2" gaintype="affine" gainprm="1 .3 -.8" biastype="affine" biasprm=".1 .2 -.7"',
)  # fmt: skip
AT_SITES = act(
    'motor site="s2" gear="1 2 3 .2 .3 .4"', 'motor site="s3" refsite="s1" gear="1 .2 0 0 0 0"',
    'position site="s3" refsite="w" kp="2" gear="0 0 0 0 1 .3"', 'motor tendon="t1" gear="2"',
    'position site="s3" refsite="s5" kp="2" kv="1" gear="0 .2 0 0 1 .3"', 'position tendon="t2" kp="4" kv="3"',
    'motor cranksite="s3" slidersite="w" cranklength=".4" gear="2"',
    'motor cranksite="s2" slidersite="w" cranklength="2" gear="2"',
)  # fmt: skip
DYNAMIC = act(
    'general joint="j1" dyntype="integrator" gainprm="3" biastype="affine" biasprm="0 -3 -.5" actrange="-1 1"',
    'general joint="j5" dyntype="filter" dynprm=".03" gaintype="affine" gainprm="1 .2 -.4"',
    'general joint="j2" dyntype="filterexact" dynprm=".004" gaintype="affine" gainprm="1 .2 -.4" actearly="true"',
    'general joint="j3" dyntype="filter" dynprm=".02" actearly="true" gainprm="5" actrange="-.3 .3"',
    'intvelocity joint="j4" kp="2" gear="1 0 0" actrange="-9 9"',
)  # fmt: skip
MUSCLES = act(
    'muscle joint="j1" lengthrange="-1 1"', 'muscle joint="j3" lengthrange="-1 1" scale="20" ctrllimited="false"',
    'muscle joint="j5" lengthrange="-.1 .1" timeconst=".02 .05" tausmooth=".3" force="5"',
)  # fmt: skip
SHARED = TENDONS.replace('name="t1"', 'name="t1" actuatorfrcrange="-1 2"')
SHARED += act('motor tendon="t1" gear="2"', 'motor tendon="t1"', 'motor tendon="t2"')
LIMITED = BODIES.replace('name="j1"', 'name="j1" actuatorgravcomp="true" actuatorfrcrange="-1 1"')
GROUPS = act(
    'motor joint="j1" group="1"', 'motor joint="j3" group="2"', 'position joint="j5" group="3" kp="3"',
    'general joint="j1" dyntype="filter" dynprm=".1" group="3"',
)  # fmt: skip
WITH_DAMPING = "<tendon><fixed name='t1'><joint joint='j1' coef='.7'/><joint joint='j5' coef='-1.2'/></fixed></tendon>"
WITH_DAMPING += act(
    'motor joint="j1" damping=".4" armature=".1" gear="2"', 'position joint="j1" kp="3" damping=".2 .1 .3"',
    'motor tendon="t1" damping=".3 .2" armature=".03" gear="2"', 'motor jointinparent="j4" damping=".2" armature=".1"',
    'motor joint="j5" damping=".4 .3" armature=".1" gear="3" group="1"',
)  # fmt: skip
AROUND = '<tendon><spatial name="t" stiffness="5" damping=".3"><site site="w"/><geom geom="round" sidesite="s4"/>'
AROUND += '<site site="s3"/></spatial></tendon>'
ROUND = '<geom name="round" type="cylinder" size=".1 .3" pos=".4 .3 1"/>'

MODELS = {
    "bodies": write(),
    "mocap": write(MOCAP + BODIES),
    "free springs": write(SPRUNG),
    "tendons": write(extra=TENDONS),
    "polynomials": write(POLYNOMIAL, POLYNOMIAL_TENDONS),
    "fluid": write(options='density="1.2" viscosity=".7" wind="1 .3 .2"'),
    "gravity compensation": write(COMPENSATED),
    "all compensated": write(BODIES.replace("<body ", '<body gravcomp="1" ')),
    "compensation by actuators": write(
        LIMITED.replace('name="b"', 'name="b" gravcomp="1"'), act('motor joint="j1"', 'motor joint="j3"')
    ),
    "joints' actuators": write(extra=AT_JOINTS),
    "sites' and tendons' actuators": write(extra=TENDONS + AT_SITES),
    "activations": write(extra=DYNAMIC),
    "muscles": write(extra=MUSCLES),
    "tendons' force limits": write(extra=SHARED),
    "groups": write(options='actuatorgroupdisable="1 3"', extra=GROUPS),
    "actuators' damping": write(extra=WITH_DAMPING),
    "a disabled actuator's damping": write(options='actuatorgroupdisable="1"', extra=WITH_DAMPING),
}


@pytest.mark.parametrize("name", MODELS)
def test_forces(name):
    """Accelerations and all forces on random states, with controls and activations beyond their limits."""
    agree(MODELS[name])


@pytest.mark.parametrize(
    "flag", ["spring", "damper", "spring damper", "gravity", "clampctrl", "actuation", "sensor", "eulerdamp"]
)
def test_flags(flag):
    """What each flag takes away."""
    flags = " ".join(f'{part}="disable"' for part in flag.split())
    agree(write(COMPENSATED, TENDONS + AT_JOINTS, flag=flags, options='density="1.2"'))


def test_poses():
    """Positions and orientations of bodies, geoms, sites and joints, the sign of quaternions included."""
    agree(write(MOCAP + BODIES), POSES)


def test_applied_forces():
    """Forces on joints and wrenches on bodies."""

    def push(d, rng):
        d.qfrc_applied[:], d.xfrc_applied[:] = (
            rng.normal(size=d.qfrc_applied.shape),
            rng.normal(size=d.xfrc_applied.shape),
        )

    agree(write(), ("qacc", "qfrc_smooth"), others=("qfrc_applied", "xfrc_applied"), change=push)


def test_quaternions_of_any_length():
    """Quaternions in qpos need not be of unit length, and 0 is the identity."""

    def stretch(d, rng):
        d.qpos[-4:] *= rng.uniform(0.5, 2)
        d.qpos[3:7] *= 0.0

    agree(write(SPRUNG, AT_JOINTS), [*FIELDS, "xquat"], change=stretch)


def test_jacobians():
    """Of the centres of mass of all bodies."""
    model = compile_unconstrained(write())
    d = draw_state(model, np.random.default_rng(0))
    mujoco.mj_forward(model, d)
    mx = put_model(model)
    start = mjx.make_data(mx)

    def find(qpos):
        d, _ = forward.find_positions(model, mx, start.replace(qpos=qpos))
        return find_jacobians(model, d, d.xipos, np.arange(model.nbody))

    J, J_r = dynamics.compute(find, d.qpos)
    for body in range(model.nbody):
        true = np.zeros((2, 3, model.nv))
        mujoco.mj_jacBodyCom(model, d, true[0], true[1], body)
        np.testing.assert_allclose([J[body].T, J_r[body].T], true, atol=1e-13)


@pytest.mark.parametrize(
    "field", ["body_mass", "body_inertia", "body_ipos", "body_quat", "dof_damping", "actuator_gainprm"]
)
def test_numbers_of_the_model(field):
    """Numbers of the model that are arguments of the traced function."""
    model = compile_unconstrained(write(extra=TENDONS + AT_JOINTS))
    mx = put_model(model)
    start = mjx.make_data(mx)
    rng = np.random.default_rng(0)
    d = draw_state(model, rng)
    value = np.array(getattr(model, field))
    value = value + 0.0 if field == "body_quat" else value * rng.uniform(0.8, 1.2, value.shape)
    value = np.roll(value, 1, 0) * (value.shape[-1] == 4) + value * (value.shape[-1] != 4)

    def accelerate(value, qpos, qvel, ctrl):
        d = start.replace(qpos=qpos, qvel=qvel, ctrl=ctrl)
        return forward.forward(model, mx.replace(**{field: value}), d, forward.unconstrained).qacc

    (ours,) = dynamics.compute(accelerate, value, d.qpos, d.qvel, d.ctrl)
    getattr(model, field)[:] = value
    mujoco.mj_forward(model, d)
    np.testing.assert_allclose(ours, d.qacc, rtol=1e-11, atol=1e-11)


def test_tendons_around_geoms():
    """Length and its derivative, which MJX computes and leaves in `_impl.ten_J`."""
    model = compile_unconstrained(write(BODIES + ROUND, AROUND))
    mx = put_model(model)
    start = mjx.make_data(mx)

    @jax.jit  # the choice of a tangent has no scalar form in MJX
    def find(qpos):
        d, smooth = forward.find_positions(model, mx, start.replace(qpos=qpos))
        return d.ten_length, smooth.tendon_jacobian

    rng = np.random.default_rng(0)
    for _ in range(10):
        d = draw_state(model, rng)
        mujoco.mj_forward(model, d)
        length, ours = find(jnp.asarray(d.qpos))
        true = np.zeros((1, model.nv))
        mujoco.mju_sparse2dense(true, d.ten_J, model.ten_J_rownnz, model.ten_J_rowadr, model.ten_J_colind)
        np.testing.assert_allclose(length, d.ten_length, rtol=1e-12)
        np.testing.assert_allclose(ours, true, atol=1e-12)


def test_unsupported_features_are_named():
    """Nothing of what is computed is listed, and armature of tendons around geoms, which is not, is."""
    for text in MODELS.values():
        assert not unsupported_features(compile_unconstrained(text))
    around = compile_unconstrained(write(BODIES + ROUND, AROUND))
    around.tendon_armature[:] = 0.1
    assert unsupported_features(around) == ["armature of tendons around geoms"]


# --- linear systems ---------------------------------------------------------------------------------------------------


def make_tree_matrix(rng, parents):
    """A random positive definite matrix, coupled as the joints of a tree."""
    size = len(parents)
    lower = np.zeros((size, size))
    for k, parent in enumerate(parents):
        lower[k, k] = rng.uniform(1, 2)
        while parent >= 0:
            lower[k, parent], parent = rng.normal(), parents[parent]
    return lower.T @ lower


def test_factors_solve():
    """A x = b, for one and several right-hand sides, and for a batch."""
    rng = np.random.default_rng(0)
    A = make_tree_matrix(rng, [-1, 0, 1, 1, 0])
    b = rng.normal(size=(5, 3))

    @jax.jit
    def find(A, b):
        batch = jax.vmap(linear_algebra.solve, (None, 1), 1)(A, b)
        return linear_algebra.solve(A, b), batch, linear_algebra.factorize(A)

    x, batch, factor = find(A, b)
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-12)
    np.testing.assert_allclose(batch, x, rtol=1e-12)
    lower = np.tril(factor.lower, -1) + np.eye(5)
    np.testing.assert_allclose(lower.T @ np.diag(1 / factor.inverse) @ lower, A, atol=1e-12)


def test_general_systems():
    """A x = b for a matrix that is not symmetric."""
    rng = np.random.default_rng(0)
    A = make_tree_matrix(rng, [-1, 0, 1, 2]) + 0.1 * rng.normal(size=(4, 4))
    b = rng.normal(size=4)
    np.testing.assert_allclose(linear_algebra.solve_general(jnp.asarray(A), jnp.asarray(b)), np.linalg.solve(A, b))


def test_factors_have_no_new_entries():
    """A star of n chains on one root costs as much per chain, whatever n: nothing is coupled that was not."""
    rng = np.random.default_rng(0)

    def count(chains):
        parents = [-1, *(parent for i in range(chains) for parent in (0, 1 + 2 * i))]
        pattern = make_tree_matrix(rng, parents) != 0
        places = np.cumsum(pattern.reshape(-1)).reshape(pattern.shape) - 1

        def solve(values, b):
            return linear_algebra.solve(jnp.where(pattern, values[places], 0.0), b)

        return len(trace(solve, np.ones(int(pattern.sum())), np.ones(len(parents))))

    assert count(4) - count(3) == count(3) - count(2)
