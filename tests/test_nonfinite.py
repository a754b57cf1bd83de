"""Numbers that explode: the update that made them is not applied, and it is said what was seen first and where."""

import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from processes import LINES, RUN, outcome

from envs.base import State
from jaxpg.config.parsing import compose
from jaxpg.nonfinite import list_quantities, skip_nonfinite, stop_at_nonfinite
from jaxpg.program.algorithms import make_algorithm
from jaxpg.program.compile import NAN_POLICIES
from jaxpg.program.environment import make_env
from jaxpg.rollout import rollout
from jaxpg.run.chunks import NonFiniteMonitor, summarize
from jaxpg.training import train_scan
from jaxpg.types import Algorithm, TrainState
from jaxpg.vector_env import vectorize

BAD = 3  # the update in which something explodes
KEY = jax.random.key(0)
TOLERANCE = {"rtol": 1e-5, "atol": 1e-6}


class Envs:
    """Two environments that are their observations."""

    def __init__(self, obs):
        self.obs = obs


jax.tree_util.register_pytree_node(Envs, lambda envs: ((envs.obs,), None), lambda _, children: Envs(*children))


def exploding(what, value, at=BAD):
    """An algorithm that counts in all of its numbers, and whose `what` is `value` in one update."""

    def init(key):
        return TrainState(jnp.zeros(2), jnp.zeros(()), jnp.zeros(()), Envs(jnp.zeros((2, 3))), jnp.zeros((), jnp.int32))

    def step(state, key):
        update = state.update + 1
        bad = jnp.where(update == at, value, 0.0)
        add = {name: jnp.where(name == what, bad, 0.0) for name in ("parameter", "observation")}
        params, opt_state, normalizer = state.params + 1 + add["parameter"], state.opt_state + 1, state.normalizer + 1
        obs = (state.env_state.obs + 1).at[1, 2].add(add["observation"])
        metrics = {name: jnp.ones(()) + (bad if name == what else 0.0) for name in ("gradient_norm", "value_loss")}
        metrics |= {"episodes": jnp.zeros(()), "diverged": jnp.zeros(()), "diverged_env": -jnp.ones((), jnp.int32)}
        return TrainState(params, opt_state, normalizer, Envs(obs), update), metrics

    return Algorithm(init, step)


WHATS = ("observation", "value_loss", "gradient_norm", "parameter")


@pytest.mark.parametrize("value", [jnp.nan, jnp.inf, -jnp.inf])
@pytest.mark.parametrize("what", WHATS)
def test_stop_stands_still_before_the_update(what, value):
    """However many updates follow: the state, its number included, is that of two updates, to the bit."""
    algorithm = exploding(what, value)
    state, metrics = train_scan(stop_at_nonfinite(algorithm), KEY, 7)
    before, _ = train_scan(algorithm, KEY, BAD - 1)
    jax.tree.map(np.testing.assert_array_equal, state, before)
    assert state.update == BAD - 1
    place = 1 + list_quantities(metrics).index(what)
    assert metrics["nonfinite"].tolist() == [0] * (BAD - 1) + [place] * (8 - BAD)
    assert metrics["nonfinite_env"].tolist() == [-1] * (BAD - 1) + [1 if what == "observation" else -1] * (8 - BAD)


@pytest.mark.parametrize("what", WHATS)
def test_skip_learns_nothing_from_the_update_and_goes_on(what):
    state, metrics = train_scan(skip_nonfinite(exploding(what, jnp.nan)), KEY, 7)
    learned = 7 - 1
    for counted in (state.params, state.opt_state, state.normalizer):
        np.testing.assert_array_equal(counted, learned)
    np.testing.assert_array_equal(state.env_state.obs, learned if what == "observation" else 7)
    assert state.update == 7
    assert (metrics["nonfinite"] > 0).tolist() == [update == BAD for update in range(1, 8)]


@pytest.mark.parametrize("what", WHATS)
def test_what_exploded_is_named_as_it_is(what):
    """The place that the program counts is found again among the metrics' names."""
    state, metrics = train_scan(stop_at_nonfinite(exploding(what, jnp.nan)), KEY, 5)
    monitor = NonFiniteMonitor(compose([]), print)
    monitor.observe(state._replace(update=np.zeros(1, int)), {name: np.asarray(x)[None] for name, x in metrics.items()})
    where = " of environment 1" if what == "observation" else ""
    assert monitor.problem == f"update {BAD}: {what}{where} is not finite"
    assert monitor.is_stuck, "it would make the same update again"


@pytest.mark.parametrize(
    ("algo", "policy"),
    [
        ("td", "stop"),
        ("td", "skip"),
        *(pytest.param(algo, "stop", marks=pytest.mark.study) for algo in ("ppo", "online", "reinforce")),
    ],
)
def test_what_is_sound_is_left_alone(policy, algo):
    """To rounding: they are two programs, and XLA may fuse them in different ways."""
    config = compose(["env=quadratic", f"algo={algo}", "num_envs=4", "env.episode_length=5"])
    algorithm = make_algorithm(config, make_env(config))
    (plain, _), (watched, metrics) = (
        jax.jit(lambda algorithm=algorithm: train_scan(algorithm, KEY, 5))()
        for algorithm in (algorithm, NAN_POLICIES[policy](algorithm))
    )
    jax.tree.map(lambda x, y: np.testing.assert_allclose(y, x, **TOLERANCE), _numbers(plain), _numbers(watched))
    assert not metrics["nonfinite"].any()


def _numbers(tree):
    return jax.tree.map(lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x, tree)


# --- environments -----------------------------------------------------------------------------------------------------


class Fragile:
    """Walks right from a number in [0, 1); what it observes or earns beyond `edge` is `value`."""

    observation_size = action_size = 1

    def __init__(self, field, value, edge=4.0):
        self.field, self.value, self.edge = field, value, edge

    def reset(self, rng):
        x, zero = jax.random.uniform(rng), jnp.zeros(())
        return State(x, x[None], zero, zero)

    def step(self, state, action):
        x = state.pipeline_state + 1.0
        broken = jnp.where(x > self.edge, self.value, 0.0)
        obs, reward = x[None], x
        if self.field == "obs":
            obs = obs + broken
        else:
            reward = reward + broken
        return state.replace(pipeline_state=x, obs=obs, reward=reward)


@pytest.mark.parametrize("value", [jnp.nan, jnp.inf])
@pytest.mark.parametrize("field", ["obs", "reward"])
def test_an_environment_that_diverges_is_reset_and_no_other(field, value):
    env = vectorize(Fragile(field, value), num_envs=3, episode_length=50)
    state = env.reset(jax.random.key(1))
    begun = np.add(state.env.pipeline_state, [0.0, 2.0, 0.0])  # the second breaks two steps earlier
    state = state._replace(env=state.env.replace(pipeline_state=jnp.asarray(begun), obs=jnp.asarray(begun)[:, None]))

    def act(obs, key):
        return jnp.zeros((3, 1)), jnp.zeros((3, 1))

    state, steps = rollout(act, env.step, state, jax.random.key(2), length=3)
    first = 1  # 0.x + 2 + 2 > 4 in the second step
    expected = np.zeros((3, 3))
    expected[first, 1] = 1
    np.testing.assert_array_equal(steps.diverged, expected)
    np.testing.assert_array_equal(steps.terminated, expected)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((steps, state.env.obs)))
    np.testing.assert_allclose(steps.next_obs[first, 1], steps.obs[first, 1])
    assert steps.reward[first, 1] == 0
    np.testing.assert_allclose(steps.episode_return[first, 1], steps.reward[0, 1])
    assert 0 <= steps.obs[first + 1, 1, 0] < 1, "a fresh episode"
    np.testing.assert_allclose(steps.obs[:, [0, 2], 0] - steps.obs[0, [0, 2], 0], [[0, 0], [1, 1], [2, 2]], rtol=1e-6)


def test_a_reset_that_is_not_finite_is_an_observation():
    class Born(Fragile):
        def reset(self, rng):
            state = super().reset(rng)
            return state.replace(obs=state.obs + jnp.nan)

    config = compose(["env=quadratic", "algo=td", "network=linear", "num_envs=4", "num_steps=2"])
    from jaxpg.program import algorithms

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(algorithms, "vectorize", lambda env, *sizes: vectorize(Born("obs", 0.0), *sizes))
        algorithm = make_algorithm(config, Born("obs", 0.0))
        _, metrics = train_scan(stop_at_nonfinite(algorithm), KEY, 1)
    assert list_quantities(metrics)[metrics["nonfinite"][0] - 1] == "observation"
    assert metrics["nonfinite_env"][0] == 0


# --- lines and notes --------------------------------------------------------------------------------------------------

METRICS = {
    "value_loss": [[1.0, np.nan, 3.0], [np.nan] * 3],
    "return_sum": [[2.0, np.nan, 4.0], [np.nan] * 3],
    "episodes": [[1.0, 1.0, 1.0], [0.0] * 3],
    "diverged": [[0.0, 0.0, 2.0], [0.0] * 3],
    "diverged_env": [[-1, -1, 5], [-1] * 3],
    "nonfinite": [[0, 3, 0], [2, 2, 2]],
    "nonfinite_env": [[-1, -1, -1], [-1] * 3],
}


def test_a_line_has_the_means_of_the_sound_updates():
    line = summarize({name: jnp.asarray(value) for name, value in METRICS.items()})
    assert line == {
        "return": [3.0, None],
        "episodes": [2.0, 0.0],
        "value_loss": [2.0, None],
        "skipped": [1.0, 3.0],
        "diverged": [2.0, 0.0],
    }
    json.dumps(line, allow_nan=False)


def test_each_agent_is_named_once():
    config = compose(["num_seeds=2", "seed=7", "nan_policy=skip"])
    said = []
    monitor = NonFiniteMonitor(config, said.append)
    state = TrainState(None, None, None, None, np.array([10, 10]))
    metrics = {name: np.asarray(value) for name, value in METRICS.items()}
    for _ in range(2):
        monitor.observe(state, metrics)
    names = list_quantities(METRICS)
    assert said == [
        f"note: update 12: {names[2]} is not finite, seed 7; such updates are skipped",
        f"note: update 11: {names[1]} is not finite, seed 8; such updates are skipped",
        "note: update 13: the physics of environment 5, seed 7 diverged: a number is not finite or beyond 1e+10; its "
        "episode ends there and is not learned from; metrics.jsonl counts these as diverged",
    ]
    assert monitor.problem == f"update 12: {names[2]} is not finite, seed 7"
    assert not monitor.is_stuck


# --- commands ---------------------------------------------------------------------------------------------------------

# Steps of such a size overflow after a while.
EXPLODES = ("algo=td", "algo.critic_lr=1e17", "algo.final_lr=1")


@pytest.fixture(scope="module")
def exploded(command, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "exploded"
    return folder, command("train", *RUN, *EXPLODES, f"run_dir={folder}")


def test_a_run_that_explodes_stops_with_status_4(exploded):
    folder, result = exploded
    assert result.returncode == 4, result.stderr
    assert re.search(r"error: update \d+: value_loss is not finite; stopped at \d+ steps; resume=", result.stdout)
    assert "Traceback" not in result.stdout + result.stderr
    lines, _, _ = outcome(folder)
    assert all(value is not None for line in lines for name, value in line.items() if name not in ("seconds", "return"))
    assert not any(line["skipped"] for line in lines)


def test_with_skip_it_goes_on_from_there(exploded, command):
    folder, _ = exploded
    before, update, _ = outcome(folder)
    again = command("train", f"resume={folder}")
    assert again.returncode == 4, "the same update again"
    assert outcome(folder)[:2] == (before, update)
    result = command("train", f"resume={folder}", "nan_policy=skip")
    assert "such updates are skipped" in result.stdout
    assert result.returncode == 0, "some of the updates after it are finite"
    lines, number, _ = outcome(folder)
    assert number == 2 * LINES
    assert sum(line["skipped"] for line in lines) > 0
