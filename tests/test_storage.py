"""Equations of physics kept between processes: the same program as the one that was made, and only where it belongs."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_scalarize import CASES

import envs
from envs.physics import scalar, step
from envs.physics.dynamics.program import trace_step
from envs.physics.interpreter import trace
from envs.physics.storage import from_text, make_name, to_text, use_store
from jaxpg.store import cache_folder, texts
from jaxpg.store.cache import physics_cache

MODEL = envs.REGISTRY["pendulum"].build().model
ENDS = ("qpos", "qvel", "ctrl"), ("qpos", "qvel")


@pytest.fixture(autouse=True)
def folder(monkeypatch, tmp_path):
    """An empty cache folder of the user."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "jaxpg" / "physics"


@pytest.fixture
def made(monkeypatch):
    """The models whose step was traced; a process keeps only its last program by itself, which is another one here."""
    models = []

    def counted(model, *ends):
        models.append(model)
        return trace_step(model, *ends)

    monkeypatch.setattr("envs.physics.dynamics.program.trace_step", counted)
    monkeypatch.setattr(scalar, "_latest", Forgetful())
    return models


class Forgetful(dict):
    """A memory that holds a program only until it is read."""

    def __contains__(self, name):
        return False


def lowered(program):
    arguments = [jnp.zeros(array.shape, array.flat[0].dtype) for array in program.inputs]
    return jax.jit(lambda *leaves: program.join(program.run(program.split(leaves)))).lower(*arguments).as_text()


@pytest.mark.parametrize(("name", "case"), [(name, case) for name in CASES for case in range(len(CASES[name]))])
def test_what_is_read_is_what_was_written(name, case):
    """Of every primitive: the same text again, and from it the same program for XLA."""
    program = trace(*_flat(*CASES[name][case]))
    text = to_text(program)
    again = from_text(text)
    assert to_text(again) == text
    assert len(again) == len(program)
    assert lowered(again) == lowered(program)


def _flat(function, arguments):
    """The function and its arguments, as one of leaves only: as the physics has them."""
    leaves, structure = jax.tree.flatten(arguments)
    return lambda *leaves: jax.tree.leaves(function(*jax.tree.unflatten(structure, leaves))), *leaves


def test_other_text_is_no_program():
    text = to_text(trace(lambda x: jnp.sin(x), jnp.zeros(1)))
    with pytest.raises(ValueError, match="sort is not an operation"):
        from_text(text.replace('"sin"', '"sort"'))


def test_the_second_time_nothing_is_traced(folder, made):
    with physics_cache(True):
        first = step.make_scalar_program(MODEL, *ENDS)
        second = step.make_scalar_program(MODEL, *ENDS)
    assert len(made) == 1
    assert len(list(folder.iterdir())) == 1
    assert lowered(first) == lowered(second)


def test_outside_of_it_nothing_is_kept(folder, made):
    with physics_cache(False):
        step.make_scalar_program(MODEL, *ENDS)
    assert not folder.exists()
    with physics_cache(True):
        pass
    step.make_scalar_program(MODEL, *ENDS)
    assert list(folder.iterdir()) == []
    assert len(made) == 2


def test_another_program_has_another_name(monkeypatch):
    heavier = envs.REGISTRY["pendulum"].build(envs.REGISTRY["pendulum"].config(mass=2.0)).model
    names = {make_name(MODEL, *ENDS), make_name(heavier, *ENDS)}
    names |= {make_name(MODEL, ENDS[0], ("qpos",)), make_name(MODEL, ("qvel", "qpos", "ctrl"), ENDS[1])}
    with jax.enable_x64(True):
        names.add(make_name(MODEL, *ENDS))
    monkeypatch.setattr("importlib.metadata.version", lambda name: "0")
    make_name.__globals__["_list_versions"].cache_clear()
    names.add(make_name(MODEL, *ENDS))
    make_name.__globals__["_list_versions"].cache_clear()
    assert len(names) == 6


def test_another_process_finds_it_and_imports_no_mjx(folder):
    """The commands' processes: which of them import MJX is what half of their start-up was."""
    code = """
import sys
from jaxpg.store.cache import physics_cache
from jaxpg.config.parsing import compose
from jaxpg.program.environment import make_env
with physics_cache(True):
    make_env(compose(["env=pendulum"]))
print("mujoco.mjx" in sys.modules)
"""
    found = [
        subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.strip()
        for _ in range(2)
    ]
    assert found == ["True", "False"]
    assert len(list(folder.iterdir())) == 1


# --- damage -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("damage", [lambda text: text[:-9], lambda text: text.replace(b"8", b"9", 1), lambda text: b""])
def test_a_damaged_file_is_made_anew(folder, made, damage):
    with use_store(texts.find("physics")):
        program = step.make_scalar_program(MODEL, *ENDS)
        (path,) = folder.iterdir()
        path.write_bytes(damage(path.read_bytes()))
        assert to_text(step.make_scalar_program(MODEL, *ENDS)) == to_text(program)
        assert len(made) == 2
        step.make_scalar_program(MODEL, *ENDS)
    assert len(made) == 2
    assert len(list(folder.iterdir())) == 1


def test_a_folder_of_others_is_not_read(folder, made):
    with physics_cache(True):
        step.make_scalar_program(MODEL, *ENDS)
    folder.chmod(0o777)
    with physics_cache(True):
        step.make_scalar_program(MODEL, *ENDS)
    assert len(made) == 2


def test_no_folder_is_no_mistake(monkeypatch, tmp_path, made):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with physics_cache(True):
        step.make_scalar_program(MODEL, *ENDS)
    assert len(made) == 1


def test_old_ones_are_removed(folder):
    texts.find("physics").write("name", "text")
    (path,) = folder.iterdir()
    cache_folder.remove_old(cache_folder.locate(), now=path.stat().st_mtime + cache_folder.MAX_AGE + 1)
    assert list(folder.iterdir()) == []
    assert texts.find("physics").read("name") is None


def test_numbers_of_every_kind():
    """Constants that JSON has no word for, and whole numbers beside fractions."""
    constants = jnp.asarray([jnp.inf, -jnp.inf, -0.0, 1e-30, 1 / 3], jnp.float32)
    program = trace(lambda x, i: (jnp.where(x > 0, constants, x), i + 3, constants), jnp.zeros(5), jnp.zeros(2, int))
    again = from_text(to_text(program))
    leaves = [jnp.asarray([-1.0, 1, 1, 1, 1]), jnp.asarray([1, 2])]
    for a, b in zip(*(p.join(p.run(p.split(leaves))) for p in (program, again)), strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.dtype == b.dtype
        assert np.array_equal(np.signbit(a), np.signbit(b))
