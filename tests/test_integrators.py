"""Steps without constraints are C MuJoCo's with every integrator, to 1e-12 in float64."""

from pathlib import Path

import dynamics
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from dynamics import BODIES, TENDONS, compile_unconstrained, draw_state, find_errors, make_function, write_mjcf
from test_forces import AT_JOINTS, AT_SITES, DYNAMIC, GROUPS, MUSCLES, POLYNOMIAL, POLYNOMIAL_TENDONS, WITH_DAMPING

from envs.physics.dynamics.integrators import integrate_position
from envs.physics.interpreter import scalarize, trace

INTEGRATORS = ("Euler", "implicitfast", "implicit", "RK4")
ROBOTS = Path(__file__).parents[2] / "shared" / "robots"
FIELDS = ("qpos", "qvel", "act", "qacc_warmstart", "time")
FREE_PAIR = """<body><freejoint/><geom type="box" size=".1 .2 .3"/>
  <body pos="0 0 .3"><joint axis="1 0 0"/><geom type="box" size=".1 .1 .2" pos="0 0 .2"/></body></body>"""
FLUID = 'density="1.2" viscosity=".7" wind="1 .3 .2"'


@pytest.fixture(autouse=True)
def in_float64():
    with jax.enable_x64(True):
        yield


def agree(model, fields=FIELDS, tolerance=1e-12, **options):
    errors = find_errors(model, fields, **options)
    assert all(error < tolerance for error in errors.values()), errors


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize(
    ("bodies", "extra", "options"),
    [
        pytest.param(BODIES, TENDONS + AT_SITES, "", id="tendons"),
        pytest.param(BODIES, AT_JOINTS, FLUID, id="joints and a fluid"),
        pytest.param(BODIES, DYNAMIC, "", id="activations"),
        pytest.param(BODIES + FREE_PAIR, MUSCLES, "", id="muscles"),
        pytest.param(POLYNOMIAL, POLYNOMIAL_TENDONS, "", id="polynomials"),
        pytest.param(BODIES, WITH_DAMPING, 'actuatorgroupdisable="1"', id="actuators' damping"),
    ],
)
def test_one_step(integrator, bodies, extra, options):
    """Random states, with controls and forces beyond their limits; the stages of RK4 amplify rounding."""
    tolerance = 1e-11 if integrator == "RK4" else 1e-12
    agree(compile_unconstrained(write_mjcf(bodies, extra, integrator, options)), tolerance=tolerance)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_some_steps(integrator):
    """20 steps of a model with everything."""
    model = compile_unconstrained(write_mjcf(BODIES, TENDONS + AT_JOINTS + DYNAMIC, integrator))
    agree(model, ("qpos", "qvel", "act"), tolerance=1e-10, steps=20, speed=0.5, states=3)


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
@pytest.mark.parametrize("flag", ["spring", "damper", "spring damper", "actuation", "eulerdamp", "clampctrl"])
def test_flags(integrator, flag):
    """What the flags take away from the derivatives."""
    flags = " ".join(f'{part}="disable"' for part in flag.split())
    extra = WITH_DAMPING if flag == "damper" else DYNAMIC
    agree(compile_unconstrained(write_mjcf(BODIES, extra, integrator, FLUID, flags)))


def test_disabled_groups():
    """Disabled actuators have no force, no derivative, and keep their activation."""
    extra = GROUPS.replace('kp="3"', 'kp="3" kv="2"')
    agree(compile_unconstrained(write_mjcf(BODIES, extra, "implicitfast", 'actuatorgroupdisable="1 3"')))


def test_a_spinning_body_keeps_its_energy():
    """A free body that spins fast about its middle axis, 1,000 implicitfast steps: C's state, and little drift."""
    text = write_mjcf(
        '<body><freejoint/><geom type="box" size=".1 .2 .3"/></body>', "", "implicitfast", 'gravity="0 0 0"'
    )
    model = compile_unconstrained(text.replace('timestep="0.01"', 'timestep="0.001"'))
    step = scalarize(make_function(model, ("qpos", "qvel")), *(np.zeros(n) for n in (7, 6, 0, 0)))
    d = mujoco.MjData(model)
    d.qvel[3:] = 0.1, 8.0, 0.1

    def advance(state, _):
        ours = step(*state, jnp.zeros(0), jnp.zeros(0))
        return (ours["qpos"], ours["qvel"]), None

    state = jnp.asarray(d.qpos), jnp.asarray(d.qvel)
    (qpos, qvel), _ = jax.jit(lambda state: jax.lax.scan(advance, state, None, 1000))(state)
    before = 0.5 * d.qvel[3:] @ (model.body_inertia[1] * d.qvel[3:])
    for _ in range(1000):
        mujoco.mj_step(model, d)
    np.testing.assert_allclose(qvel, d.qvel, atol=1e-9)
    np.testing.assert_allclose(qpos, d.qpos, atol=1e-9)
    after = 0.5 * qvel[3:] @ (model.body_inertia[1] * qvel[3:])
    assert abs(after / before - 1) < 0.02


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_pendulum_keeps_its_energy(integrator):
    """m g l (1 - cos q) + m l^2 v^2 / 2 over a swing from q = 2, to the order of the method in the step."""
    text = write_mjcf('<body><joint axis="0 1 0"/><geom size=".1" mass="1" pos="0 0 -1"/></body>', "", integrator)
    model = compile_unconstrained(text.replace('timestep="0.01"', 'timestep="0.002"'))
    inertia = model.body_inertia[1, 1] + 1.0
    step = jax.jit(scalarize(make_function(model, ("qpos", "qvel")), *(np.zeros(n) for n in (1, 1, 0, 0))))
    nothing, states = jnp.zeros(0), [{"qpos": jnp.array([2.0]), "qvel": jnp.zeros(1)}]
    for _ in range(1000):
        states.append(step(states[-1]["qpos"], states[-1]["qvel"], nothing, nothing))
    qpos, qvel = (np.ravel([state[name] for state in states[1:]]) for name in ("qpos", "qvel"))
    energies = 9.81 * (1 - np.cos(qpos)) + 0.5 * inertia * qvel**2
    drift = np.abs(energies / energies[0] - 1).max()
    assert drift < (1e-9 if integrator == "RK4" else 1e-2)


def test_positions_stay_on_the_sphere():
    """Quaternions are of unit length after a step, and turn by the angle |omega| h."""
    model = compile_unconstrained(write_mjcf('<body><joint type="ball"/><geom type="box" size=".1 .2 .3"/></body>'))
    q, w = jnp.array([0.3, 0.4, 0.1, 0.2]), jnp.array([1.0, 2.0, 3.0])
    after = integrate_position(model, q, w, 0.1)
    assert abs(float(after @ after) - 1) < 1e-15
    q = q / jnp.linalg.norm(q)
    assert abs(float(after @ q) - np.cos(0.05 * np.sqrt(14))) < 1e-15
    np.testing.assert_allclose(integrate_position(model, q, jnp.zeros(3), 0.1), q, rtol=0, atol=2e-16)


def test_gradients_at_rest():
    """The derivative of a step is C MuJoCo's and that of differences, where angles and speeds are 0 too."""
    model = compile_unconstrained(write_mjcf(BODIES.replace("springref", "ref"), "", "implicitfast"))
    model.opt.gravity[:] = 0
    d = mujoco.MjData(model)
    A = np.zeros((2 * model.nv, 2 * model.nv))
    mujoco.mjd_transitionFD(model, d, 1e-6, True, A, None, None, None)
    function = make_function(model, ("qpos", "qvel"))

    def step(change):
        qpos = integrate_position(model, jnp.asarray(model.qpos0), change[: model.nv], 1.0)
        ours = function(qpos, change[model.nv :], jnp.zeros(0), jnp.zeros(0))
        return jnp.concatenate([ours["qpos"], ours["qvel"]])

    (slope,) = dynamics.compute(jax.jacfwd(step), np.zeros(2 * model.nv))
    np.testing.assert_allclose(slope[model.nq :], A[model.nv :], atol=1e-5)
    size = 2 * model.nv
    near = np.concatenate([1e-5 * np.eye(size), -1e-5 * np.eye(size)])
    (values,) = dynamics.evaluate(trace(step, np.zeros(size)), [near])
    np.testing.assert_allclose(slope, (values[:size] - values[size:]).T / 2e-5, atol=1e-5)


# --- published robots -------------------------------------------------------------------------------------------------


def load_robot(path):
    """A published robot without its meshes, constraints and contacts; skips what does not compile so."""
    spec = mujoco.MjSpec.from_file(str(path))
    for geom in list(spec.geoms):
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH:
            spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    for texture in spec.textures:  # whose files are missing too
        texture.file, texture.builtin = "", mujoco.mjtBuiltin.mjBUILTIN_FLAT
        texture.width = texture.height = 8
    model = spec.compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    return model


def find_robots():
    """The files that hold a whole model."""
    return sorted(path for path in ROBOTS.glob("*/*.xml") if "<worldbody>" in path.read_text())


@pytest.mark.parametrize("path", find_robots(), ids=lambda path: path.stem)
def test_robots(path):
    """One step from fast random states, and 50 steps, which amplify rounding."""
    try:
        model = load_robot(path)
    except ValueError as error:
        pytest.skip(str(error).splitlines()[0])
    agree(model, ("qpos", "qvel", "sensordata", "qacc_warmstart"))
    agree(model, ("qpos", "qvel"), tolerance=1e-10, steps=50, speed=0.3, states=3)


def test_scalarized_is_plain():
    """The function as it is written gives what its equations give."""
    model = compile_unconstrained(write_mjcf(BODIES, TENDONS, "implicitfast"))
    function = make_function(model, ("qpos", "qvel"))
    d = draw_state(model, np.random.default_rng(0))
    arguments = [np.array(getattr(d, field)) for field in ("qpos", "qvel", "act", "ctrl")]
    plain = jax.jit(function)(*arguments)
    scalar = dynamics.compute(lambda *args: tuple(function(*args).values()), *arguments)
    for ours, true in zip(scalar, plain.values(), strict=True):
        np.testing.assert_allclose(ours, true, rtol=1e-12, atol=1e-12)
