"""A batch in tiles is the batch, whichever way it is made."""

import re

import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest

from envs.physics import compile_step, kernels, tiles
from envs.physics.kernels import make_kernel
from envs.physics.tiles import LANES, TILE, mujoco_step

MODEL = models.make("double pendulum")


def states(*batch, seed=0):
    random = np.random.default_rng(seed)
    return [jnp.asarray(random.uniform(-1, 1, (*batch, n)), jnp.float32) for n in (MODEL.nq, MODEL.nv, MODEL.nu)]


@pytest.fixture(scope="module")
def tiled():
    return compile_step(MODEL)


@pytest.fixture(scope="module")
def plain():
    """The same step without tiles."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiles, "FEW_LOOPS", 10**9)
        return compile_step(MODEL)


def agree(ours, theirs, tolerance=1e-6):
    for mine, true in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert mine.shape == true.shape
        assert mine.dtype == true.dtype
        np.testing.assert_allclose(mine, true, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("size", [1, 2, LANES + 1, TILE - 1, TILE, TILE + 1, 2 * TILE, 1000])
def test_batches_of_any_size(tiled, plain, size):
    given = states(size)
    agree(jax.jit(jax.vmap(tiled))(*given), jax.jit(jax.vmap(plain))(*given))


def test_one_environment(tiled, plain):
    agree(tiled(*states()), plain(*states()))


def test_batches_outside_jit(tiled, plain):
    agree(jax.vmap(tiled)(*states(3)), jax.vmap(plain)(*states(3)))


@pytest.mark.parametrize("axes", [(0, 0, 0), (0, None, 1), (None, 1, 0)])
def test_batches_of_batches(tiled, plain, axes):
    """Two axes, in any place, not on every argument: one `mujoco_step` of all environments."""

    def of(step):
        inner = jax.vmap(step, in_axes=(0, 0, None))
        return jax.vmap(inner, in_axes=axes)

    given = [
        jnp.moveaxis(x, 0, axis or 0) if axis is not None else x[0]
        for x, axis in zip([*states(3, 70)[:2], states(3)[2]], axes, strict=True)
    ]
    agree(jax.jit(of(tiled))(*given), jax.jit(of(plain))(*given))
    equations = jax.make_jaxpr(of(tiled))(*given).jaxpr.eqns
    assert [e.outvars[0].aval.shape for e in equations if e.primitive is mujoco_step] == [(210, MODEL.nq)]


def test_other_environments_do_not_see_a_nan(tiled):
    """Not even of the last one, with whose copies the last tile is filled up."""
    qpos, qvel, ctrl = states(TILE + 5)
    sound = jax.jit(jax.vmap(tiled))(qpos, qvel, ctrl)
    broken = jax.jit(jax.vmap(tiled))(qpos.at[-1].set(jnp.nan), qvel, ctrl)
    for before, after in zip(sound, broken, strict=True):
        np.testing.assert_array_equal(before[:-1], after[:-1])
        assert np.isnan(after[-1]).all()


@pytest.mark.parametrize("known", [(0,), (1,), (2,), (0, 1), (0, 1, 2)])
@pytest.mark.parametrize("size", [64, 300])
def test_constants(tiled, plain, known, size):
    """Arguments that are constants of the program that is compiled, which XLA would fold into the kernel."""
    given = states(size)

    def of(step):
        def some(*others):
            others = iter(others)
            return jax.vmap(step)(*(given[i] if i in known else next(others) for i in range(3)))

        return jax.jit(some)(*(x for i, x in enumerate(given) if i not in known))

    agree(of(tiled), of(plain))


def test_arguments_without_influence():
    """The kernel has parameters that nothing is computed from, and one without elements."""
    model = models.make("double pendulum, no motor")
    inputs = ("qpos", "qvel", "ctrl", "time", "model.body_mass", "model.geom_rgba")
    step = compile_step(model, inputs=inputs)
    qpos, qvel, _ = states(10)
    mass = jnp.asarray(np.tile(model.body_mass, (10, 1)), jnp.float32)
    rgba = jnp.zeros((10, *model.geom_rgba.shape))
    ours = jax.jit(jax.vmap(step))(qpos, qvel, jnp.zeros((10, 0)), jnp.arange(10.0), mass, rgba)
    agree(ours, jax.jit(jax.vmap(compile_step(model)))(qpos, qvel, jnp.zeros((10, 0))), 1e-5)


def test_substeps(tiled):
    given = states(200)
    qpos, qvel, ctrl = given
    for _ in range(3):
        qpos, qvel = jax.jit(jax.vmap(tiled))(qpos, qvel, ctrl)
    agree(jax.jit(jax.vmap(compile_step(MODEL, 3)))(*given), (qpos, qvel), 1e-5)


@pytest.mark.parametrize(
    "transform",
    [
        lambda loss: jax.grad(lambda *given: loss(*given).sum(), argnums=(0, 1, 2)),
        lambda loss: lambda *given: jax.jvp(loss, given, tuple(2 * x for x in given)),
        lambda loss: jax.jacfwd(lambda qpos, *others: loss(qpos, *others).sum()),
    ],
    ids=["grad", "jvp", "jacfwd"],
)
@pytest.mark.parametrize("inside", [False, True], ids=["of the batch", "of one"])
def test_derivatives(tiled, plain, transform, inside):
    def of(step):
        def loss(qpos, qvel, ctrl):
            return jnp.sum(jnp.square(jnp.concatenate(step(qpos, qvel, ctrl))))

        return jax.vmap(transform(loss)) if inside else transform(jax.vmap(loss))

    agree(jax.jit(of(tiled))(*states(5)), jax.jit(of(plain))(*states(5)), 1e-5)


def test_several_kernels(plain, monkeypatch):
    monkeypatch.setattr(kernels, "KERNEL", 10)
    step = compile_step(MODEL)
    agree(jax.jit(jax.vmap(step))(*states(300)), jax.jit(jax.vmap(plain))(*states(300)))
    assert (
        len(find_kernels(step, 100)) >= 3
    )  # of one tile; a loop over tiles jax 0.12 makes one kernel of, with all in it


@pytest.mark.parametrize(
    "function",
    [lambda x, y: (jnp.sin(x) + y[:, 0] * y[:, 1],), lambda x, y: (2 * x, y)],
    ids=["used", "handed through"],
)
def test_kernels_of_several_parameters(function):
    x, y = np.linspace(0, 1, 1024, dtype=np.float32), np.random.default_rng(0).random((1024, 7), np.float32)
    repeated = jax.jit(lambda x, y: jax.lax.scan(lambda x, _: (make_kernel(function)(x, y)[0], None), x, length=3)[0])
    true = x
    for _ in range(3):
        true = function(true, y)[0]
    agree(repeated(x, y), true)


def test_a_kernel_uses_all_that_it_is_given():
    """Whatever its function does with it: the compiler may end the process otherwise. Seen in the program's text.

    The marked call's operands come out of a barrier, and all that it does is to hand them on to a call inside it.
    """
    x, y = jnp.ones(4), jnp.ones((4, 3))
    text = jax.jit(make_kernel(lambda x, y: (jnp.sin(x) * y[:, 0],))).lower(x, y).as_text()
    outer, inner = (
        match.groups() for match in re.finditer(r"call @(\S+?)\(([^)]*)\) .*xla_cpu_small_call = \"true\"", text)
    )
    (barrier,) = re.findall(r"(%\w+):2 = stablehlo.optimization_barrier %arg0, %arg1 ", text)
    assert outer[1] == f"{barrier}#0, {barrier}#1"
    assert inner[1] == "%arg0, %arg1"
    assert f"func.func private @{outer[0]}(%arg0: tensor<4xf32>, %arg1: tensor<4x3xf32>)" in text


def find_kernels(step, size):
    compiled = jax.jit(jax.vmap(step)).lower(*states(size)).compile()
    return set(re.findall(rb"[\w.]+_kernel\b", compiled.runtime_executable().serialize()))


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="tiles are for CPUs")
@pytest.mark.parametrize("size", [TILE, 8 * TILE])
def test_a_tile_is_compiled_whole(tiled, plain, size):
    """XLA knows the mark that asks for one; where it does not any more, the step computes the same, but slower.

    The kernel's name is read from the compiled program, which jax gives no promise about.
    """
    assert len(find_kernels(tiled, size)) == 1
    assert not find_kernels(plain, size)


def test_precision_is_that_of_the_tracing():
    """C MuJoCo's step to 1e-12, in float64."""
    with jax.enable_x64(True):
        given = [np.asarray(x, np.float64) for x in states(150)]
        ours = jax.jit(jax.vmap(compile_step(MODEL)))(*given)
        assert all(x.dtype == np.float64 for x in ours)
        agree(ours, models.by_mujoco(MODEL, given), 1e-12)
