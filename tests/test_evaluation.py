"""Evaluations: complete episodes as a plain loop plays them, and what those count that diverge."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from exploding import Blind, ExplodingConfig, Falls, Servo
from hypothesis import given
from hypothesis import strategies as st

from jaxpg.commands.evaluate import _format_results
from jaxpg.evaluation import evaluate, play
from jaxpg.program.state import Best, choose_better
from jaxpg.store.statistics import penalize_diverged
from jaxpg.watch import closing
from jaxpg.watch.episodes import Results

BOUND = 1e10
LENGTH = 30


def policy(obs):
    return 0.1 - 0.2 * obs


def loop(env, key):
    """One episode, step by step: (return, length, last finite metrics, diverged)."""
    state = env.reset(key)
    total, metrics = 0.0, {name: float(x) for name, x in state.metrics.items()}
    for t in range(LENGTH):
        state = env.step(state, policy(state.obs))
        numbers = [*np.ravel(state.obs), float(state.reward), *map(float, state.pipeline_state)]
        if not all(abs(x) <= BOUND for x in numbers):
            return total, t + 1, metrics, True
        total += float(state.reward)
        metrics = {name: float(x) if np.isfinite(x) else metrics[name] for name, x in state.metrics.items()}
        if state.done:
            return total, t + 1, metrics, False
    return total, LENGTH, metrics, False


@pytest.mark.parametrize("kind", [Servo, Blind, Falls])
def test_episodes_are_those_of_a_loop(kind):
    """Also where what comes after an end is NaN, and where an episode diverges."""
    env, keys = kind(ExplodingConfig(share=0.5)), jax.random.split(jax.random.key(0), 8)
    episodes, steps = jax.jit(lambda: play(env, policy, keys, LENGTH, lambda step: (step.after.obs, step.reward)))()
    expected = [loop(env, key) for key in keys]
    np.testing.assert_allclose(episodes.episode_return, [one[0] for one in expected], rtol=1e-3)
    np.testing.assert_array_equal(episodes.length, [one[1] for one in expected])
    np.testing.assert_array_equal(episodes.diverged, [one[3] for one in expected])
    for name, values in episodes.metrics.items():
        np.testing.assert_array_equal(values, [one[2][name] for one in expected])
    assert all(np.isfinite(x).all() for x in steps)
    np.testing.assert_allclose(np.asarray(steps[1]).sum(axis=0), episodes.episode_return, rtol=1e-4)
    assert kind is Falls or 0 < episodes.diverged.sum() < 8


def test_what_comes_after_an_end_is_not_multiplied_by_zero():
    episodes = evaluate(Falls(), policy, jax.random.split(jax.random.key(0), 4), LENGTH)
    assert np.isfinite(episodes.episode_return).all()
    np.testing.assert_array_equal(episodes.length, 3)
    np.testing.assert_array_equal(episodes.metrics["success"], 1.0)
    assert not episodes.diverged.any()


returns = st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=8)


@given(returns, st.data())
def test_a_diverged_episode_never_looks_good(values, data):
    """It counts no more than any sound one and no more than 0, whatever it earned; the sound ones stay as they are."""
    mask = np.array(data.draw(st.lists(st.booleans(), min_size=len(values), max_size=len(values))))
    counted = penalize_diverged(np.array(values), mask)
    np.testing.assert_array_equal(counted[~mask], np.array(values)[~mask])
    if mask.all():
        assert np.isnan(counted).all()
    else:
        assert (counted[mask] <= min(0.0, counted[~mask].min())).all()
        spoiled = penalize_diverged(np.where(mask, np.nan, values), mask)
        np.testing.assert_array_equal(spoiled, counted)


def test_rows_are_counted_apart():
    found = penalize_diverged(np.array([[1.0, 2.0], [-1.0, 5.0]]), np.array([[True, True], [False, True]]))
    np.testing.assert_array_equal(found, [[np.nan, np.nan], [-1.0, -1.0]])


def test_a_return_that_is_no_number_is_never_the_best():
    old = Best({"w": jnp.zeros((2, 3))}, jnp.array([-jnp.inf, -5.0]))
    kept = choose_better(old, Best({"w": jnp.ones((2, 3))}, np.array([np.nan, np.nan], np.float32)))
    jax.tree.map(np.testing.assert_array_equal, kept, old)


# --- commands ---------------------------------------------------------------------------------------------------------

PROGRAM = Path(__file__).parent / "exploding.py"
TINY = ("network=linear", "report=false")


@pytest.fixture(scope="module")
def program(command_environment):
    """`program("train", ...)`: the command, of a program that has these environments."""
    environment = command_environment | {"PYTHONPATH": os.environ.get("PYTHONPATH", str(PROGRAM.parents[1]))}

    def run(*arguments):
        command = [sys.executable, str(PROGRAM), *arguments]
        return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600, check=False)

    return run


def lines_of(folder):
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def evaluated(program, folder):
    """What `evaluate` prints, and its line of JSON, which has to be JSON."""

    def refuse(word):
        raise AssertionError(word)

    result = program("evaluate", f"run={folder}", "episodes=16", "json=true")
    assert result.returncode == 0, result.stderr
    return result.stdout, json.loads(result.stdout.splitlines()[-1], parse_constant=refuse)


def test_a_run_whose_rewards_are_nan_after_the_end_has_a_best_policy(program, tmp_path):
    folder = tmp_path / "falls"
    result = program("train", "env=falls", *TINY, f"run_dir={folder}")
    assert result.returncode == 0, result.stdout + result.stderr
    lines = [line for line in lines_of(folder) if "eval_return" in line]
    assert all(np.isfinite(line["eval_return"]) for line in lines)
    assert all(line["eval_diverged"] == 0 and line["eval_success"] == 1 for line in lines)
    assert "untrained" not in result.stdout
    printed, numbers = evaluated(program, folder)
    assert "best policy (saved after" in printed
    assert np.isfinite(numbers["mean"])
    assert numbers["diverged"] == 0


def test_a_few_diverged_episodes_are_counted_and_no_more(program, tmp_path):
    folder = tmp_path / "servo"
    result = program("train", "env=exploding-servo", "env.share=0.3", *TINY, f"run_dir={folder}")
    assert result.returncode == 0, result.stdout + result.stderr
    lines = lines_of(folder)
    evaluations = [line for line in lines if "eval_return" in line]
    assert sum(line["diverged"] for line in lines) > 0
    assert all(0 < line["eval_diverged"] < 8 and -1e3 < line["eval_return"] < 0 for line in evaluations)
    assert "note: update" in result.stdout
    assert "diverged" in result.stdout
    printed, numbers = evaluated(program, folder)
    assert 0 < numbers["diverged"] < 16
    assert f"{numbers['diverged']} of 16 episodes" in printed
    assert np.isfinite([numbers["mean"], numbers["stderr"]]).all()


def test_an_observation_out_of_bounds_ends_in_one_line(program, tmp_path):
    """Of a sound environment: which observation, its size, and what would be right; nothing is trained."""
    result = program("train", "env=exploding-servo", "env.unit=1e20", *TINY, f"run_dir={tmp_path / 'run'}")
    assert result.returncode == 2, result.stdout + result.stderr
    said = result.stdout + result.stderr
    assert "observation 0 (observation_0) is " in said
    assert "e+19 after a reset" in said or "e+20 after a reset" in said
    assert "choose units in which it is smaller" in said
    assert "Traceback" not in said
    assert not (tmp_path / "run" / "metrics.jsonl").exists()


def test_what_is_no_number_is_said_in_words():
    nothing, mixed = np.full(2, np.nan), np.array([np.nan, 0.5])
    metrics = {"success": nothing, "distance": nothing, "height": mixed}
    rows = _format_results(Results(np.array([1.0, 2.0]), np.zeros(2, bool), metrics))
    assert (rows["success"], rows["distance"]) == ("n/a", "n/a")
    assert rows["height"].startswith("0.5 ")


def test_of_several_agents_it_is_said_how_many_have_the_untrained_policy():
    lines = [{"eval_return": [None, 1.0, 2.0], "eval_diverged": [8, 0, 1]}]
    rows = closing._summarize_evaluations(lines)
    assert rows["best policy"].startswith("the untrained one of 1 of the 3 agents: ")
    assert rows["diverged"] == "9 episodes of the last evaluation"
    assert "best policy" not in closing._summarize_evaluations([{"eval_return": [1.0, 2.0]}])


def test_a_run_all_of_whose_episodes_diverge_calls_no_policy_best(program, tmp_path):
    folder = tmp_path / "all"
    result = program("train", "env=exploding-servo", "env.share=1", "stop_return=-1e9", *TINY, f"run_dir={folder}")
    assert result.returncode == 0, result.stdout + result.stderr
    assert "the untrained one" in result.stdout
    assert all(line["eval_return"] is None for line in lines_of(folder) if "eval_return" in line)
    printed, numbers = evaluated(program, folder)
    assert "best policy" not in printed
    assert "untrained policy (no evaluation gave a return" in printed
    assert numbers["mean"] is None
    assert numbers["diverged"] == 16
