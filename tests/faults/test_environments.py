"""Any environment ends with a finite best policy, a report and an export, or in clear lines; never in a traceback.

`pytest -m faults tests/faults/test_environments.py` tries five hundred. What fails is said as a command that tries it
again: `python tests/faults/test_environments.py DESCRIPTION`.
"""

import contextlib
import itertools
import json
import os
import shlex
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from environments import Config
from flax import struct
from hypothesis import given, note
from hypothesis import strategies as st
from rounds import examples, rounds

import envs
from envs.base import Interface, State
from jaxpg import export, train
from jaxpg.commands.ending import run_command
from jaxpg.program import compile as program
from jaxpg.store import cache_folder, policies

FEW, MANY = 1, 26  # rounds, of a dozen examples and then of 20
NAMES = ("x", "x", "x", "return", "reward", "value", "length", "success", "distance", "diverged", "update", "steps")
NAMES += ("2link", "double", "policy", "", " ", "a/b", "..", "größe [m]", '"', "</script>", "x" * 80, "a b", "%s", "{}")
TYPES = ("float32", "float32", "float32", "float16", "bfloat16", "int32", "bool")
ENDS = ("never", "far", "fourth", "at once")
DIVERGENCES = ("", "", "", "obs", "reward", "state", "after the end", "huge obs", "huge reward", "reset", "metric")
MISTAKES = (
    "",
    "",
    "",
    "",
    "",
    "reward of shape (1,)",
    "a dict",
    "an image",
    "no names",
    "a limit of 0",
    "a new metric",
)
MISTAKES += ("another size", "a state that changes", "raises")


@st.composite
def descriptions(draw):
    """An environment and a training of it, as plain values."""

    def one_of(values):
        return draw(st.sampled_from(values))

    observations, actions = draw(st.integers(1, 4)), draw(st.integers(1, 3))
    return {
        "name": one_of([name for name in NAMES if name.strip()]),
        "sizes": [observations, actions],
        "types": [one_of(TYPES) for _ in range(4)],
        "scales": [10.0 ** draw(st.integers(-5, 5)), draw(st.integers(-1, 1)) * 10.0 ** draw(st.integers(0, 4))],
        "reward": 10.0 ** draw(st.integers(-8, 8)),
        "end": one_of(ENDS),
        "diverges": one_of(DIVERGENCES),
        "how often": one_of((0.01, 0.2, 1.0)),
        "metrics": draw(st.lists(st.sampled_from(NAMES), max_size=3, unique=True)),
        "interface": draw(st.booleans()),
        "names": [one_of(NAMES) for _ in range(observations + actions)],
        "limits": draw(
            st.none() | st.lists(st.sampled_from((1e-3, 1.0, 80.0, 1000.0)), min_size=actions, max_size=actions)
        ),
        "mistake": one_of(MISTAKES),
        "training": {
            "algo": one_of(("td", "td", "ppo", "reinforce", "online")),
            "network": one_of(("mlp", "linear")),
            "num_seeds": one_of((1, 1, 2)),
            "nan_policy": one_of(("stop", "skip")),
            "seed": draw(st.integers(0, 9)),
        },
        "shards": one_of((1, 1, 2)),
    }


@struct.dataclass
class Drawn:
    """What is carried: the point, the time, and where random numbers come from."""

    x: jax.Array
    time: jax.Array
    key: jax.Array


class Environment:
    """A point that is pushed, observed and rewarded as the description says."""

    dt = 0.05

    def __init__(self, about):
        self.about = about
        self.observation_size, self.action_size = about["sizes"]
        self.observation_size += about["mistake"] == "another size"
        if about["interface"]:
            names = about["names"][: about["sizes"][0]], about["names"][about["sizes"][0] :]
            limits = about["limits"] and np.array(about["limits"])
            if about["mistake"] == "a limit of 0":
                limits = [0.0] * self.action_size
            self.interface = Interface((names[0] * 2 if about["mistake"] == "no names" else names[0]), names[1], limits)

    def reset(self, rng):
        key, key_x = jax.random.split(rng)
        x = jax.random.uniform(key_x, minval=-1.0, maxval=1.0)
        x = self.perhaps("reset", x, jnp.nan, key)
        state = Drawn(x, jnp.zeros((), jnp.int32), jax.random.key_data(key))
        return State(state, self.observed(x, key), *self.outcome(x, 0 * x, state.time, key), {**self.measured(x, key)})

    def step(self, state, action):
        about, carried = self.about, state.pipeline_state
        if about["mistake"] == "raises":
            raise RuntimeError("nothing works\nat all")
        next_key, key = jax.random.split(jax.random.wrap_key_data(carried.key))
        x = carried.x + 0.1 * jnp.clip(action, -1, 1).sum()
        x = self.perhaps("state", x, jnp.nan, key)
        time = carried.time + (1.0 if about["mistake"] == "a state that changes" else 1)
        reward, done = self.outcome(x, about["reward"] * (1 - x**2), time, key)
        metrics = self.measured(x, key) | ({"new": x} if about["mistake"] == "a new metric" else {})
        carried = Drawn(x, time, jax.random.key_data(next_key))
        return State(carried, self.observed(x, key), reward, done, metrics)

    def perhaps(self, what, value, otherwise, key):
        about = self.about
        if what != about["diverges"]:
            return value
        return jnp.where(jax.random.uniform(jax.random.fold_in(key, 1)) < about["how often"], otherwise, value)

    def observed(self, x, key):
        (scale, offset), number = self.about["scales"], self.about["sizes"][0]
        obs = offset + scale * jnp.stack([x, x**2, jnp.sin(x), jnp.ones(())])[:number]
        obs = self.perhaps("huge obs", self.perhaps("obs", obs, jnp.nan, key), 1e20, key).astype(self.about["types"][0])
        return {"a dict": {"x": obs}, "an image": obs[None]}.get(self.about["mistake"], obs)

    def outcome(self, x, reward, time, key):
        """Reward and done."""
        ends = {"never": False, "far": jnp.abs(x) > 1.5, "fourth": time >= 4, "at once": time >= 1}[self.about["end"]]
        late = time > 4 if self.about["diverges"] == "after the end" and self.about["end"] == "fourth" else False
        reward = jnp.where(late, jnp.nan, self.perhaps("reward", reward, jnp.nan, key))
        reward = self.perhaps("huge reward", reward, 1e30, key).astype(self.about["types"][1])
        return reward[None] if self.about["mistake"] == "reward of shape (1,)" else reward, jnp.asarray(
            ends, self.about["types"][2]
        )

    def measured(self, x, key):
        value = self.perhaps("metric", jnp.abs(x), jnp.nan, key)
        return {name: value.astype(self.about["types"][3]) for name in self.about["metrics"]}


def arguments(about):
    """Of a training that takes a second or two."""
    sizes = {"num_envs": 4, "total_steps": 128, "log_interval": 64, "eval_interval": 64, "eval_episodes": 4}
    values = about["training"] | sizes | {"env.episode_length": 8}
    if values["algo"] != "reinforce":
        values["num_steps"] = 4
    if values["network"] == "mlp":
        values["network.widths"] = "[3]"
    if values["algo"] in ("td", "ppo"):
        values["algo.num_shards"] = about["shards"]
    return [
        "env=" + json.dumps(about["name"], ensure_ascii=False),
        *(f"{name}={value}" for name, value in values.items()),
    ]


def ended(main, arguments):
    """The exit status of a command."""
    before, sys.argv = sys.argv, ["jaxpg", *arguments]
    try:
        run_command(main)
    except SystemExit as ending:
        return ending.code
    finally:
        sys.argv = before


def check(about, folder, said):
    """Trains, and looks at what is left; `said()` is what went to standard output and error since the last call."""
    registry = dict(envs.REGISTRY)
    envs.register(about["name"], envs.Entry(Config, lambda config: Environment(about)))
    try:
        status, (output, error) = ended(train.main, [*arguments(about), f"run_dir={folder}"]), said()
        assert "Traceback" not in output + error, output + error
        if status == 2:
            check_refused(error, folder)
        elif status == 4:
            assert "error: " in output, output
            assert about["diverges"] or about["training"]["algo"] == "online", output  # whose steps nothing shortens
        else:
            assert (status, error) == (0, ""), output + error
            check_finished(folder, output, said)
    finally:
        envs.REGISTRY.clear()
        envs.REGISTRY.update(registry)
    return status


def check_refused(error, folder):
    lines = error.splitlines()
    assert lines
    assert all(line.startswith("error: ") for line in lines), error
    assert not (folder / "metrics.jsonl").exists()  # what shows only in numbers is seen when the run has its folder


def check_finished(folder, output, said):
    assert "no report" not in output, output
    assert (folder / "report.html").stat().st_size > 1000
    stored = policies.load(str(folder))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(stored.policy))
    status, (output, error) = ended(export.main, [f"run={folder}", "format=c"]), said()
    assert (status, error) == (0, ""), output + error
    assert list((folder / "export").glob("*.h"))


@pytest.fixture(autouse=True)
def quick_to_compile(monkeypatch, tmp_path):
    monkeypatch.setattr(program, "OPTIMIZED", program.RUN_ONCE)
    monkeypatch.setattr(cache_folder, "locate", lambda: tmp_path / "cache" / "jaxpg")


@rounds(FEW, MANY)
def test_random_environments(number, capfd, tmp_path):
    counts, folders = {0: 0, 2: 0, 4: 0}, (tmp_path / f"run-{i}" for i in itertools.count())

    @examples(number, 20 if number else 6)
    @given(descriptions())
    def attempt(about):
        note(f"python tests/faults/test_environments.py {shlex.quote(json.dumps(about))}")
        with jax.debug_key_reuse(False):
            counts[check(about, next(folders), lambda: tuple(capfd.readouterr()))] += 1

    attempt()
    assert counts[0]
    assert counts[2]


def again(about):
    """Tries one description, in a folder that is gone afterwards; prints what is said."""
    with contextlib.chdir(tempfile.mkdtemp()):
        os.environ["XDG_CACHE_HOME"] = str(Path.cwd() / "cache")
        print("status", check(about, Path("run"), lambda: ("", "")))


if __name__ == "__main__":
    again(json.loads(sys.argv[1]))
