"""Batches divided over devices have the results of one device, to the bit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stored import a_policy

import envs
from envs.physics import compile_step, divide_batch
from jaxpg.config.parsing import compose
from jaxpg.program import backend
from jaxpg.watch.episodes import play_native

ONE, TWO = jax.devices()[:1], jax.devices()


def equal(ours, theirs):
    jax.tree.map(np.testing.assert_array_equal, ours, theirs)


@pytest.mark.optimized
def test_steps_have_the_same_bits():
    step = jax.vmap(compile_step(envs.make("arm").model))
    for size in (1, 100, 300):
        x = np.random.default_rng(size).normal(size=(3, size, 2)).astype(np.float32)
        on_two = divide_batch(step, devices=TWO)(*x)
        equal(on_two, divide_batch(step, devices=ONE)(*x))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), on_two, jax.jit(step)(*x))
        assert all(part.shape == (size, 2) for part in on_two)


@pytest.mark.optimized
def test_an_evaluation_has_the_same_bits(monkeypatch):
    """Of episodes that do not fill vectors, also if they are halved."""
    stored = a_policy("env=pendulum", "env.episode_length=100")
    on_two = play_native(stored, 100, seed=1)
    monkeypatch.setattr(jax, "devices", lambda: ONE)
    equal(on_two, play_native(stored, 100, seed=1))


def test_trees_keys_and_shared_arguments():
    keys, rows = jax.random.split(jax.random.key(0), 40), {"a": jnp.arange(80.0).reshape(40, 2)}

    def function(gain, rows, keys):
        return {"b": gain["c"] * rows["a"].sum(1)}, jax.vmap(jax.random.uniform)(keys)

    ours = divide_batch(function, (None, 0, 0))({"c": 3.0}, rows, jax.random.clone(keys))
    equal(ours, function({"c": 3.0}, rows, keys))


def test_each_device_computes_a_part():
    parts = []
    divided = divide_batch(lambda x: (parts.append(x.shape), jnp.sin(x))[1])
    assert divided.lower(jnp.zeros((70, 3))).compile().output_shardings.device_set == set(TWO)
    assert parts == [(48, 3)]  # of 96, with what fills up


@pytest.mark.parametrize(
    ("function", "in_axes", "shapes", "message"),
    [
        (jnp.add, 0, [(3,), (4,)], r"the arguments have the shapes \(3,\), \(4,\): expected \[N, ...\]"),
        (jnp.add, 0, [(3,), ()], r"the arguments have the shapes \(3,\), \(\): "),
        (jnp.add, 0, [(0,), (0,)], r"the arguments have the shapes \(0,\): "),
        (jnp.add, None, [(3,), (3,)], "the arguments have the shapes none: "),
        (jnp.add, (0,), [(3,), (3,)], r"in_axes=\(0,\): expected 0 or None, for each of 2 arguments"),
        (jnp.add, (0, 1), [(3,), (3,)], r"in_axes=\(0, 1\): expected 0 or None"),
        (jnp.sum, 0, [(3,)], r"the results and arguments of a part have the shapes \(\), \(16,\): "),
    ],
)
def test_what_is_no_batch_is_refused(function, in_axes, shapes, message):
    with pytest.raises(ValueError, match=f"^divide_batch: {message}"):
        divide_batch(function, in_axes)(*map(jnp.zeros, shapes))


def test_no_devices_are_refused():
    with pytest.raises(ValueError, match="expected at least one device"):
        divide_batch(jnp.sin, devices=())


@pytest.mark.parametrize(("divided", "number"), [(True, 3), (False, 2)])
def test_an_evaluation_has_a_device_for_each_core_and_a_training_for_each_shard(monkeypatch, divided, number):
    made = {}
    monkeypatch.setenv("PJRT_NPROC", "3")
    monkeypatch.setattr(jax.config, "update", made.__setitem__)
    backend.prepare(compose(["algo.num_shards=2", "num_envs=4"]), divided=divided)
    assert made == {"jax_num_cpu_devices": number}
