"""experiments/gymnasium_tasks.py against Gymnasium's own environments, step by step in double precision."""

import json
import sys
import types

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytestmark = pytest.mark.filterwarnings("ignore:.*(settotalmass|out of date)")
NAMES = ("HalfCheetah-v4", "Hopper-v4", "Walker2d-v4", "Ant-v4", "Reacher-v4")
BY_EQUATIONS = ["Reacher-v4", *(pytest.param(name, marks=pytest.mark.study) for name in NAMES[:-1])]


@pytest.fixture
def tasks(monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio", types.ModuleType("imageio"))  # which Gymnasium needs for videos only
    import gymnasium_tasks

    yield gymnasium_tasks
    sys.modules.pop("gymnasium_tasks")


def play(task, name, steps):
    """Largest differences of observations and of rewards in so many steps, and how many steps ended an episode."""
    env = gymnasium.make(name).unwrapped
    obs, _ = env.reset(seed=3)
    places = np.array([env.data.body(body).xpos for body in task.bodies])
    state, step = task.begin(*map(jnp.asarray, (env.data.qpos, env.data.qvel)), places), jax.jit(task.step)
    np.testing.assert_allclose(state.obs, obs, atol=1e-15)
    differences, ends = [], 0
    for action in np.random.default_rng(0).uniform(-1, 1, (steps, task.action_size)):
        state = step(state, action)
        obs, reward, terminated, *_ = env.step(action)
        assert bool(state.done) == terminated
        differences.append([np.abs(state.obs - obs).max(), abs(state.reward - reward)])
        ends += terminated
    return *np.max(differences, 0), ends


@pytest.mark.parametrize("name", NAMES)
def test_observations_rewards_and_ends_are_gymnasiums(tasks, name):
    """Both stepped by C MuJoCo. The hopper and the walker fall."""
    with jax.enable_x64(True):
        observed, rewarded, ends = play(tasks.TASKS[name]("mujoco"), name, 150)
    assert observed < 1e-12
    assert rewarded < 1e-12
    assert (ends > 0) == (name in ("Hopper-v4", "Walker2d-v4"))


@pytest.mark.parametrize("name", BY_EQUATIONS)
def test_rollouts_of_the_equations_are_gymnasiums(tasks, name):
    """To rounding, which contacts amplify: Gymnasium's solver ends near the solution with the files' own settings."""
    with jax.enable_x64(True):
        observed, rewarded, _ = play(tasks.TASKS[name](), name, 50)
    assert observed < 1e-6
    assert rewarded < 1e-6


@pytest.mark.parametrize("name", NAMES)
def test_initial_states_are_distributed_as_gymnasiums(tasks, name):
    """Means, deviations and bounds of 1,024 draws of each number, within four standard errors."""
    number = 1024
    task, env = tasks.TASKS[name]("mujoco"), gymnasium.make(name).unwrapped
    ours = np.asarray(jax.vmap(task.reset)(jax.random.split(jax.random.key(0), number)).obs)
    theirs = np.array([env.reset(seed=seed)[0] for seed in range(number)])
    error = theirs.std(0) * (2 / number) ** 0.5
    assert np.all(np.abs(ours.mean(0) - theirs.mean(0)) <= 4 * error + 1e-6)
    np.testing.assert_allclose(ours.std(0), theirs.std(0), rtol=0.1, atol=1e-6)
    assert np.all(np.abs(ours.max(0) - theirs.max(0)) <= np.maximum(theirs.std(0), 1e-6))


def test_the_places_of_bodies_after_a_reset_are_those_of_the_positions(tasks):
    for name in ("Ant-v4", "Reacher-v4"):
        task = tasks.TASKS[name]("mujoco")
        state = task.reset(jax.random.key(0)).pipeline_state
        env = gymnasium.make(name).unwrapped
        env.set_state(np.asarray(state.qpos, float), np.asarray(state.qvel, float))
        np.testing.assert_allclose(state.places, [env.data.body(body).xpos for body in task.bodies], atol=1e-6)


def test_a_table_is_made(tasks, monkeypatch, tmp_path, capsys):
    """With a stand-in for EnvPool that makes a million steps a second."""
    import commands

    stub = tmp_path / "stub.py"
    stub.write_text('import sys\nfor _ in sys.stdin:\n    print(\'{"1": 1e6, "2": 9e5}\', flush=True)\n')
    reacher = tasks.TASKS["Reacher-v4"]
    for owner, attribute, value in (
        (commands, "RESULTS", tmp_path),
        (tasks, "PEER", stub),
        (tasks, "SECONDS", 0.01),
        (tasks, "TASKS", {"Reacher-v4": lambda: reacher("mujoco")}),
    ):
        monkeypatch.setattr(owner, attribute, value)
    tasks.main(["--envpool", sys.executable, "--envs", "4", "--rounds", "1"])
    (row,) = json.loads((tmp_path / "gymnasium_tasks.json").read_text())
    assert row["EnvPool"] == [1e6] * 3
    assert row["ratio"][1] == pytest.approx(row["ours"][1] / 1e6)
    assert -3 < row["reward"] < 0
    assert len(capsys.readouterr().out.splitlines()) == 2
