"""Physics that diverges: when that is, and that nothing is learned from it."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from exploding import Blind, ExplodingConfig, Servo
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.base import State
from jaxpg.actor_critic import actor_critic
from jaxpg.baselines import leave_one_out, of_returns
from jaxpg.divergence import BOUND, find_sound_steps, has_diverged
from jaxpg.estimators import gae
from jaxpg.features import polynomial
from jaxpg.methods import reinforce, td
from jaxpg.networks import linear_networks, mlp_networks
from jaxpg.online import online_actor_critic
from jaxpg.ppo import ppo
from jaxpg.rollout import rollout
from jaxpg.training import initial_state, train_scan
from jaxpg.vector_env import episode_metrics, vectorize

# --- when -------------------------------------------------------------------------------------------------------------


class Physics(NamedTuple):
    qpos: jax.Array
    qvel: jax.Array
    stiffness: jax.Array
    steps: jax.Array
    key: jax.Array


class Other(NamedTuple):
    position: jax.Array
    limit: jax.Array
    steps: jax.Array


def state(physics=None, **fields):
    zero = jnp.zeros(())
    return State(physics, **{"obs": jnp.zeros(2), "reward": zero, "done": zero} | fields)


def of_physics(**fields):
    calm = {
        "qpos": jnp.zeros(3),
        "qvel": jnp.zeros(2),
        "stiffness": jnp.inf,
        "steps": 2**31 - 1,
        "key": jax.random.key(0),
    }
    return Physics(**{name: x if name == "key" else jnp.asarray(x) for name, x in (calm | fields).items()})


def of_other(**fields):
    return Other(
        **{k: jnp.asarray(x) for k, x in ({"position": 0.0, "limit": np.inf, "steps": 2**31 - 1} | fields).items()}
    )


AT_REST = state(of_physics())
OUTSIDE = [1.1e10, -1.1e10, 1e38, np.inf, -np.inf, np.nan]


@pytest.mark.parametrize("value", OUTSIDE)
def test_numbers_beyond_the_bound_diverge(value):
    row = jnp.array([0.0, value])
    assert has_diverged(AT_REST, AT_REST.replace(obs=row))
    assert has_diverged(AT_REST, AT_REST.replace(reward=row[1]))
    assert has_diverged(AT_REST, AT_REST.replace(pipeline_state=of_physics(qvel=row)))
    assert has_diverged(AT_REST, AT_REST.replace(pipeline_state=of_physics(qpos=jnp.array([0.0, 0.0, value]))))
    assert has_diverged(state(of_other()), state(of_other(position=value)))
    assert has_diverged(AT_REST.replace(obs=row), AT_REST), "it was so after the reset"


@pytest.mark.parametrize("value", [0.0, -BOUND, BOUND, 1e-38])
def test_numbers_within_the_bound_do_not(value):
    row = jnp.array([0.0, value])
    assert not has_diverged(AT_REST, AT_REST.replace(obs=row, reward=row[1], pipeline_state=of_physics(qvel=row)))


@pytest.mark.parametrize("value", OUTSIDE)
def test_constants_counters_keys_and_metrics_do_not_count(value):
    """What a model holds beside positions and velocities, what was so before the step, and what is only looked at."""
    assert not has_diverged(AT_REST, AT_REST.replace(pipeline_state=of_physics(stiffness=value)))
    assert not has_diverged(state(of_other(limit=value)), state(of_other(limit=value)))
    assert not has_diverged(AT_REST, AT_REST.replace(metrics={"success": jnp.array(value)}))


@pytest.mark.parametrize("value", [np.inf, np.nan])
def test_an_end_that_is_no_number_counts(value):
    assert has_diverged(AT_REST, AT_REST.replace(done=jnp.array(value)))


def test_half_precision_overflows_at_its_own_bound():
    assert has_diverged(AT_REST, AT_REST.replace(obs=2 * jnp.array([0.0, 60000.0], jnp.float16)))


def test_a_bounded_observation_hides_nothing():
    """The episode ends in the step in which the state is beyond the bound, though all that is returned is within 1."""
    env = vectorize(Blind(ExplodingConfig(share=1.0)), 3, 1000)
    _, steps = rollout(
        lambda obs, key: (jnp.zeros((3, 1)),) * 2, env.step, env.reset(jax.random.key(0)), jax.random.key(1), 12
    )
    first = np.argmax(steps.diverged, axis=0)
    assert steps.diverged.any(axis=0).all()
    assert ((first >= 8) & (first <= 11)).all()  # 11^9.. > 1e10
    np.testing.assert_array_equal(steps.terminated, steps.diverged)


# --- which steps ------------------------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.booleans()), min_size=8, max_size=8))
def test_lasting_is_the_loop(steps):
    bad, ended = map(np.array, zip(*steps, strict=True))
    expected = []
    for t in range(8):
        end = next((k for k in range(t, 8) if ended[k]), 7)
        expected.append(not bad[t : end + 1].any())
    np.testing.assert_array_equal(find_sound_steps(jnp.array(bad), jnp.array(ended)), expected)


# --- what is learned --------------------------------------------------------------------------------------------------


class Path(Servo):
    """One environment in four passes through size, 10^3 size and NaN; the reward is its size too."""

    def __init__(self, size, share=0.25):
        super().__init__(ExplodingConfig(share=share))
        self.size = size

    def reset(self, rng):
        after = super().reset(rng)
        return after.replace(pipeline_state=(*after.pipeline_state, jnp.zeros(())))

    def step(self, state, action):
        angle, unstable, time = state.pipeline_state
        time = time + 1
        explosion = jnp.where(time > 2, jnp.nan, self.size * 1000.0 ** (time - 1))
        angle = jnp.where(unstable > 0, explosion, angle - 0.2 * (angle - action[0]))
        new = angle, unstable, time
        return state.replace(pipeline_state=new, obs=angle[None], reward=self.reward(jnp.clip(angle, -1e4, 1e4)))


NETWORKS = {
    "mlp": mlp_networks(1, 1, (8,)),
    "polynomial": linear_networks(1, 1, features=partial(polynomial, order=5)),
}
STEPS = 9  # three explosions in a rollout, and the last is complete
SHARED = {"gamma": 0.9, "lambda_actor": 0.7, "lambda_critic": 0.4, "actor_lr": 1e-3, "critic_lr": 5e-3}


def algorithm(name, env, networks="mlp", num_envs=12, episode_length=STEPS, **options):
    networks, batch = NETWORKS[networks], vectorize(env, num_envs, episode_length)
    if name == "online":
        return online_actor_critic(batch, networks, num_steps=STEPS, **SHARED, **options)
    method = reinforce(0.9, of_returns(leave_one_out)) if name == "reinforce" else td(0.9, STEPS, gae(0.9))
    if name == "ppo":
        return ppo(batch, networks, optax.adam(1e-2), method, epochs=2, minibatches=2, **options)
    return actor_critic(batch, networks, optax.adam(1e-2), method, **options)


ALGORITHMS = ("td", "ppo", "reinforce", "online")


def started(made):
    """Fresh episodes, all at their beginning."""
    state = initial_state(made, jax.random.key(0))
    return state._replace(env_state=state.env_state._replace(time=0 * state.env_state.time))


@pytest.mark.parametrize("networks", NETWORKS)
@pytest.mark.parametrize("name", ALGORITHMS)
def test_nothing_is_learned_from_an_explosion(name, networks):
    """Its size changes no bit of what is learned: parameters, optimizer, statistics, returns, losses."""

    @jax.jit
    def learn(size):
        made = algorithm(name, Path(size), networks)
        return made.step(started(made), jax.random.key(1))

    results = []
    for size in (2e2, 9e5):
        state, metrics = learn(size)
        assert metrics["diverged"] > 0
        assert all(np.isfinite(x).all() for x in jax.tree.leaves((state.params, state.normalizer, metrics)))
        results.append((state.params, state.opt_state, state.normalizer, metrics))
    jax.tree.map(np.testing.assert_array_equal, *results)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_where_all_episodes_diverge_nothing_is_learned_at_all(name):
    """Parameters and optimizer stay to the bit, its momentum notwithstanding; statistics know no sample of it."""
    made = algorithm(name, Path(2e2, share=1.0))
    before = jax.jit(lambda: started(made))()
    after, metrics = jax.jit(made.step)(before, jax.random.key(1))
    jax.tree.map(np.testing.assert_array_equal, after.params, before.params)
    if name != "online":  # whose traces end with the episodes
        jax.tree.map(np.testing.assert_array_equal, after.opt_state, before.opt_state)
    jax.tree.map(np.testing.assert_array_equal, after.normalizer, before.normalizer)
    assert metrics["diverged"] == 12 * 3
    assert metrics["episodes"] == 0
    assert all(np.isfinite(x).all() for x in metrics.values())


@pytest.mark.parametrize(
    ("name", "networks", "normalize"),
    [
        ("td", "mlp", True),
        ("ppo", "mlp", False),
        ("ppo", "polynomial", True),
        pytest.param("ppo", "mlp", True, marks=pytest.mark.study),
        pytest.param("ppo", "polynomial", False, marks=pytest.mark.study),
        pytest.param("td", "mlp", False, marks=pytest.mark.study),
        pytest.param("td", "polynomial", True, marks=pytest.mark.study),
        pytest.param("td", "polynomial", False, marks=pytest.mark.study),
    ],
)
def test_an_explosion_that_the_rollout_cuts_is_not_learned_from_either(name, networks, normalize):
    """Of episodes that are within 10^3 to 10^9 at the rollout's end nobody knows yet that they will diverge."""
    env = Servo(ExplodingConfig(share=0.1))
    made = algorithm(name, env, networks, num_envs=64, episode_length=40, normalize_observations=normalize)
    state, metrics = jax.jit(lambda: train_scan(made, jax.random.key(0), 30))()
    leaves = jax.tree.leaves((state.params, state.normalizer, metrics))
    assert all(np.isfinite(x).all() for x in leaves)
    assert metrics["diverged"].sum() > 10
    assert networks == "polynomial" or np.abs(metrics["value_loss"]).max() < 1e6
    assert np.sqrt(state.normalizer.variance[0]) < 50


def test_returns_are_of_sound_episodes():
    """The mean return of a rollout is that of the episodes that did not diverge."""
    env = vectorize(Path(2e2), 12, STEPS)
    zero = jnp.zeros((12, 1))
    state = env.reset(jax.random.key(0))
    _, steps = rollout(lambda obs, key: (zero, zero), env.step, state, jax.random.key(1), STEPS)
    sound = np.asarray(state.env.pipeline_state[1]) == 0
    metrics = episode_metrics(steps)
    assert 0 < sound.sum() < 12
    ends = np.asarray(steps.truncated > 0)
    assert metrics["episodes"] == ends.sum()
    np.testing.assert_allclose(metrics["return_sum"], np.asarray(steps.reward)[:, sound].sum(), rtol=1e-5)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name == "td" else [pytest.mark.study]) for name in ALGORITHMS]
)
def test_learning_goes_on_beside_explosions(name):
    """With a tenth of the joints unstable the others end as near the best angle as without: their mean command."""
    updates = {"td": 150, "ppo": 60, "reinforce": 100, "online": 400}[name]

    @jax.jit
    def command(share):
        made = algorithm(name, Servo(ExplodingConfig(share=share)), num_envs=32, episode_length=30)
        state, _ = train_scan(made, jax.random.key(0), updates)
        mean, _ = NETWORKS["mlp"].policy(state.params["actor"], jnp.linspace(-1, 1, 5)[:, None])
        return jnp.tanh(mean).mean()

    commands = [float(command(share)) for share in (0.0, 0.1)]
    assert commands[0] > 0.2, "it learns"
    assert commands[1] > 0.2
    assert commands[1] == pytest.approx(commands[0], abs=0.25)
