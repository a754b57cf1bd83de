"""Names of an environment's own numbers: kept as they are where that is possible, and never taken for ours."""

import json
import re
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import envs
from envs.base import Interface, initial_state
from envs.options import option
from jaxpg import evaluate, train
from jaxpg.store import policies
from jaxpg.store.names import RESERVED, number_duplicates, rename_interface, rename_metrics
from jaxpg.watch.clips import make_clip
from jaxpg.watch.recording import record

NAMES = st.lists(st.one_of(st.sampled_from(sorted(RESERVED)), st.text(max_size=150), st.just("env_return")), max_size=8)


@given(st.lists(st.sampled_from(["a", "a (2)", "a (2) (2)", "b", ""]), max_size=8))
def test_numbered_names_are_distinct_and_stay_where_they_were_before(names):
    found = number_duplicates(names, taken=["b"])
    assert len({*found, "b"}) == len(names) + 1
    for i, (name, new) in enumerate(zip(names, found, strict=True), start=1):
        assert new in (name, f"{name} ({i})")
    if len({*names, "b"}) == len(names) + 1:
        assert found == names
    assert number_duplicates(found, taken=["b"]) == found


@given(NAMES)
def test_metrics_keep_their_values_under_names_that_are_nobody_elses(names):
    metrics = {name: i for i, name in enumerate(names)}
    found = rename_metrics(metrics)
    assert list(found.values()) == list(metrics.values())
    assert not RESERVED & set(found)
    json.dumps(found).encode("ascii")
    for name in found:
        name.encode()
        assert re.fullmatch(r"[/\w.\- ]+", name), "what MLflow takes"
        assert all(part.strip(" .") for part in name.split("/"))
        assert len(name) < 120


@pytest.mark.parametrize("name", ["success", "distance", "reward/alive", "Höhe", "x.y-z", "swing up"])
def test_usual_names_stay(name):
    assert list(rename_metrics({name: 1})) == [name]


def test_names_of_an_interface_are_told_apart():
    found = rename_interface(Interface(("x", "x", ""), ("torque [N m]", "torque [N m]", "value"), (1.0, 2.0, 3.0)))
    assert found.observations == ("x (1)", "x (2)", "observation_2")
    assert found.commands == ("torque [N m] (1)", "torque [N m] (2)", "value (3)")
    assert found.limits == (1.0, 2.0, 3.0)


# --- a run ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Options:
    episode_length: int = option(4, "steps", at_least=1)


OWN = ("return", "length", "diverged", "env_return", "success", "a b?", "a b!")


class Misleading:
    """Reward 1 - |action|; metrics with our names say -1000, and commands are called like each other."""

    observation_size, action_size, dt = 1, 3, 0.1
    interface = Interface(("x",), ("torque", "torque", "reward"), (1.0, 2.0, 4.0))

    def __init__(self, config):
        self.config = config

    def reset(self, key):
        return initial_state(jnp.zeros(()), jnp.ones(1), OWN)

    def step(self, state, action):
        return state.replace(reward=1 - jnp.abs(action).sum(), metrics={name: jnp.float32(-1000) for name in OWN})


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(envs.REGISTRY, "misleading", envs.Entry(Options, Misleading, {"td": {}}))
        sizes = ("num_envs=2", "num_steps=2", "total_steps=8", "log_interval=4", "eval_interval=4", "eval_episodes=2")
        arguments = ("env=misleading", "network=linear", *sizes, "stop_return=-999", "report=false")
        assert train.main([*arguments, f"run_dir={folder}"]) == 0
        yield folder


def test_a_metric_called_return_is_not_the_return(run):
    """Nor what the run stops at, nor what is best."""
    (line,) = [json.loads(text) for text in (run / "metrics.jsonl").read_text().splitlines()]
    assert line["eval_return"] > 3, "and stop_return is reached at the first evaluation"
    own = {name for name, value in line.items() if value == -1000}
    assert own == {
        *("eval_env_return", "eval_env_length", "eval_env_diverged", "eval_env_env_return", "eval_success"),
        *("eval_a b_", "eval_a b__2"),
    }


def test_the_evaluation_shows_both(run, capsys):
    assert evaluate.main([f"run={run}", "episodes=2", "json=true"]) == 0
    text = capsys.readouterr().out
    assert re.search(r"^return   [34]\.\d", text, re.M)
    assert re.search(r"^env_return -1000 on average", text, re.M)
    assert json.loads(text.splitlines()[-1])["mean"] > 3


def test_commands_with_one_name_are_a_series_each(run):
    stored = policies.load(str(run))
    (recording,) = record(stored, [stored.policy], jax.random.split(jax.random.key(0), 2))
    series = make_clip(stored, recording, 0).series
    assert list(series) == ["torque (1)", "torque (2)", "reward (3)", "reward", "value"]
    for i, name in enumerate(["torque (1)", "torque (2)", "reward (3)"]):
        np.testing.assert_array_equal(series[name], recording.command[:4, 0, i])
    np.testing.assert_array_equal(series["reward"], recording.reward[:4, 0])
