"""Compiled programs kept between runs: same bits, private, verified before use, and never in the way."""

import os
import time
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from jaxpg.store import cache_folder, executables, stderr
from jaxpg.store.cache import compilation_cache
from jaxpg.store.checkpoint import Checkpoints
from jaxpg.store.executables import Executables, machine

hits = []  # jax has no public way to take a listener back: one for all tests
jax.monitoring.register_event_listener(
    lambda event, **_: hits.append(event) if event == "/jax/compilation_cache/cache_hits" else None
)


@pytest.fixture(autouse=True)
def folder(monkeypatch, tmp_path):
    """An empty cache folder of the user, and no choice of jax's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    hits.clear()
    yield tmp_path / "cache" / "jaxpg"
    jax.config.update("jax_compilation_cache_dir", before)


def compile_one(enabled=True, factor=3.0):
    """Compiles a small program and runs it; returns what was said. `hits` has one element if it came from the store."""
    said = []
    with compilation_cache(enabled, said.append):
        compiled = jax.jit(lambda x: jnp.sin(x) * factor).lower(jnp.float32(0)).compile()
    assert compiled(jnp.float32(1)) == pytest.approx(factor * 0.84147, rel=1e-4)
    return said


def entries():
    return sorted(path for path in (cache_folder.locate() / machine()).iterdir() if path.name.startswith("jit__lambda"))


def test_the_second_time_nothing_is_compiled(folder):
    assert compile_one() == []
    assert hits == []
    assert len(entries()) == 1
    assert compile_one() == []
    assert len(hits) == 1
    assert len(entries()) == 1
    assert not list(folder.glob("staging-*"))


def test_another_program_is_another_entry(folder):
    compile_one()
    compile_one(factor=5.0)
    assert hits == []
    assert len(entries()) == 2


def test_off_means_that_nothing_is_written_or_read(folder):
    compile_one(enabled=False)
    assert not folder.exists()
    compile_one()
    compile_one(enabled=False)
    assert hits == []


def test_outside_of_it_jax_is_as_before(folder):
    names = [
        *("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"),
        "jax_persistent_cache_enable_xla_caches",
    ]
    before = [getattr(jax.config, name) for name in names]
    compile_one()
    assert [getattr(jax.config, name) for name in names] == before
    with pytest.warns(UserWarning, match="of something else"), compilation_cache(True, print):
        warnings.warn("of something else", UserWarning, stacklevel=1)
    jax.jit(lambda x: x * 7).lower(jnp.float32(0)).compile()
    assert len(entries()) == 1


def test_a_mistake_inside_is_raised_and_leaves_no_temporary_folder(folder):
    with pytest.raises(ZeroDivisionError), compilation_cache(True, print):
        1 / 0  # noqa: B018
    assert not list(folder.glob("staging-*"))
    assert jax.config.jax_compilation_cache_dir is None


def test_a_cache_that_the_user_chose_is_used_instead(folder, tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "own"))
    compile_one()
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "own")
    assert not folder.exists()


# --- damage -----------------------------------------------------------------------------------------------------------


def truncate(content):
    return content[: len(content) // 2]


def flip(content):
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


@pytest.mark.parametrize("damage", [truncate, flip, lambda content: b""])
def test_a_damaged_entry_is_never_loaded_and_is_replaced(folder, damage):
    compile_one()
    (entry,) = entries()
    entry.write_bytes(damage(entry.read_bytes()))
    (line,) = compile_one()
    assert line.startswith("note: 1 damaged")
    assert hits == [], "it was loaded"
    assert compile_one() == []
    assert len(hits) == 1, "it was not replaced"


def test_an_entry_that_jax_cannot_read_ends_the_cache_of_this_machine(folder):
    """Intact by its digest, and yet not loaded: writing it again would not help. One line, no warning."""
    compile_one()
    (entry,) = entries()
    entry.unlink()
    content = b"this is no program"
    (entry.parent / f"{entry.name.rpartition('.')[0]}.{cache_folder.digest(content)}").write_bytes(content)
    (line,) = compile_one()
    assert "no longer kept" in line
    assert entries() == []
    (line,) = compile_one()
    assert "no compilation cache" in line
    assert entries() == []


def words(feature):
    """XLA's, as shortened here, written to the file descriptor by C++."""
    return (
        f"E0000 cpu_aot_loader.cc] Target machine feature {feature} is not ".encode() + stderr.OTHER_MACHINE + b" ..\n"
    )


@pytest.mark.parametrize(("feature", "kept"), [("+avx10.2", False), ("+prefer-no-gather", True)])
def test_xlas_words_about_another_machine_do_not_reach_the_terminal(folder, capfd, feature, kept):
    """Everything else that is written there still appears. A preference among instructions ends no cache."""
    compile_one()
    said = []
    with compilation_cache(True, said.append):
        os.write(2, words(feature))
        os.write(2, b"something else\n")
    assert capfd.readouterr().err == "something else\n"
    assert ["no longer kept" in line for line in said] == ([] if kept else [True])
    assert bool(entries()) == kept
    os.write(2, b"afterwards\n")
    assert capfd.readouterr().err == "afterwards\n"


# --- whose folder it is -----------------------------------------------------------------------------------------------


def test_the_folders_are_the_users_alone(folder):
    compile_one()
    assert [path.stat().st_mode & 0o777 for path in (folder, folder / machine())] == [0o700, 0o700]


@pytest.mark.parametrize("which", ["root", "machine"])
@pytest.mark.parametrize("mode", [0o770, 0o707])
def test_a_folder_that_others_can_write_to_is_refused(folder, which, mode):
    compile_one()
    before = entries()
    (folder if which == "root" else folder / machine()).chmod(mode)
    (line,) = compile_one(factor=5.0)
    assert "can be written to by others" in line
    assert hits == []
    assert entries() == before


def test_a_folder_of_another_user_is_refused(folder, monkeypatch):
    compile_one()
    monkeypatch.setattr(cache_folder.os, "getuid", lambda: folder.stat().st_uid + 1)
    (line,) = compile_one()
    assert "belongs to another user" in line
    assert hits == []


@pytest.mark.parametrize("which", ["root", "machine"])
def test_a_link_is_refused(folder, tmp_path, which):
    link = folder if which == "root" else folder / machine()
    link.parent.mkdir(mode=0o700, parents=True)
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    link.symlink_to(tmp_path / "elsewhere")
    (line,) = compile_one()
    assert "is not a folder of its own" in line
    assert not [path for path in (tmp_path / "elsewhere").rglob("*") if path.is_file()]


def test_a_place_where_no_folder_can_be_made_is_one_line(folder):
    folder.parent.write_text("a file")
    (line,) = compile_one()
    assert line.startswith("note: no compilation cache")


def test_which_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    for value in ("", "relative/path"):
        monkeypatch.setenv("XDG_CACHE_HOME", value)
        assert cache_folder.locate() == tmp_path / ".cache" / "jaxpg"
    monkeypatch.setenv("XDG_CACHE_HOME", "/var/cache/me")
    assert cache_folder.locate() == Path("/var/cache/me/jaxpg")


def test_every_machine_has_its_folder(monkeypatch):
    names = {machine()}
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
    names.add(machine())
    monkeypatch.setenv("PJRT_NPROC", "77")
    names.add(machine())
    monkeypatch.setattr(executables, "cpu_features", lambda: b"flags: fpu")
    names.add(machine())
    monkeypatch.setattr(executables.jaxlib.version, "__version__", "9.9.9")
    names.add(machine())
    assert len(names) == 5
    assert machine().startswith("jaxlib-9.9.9-")


# --- size and age -----------------------------------------------------------------------------------------------------


def make_file(path, size, age):
    path.parent.mkdir(exist_ok=True, parents=True)
    path.write_bytes(bytes(size))
    os.utime(path, (time.time() - age,) * 2)
    return path


def test_old_entries_of_any_machine_are_removed(folder):
    old = make_file(folder / "jaxlib-0.1" / "old", 1, cache_folder.MAX_AGE + 60)
    new = make_file(folder / "jaxlib-0.1" / "new", 1, cache_folder.MAX_AGE - 60)
    compile_one()
    assert not old.exists()
    assert new.exists()


def test_the_newest_entries_are_kept_up_to_a_size(folder, monkeypatch):
    monkeypatch.setattr(cache_folder, "MAX_BYTES", 100)
    files = [make_file(folder / f"jaxlib-{i % 2}" / str(i), 30, age=60 * i) for i in range(5)]
    cache_folder.remove_old(folder)
    assert [file.exists() for file in files] == [True, True, True, False, False]


def test_entries_from_a_clock_that_was_wrong_leave_room_for_others(folder, monkeypatch):
    """They are not the newest until the clock has caught up with them, nor kept until then."""
    monkeypatch.setattr(cache_folder, "MAX_BYTES", 100)
    ahead = [make_file(folder / "jaxlib-0" / f"ahead {days}", 40, age=-days * 24 * 3600) for days in (400, 20)]
    files = [make_file(folder / "jaxlib-0" / str(i), 40, age=60 * i) for i in range(2)]
    cache_folder.remove_old(folder)
    assert [file.exists() for file in (*ahead, *files)] == [False, False, True, True]
    ahead = [make_file(folder / "jaxlib-0" / f"ahead {days}", 1, age=-days * 24 * 3600) for days in (400, 20)]
    cache_folder.remove_old(folder)
    assert [file.exists() for file in (*ahead, *files)] == [False, True, True, True]


def test_a_clock_set_forward_takes_nothing_from_who_compiles(folder):
    """Another process may take its temporary folder for one that a killed process left; nobody notices."""
    said = []
    with compilation_cache(True, said.append):
        cache_folder.remove_old(folder, now=time.time() + 2 * cache_folder.MAX_STAGING_AGE)
        assert not list(folder.glob("staging-*"))
        jax.jit(lambda x: jnp.sin(x) * 7.0).lower(jnp.float32(0)).compile()
    assert said == []
    assert len(entries()) == 1


def test_what_a_killed_process_left_is_removed_after_a_day(folder):
    """That of a process that still compiles is left alone."""
    with Executables(folder).stage() as left, Executables(folder).stage() as in_use:
        os.utime(left, (time.time() - cache_folder.MAX_STAGING_AGE - 60,) * 2)
        cache_folder.remove_old(folder)
        assert not Path(left).exists()
        assert Path(in_use).exists()


# --- commands ---------------------------------------------------------------------------------------------------------

TINY = (
    *("env=quadratic", "network=linear", "num_envs=2", "num_steps=4", "log_interval=16", "eval_interval=32"),
    *("eval_episodes=2", "total_steps=64", "env.episode_length=8", "report=false"),
)


def result(folder):
    checkpoints = Checkpoints(folder / "checkpoints")
    return checkpoints.record(checkpoints.latest())["leaves"]


@pytest.fixture
def with_default_cache(command_environment, monkeypatch):
    """Commands as users run them, with the cache folder of the test."""
    monkeypatch.setitem(command_environment, "XDG_CACHE_HOME", os.environ["XDG_CACHE_HOME"])


def test_a_run_from_the_cache_has_the_same_bits(with_default_cache, command, folder, tmp_path):
    """The whole program, compiled and loaded; then resumed without the cache."""
    compiled = command("train", *TINY, f"run_dir={tmp_path / 'compiled'}")
    names = {path.name.partition("-")[0] for path in folder.glob("jaxlib-*/*")}
    assert {"jit_advance", "jit_play", "jit_init"} <= names
    before = {path: path.stat().st_mtime_ns for path in folder.glob("jaxlib-*/*")}
    loaded = command("train", *TINY, f"run_dir={tmp_path / 'loaded'}")
    assert {path: path.stat().st_mtime_ns for path in folder.glob("jaxlib-*/*")} == before, "compiled again"
    assert compiled.returncode == loaded.returncode == 0, compiled.stderr + loaded.stderr
    assert compiled.stderr == loaded.stderr == ""
    assert result(tmp_path / "compiled") == result(tmp_path / "loaded")
    resumed = command("train", f"resume={tmp_path / 'loaded'}", "total_steps=128", "cache=false")
    assert resumed.returncode == 0, resumed.stderr
    assert set(folder.glob("jaxlib-*/*")) == set(before)
