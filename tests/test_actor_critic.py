"""The whole algorithm: probes with known answers, and equalities of programs."""

import operator

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from probes import Constant, Counter, Target

from envs.base import State
from jaxpg import normalization
from jaxpg.actor_critic import actor_critic
from jaxpg.baselines import critic, zero
from jaxpg.batch import make_batch_fn
from jaxpg.estimators import gae, td_lambda
from jaxpg.evaluation import evaluate
from jaxpg.methods import Method, reinforce, td
from jaxpg.networks import mlp_networks
from jaxpg.policy import deterministic_policy, sampling_policy
from jaxpg.ppo import ppo
from jaxpg.program.algorithms import BASELINES
from jaxpg.training import initial_state, train_scan
from jaxpg.vector_env import vectorize


def new_key(seed=0):
    """Keys may be used once (jax_debug_key_reuse): every use makes its own."""
    return jax.random.key(seed)


def make(
    env, method, num_envs=8, episode_length=10, learning_rate=3e-3, widths=(8,), algorithm=actor_critic, **options
):
    networks = mlp_networks(env.observation_size, env.action_size, widths)
    optimizer = optax.adam(learning_rate)
    return networks, algorithm(vectorize(env, num_envs, episode_length), networks, optimizer, method, **options)


def learned_value(method, gamma=0.9):
    """The critic's value of the one state of `Constant`, whose time limit is 10 steps."""
    networks, algorithm = make(Constant(), method, learning_rate=1e-2, normalize_observations=False)
    state, _ = jax.jit(lambda key: train_scan(algorithm, key, 3000))(new_key())
    return float(networks.value(state.params["critic"], jnp.ones(1)))


def td_truncation_as_termination(gamma, lambda_, num_steps):
    """The usual mistake: a time limit taken for a terminal state."""
    right = td(gamma, num_steps, gae(lambda_))

    def estimate(transition, weight, value, next_value, squared_score):
        wrong = transition._replace(terminated=transition.terminated + transition.truncated)
        return right.estimate(wrong, weight, value, next_value, squared_score)

    return right._replace(estimate=estimate)


def td_through_the_reset(gamma, lambda_, num_steps):
    """Another: the lambda-sum runs on into the next episode."""

    def estimate(transition, weight, value, next_value, squared_score):
        discount = gamma * (1 - transition.terminated)
        return td_lambda(transition.reward, discount, value, next_value, lambda_)

    return td(gamma, num_steps, gae(lambda_))._replace(estimate=estimate)


@pytest.mark.parametrize("lambda_", [0.0, 0.95])
def test_value_of_an_endless_task_with_a_time_limit(lambda_):
    """V = 1 / (1 - gamma) = 10, to 2 %."""
    assert learned_value(td(0.9, 5, gae(lambda_))) == pytest.approx(10, rel=0.02)


def test_value_is_wrong_if_truncation_is_taken_for_termination():
    assert abs(learned_value(td_truncation_as_termination(0.9, 0.95, num_steps=5)) - 10) > 1


def counter_advantages(method):
    """Advantages of the first update on `Counter`, by the state it happened in."""
    env = Counter(life=7)
    networks, _ = make(env, method)
    params = networks.init(new_key())
    vector = vectorize(env, 8, 5)
    statistics = normalization.init(2)
    policy_fn = sampling_policy(networks, params, statistics)
    _, steps = method.collect(vector, policy_fn, vector.reset(new_key()), jax.random.key(1))
    value, next_value = (networks.value(params["critic"], obs) for obs in (steps.obs, steps.next_obs))
    return (
        steps,
        value,
        next_value,
        method.estimate(steps, method.weight(steps), value, next_value, jnp.ones_like(value)),
    )


def test_lambda_sum_stops_at_the_time_limit():
    """At the last step of an episode the advantage is the TD error, whatever happens in the next episode."""
    steps, value, next_value, estimate = counter_advantages(td(0.9, 9, gae(0.95)))
    expected = steps.reward + 0.9 * next_value - value
    np.testing.assert_allclose(estimate.advantage[4], expected[4], rtol=1e-5, atol=1e-6)
    *_, wrong = counter_advantages(td_through_the_reset(0.9, 0.95, num_steps=9))
    assert np.abs(wrong.advantage[4] - expected[4]).min() > 0.1


def test_reinforce_returns_are_those_of_whole_episodes():
    """Reward 1 and death after 3 steps: G = 3, 2, 1, and what follows the end has weight 0."""
    env = Counter(life=3)
    networks, _ = make(env, reinforce(1.0, zero))
    vector = vectorize(env, 4, 5)
    policy_fn = sampling_policy(networks, networks.init(new_key()), normalization.init(2))
    method = reinforce(1.0, zero)
    _, steps = method.collect(vector, policy_fn, vector.reset(new_key()), jax.random.key(1))
    weight = method.weight(steps)
    np.testing.assert_array_equal(weight[:, 0], [1, 1, 1, 0, 0])
    estimate = method.estimate(steps, weight, *jnp.zeros((3, 5, 4)))
    np.testing.assert_array_equal(estimate.advantage[:3, 0], [3, 2, 1])


@pytest.mark.parametrize(
    "method", [td(0.9, 4, gae(0.95)), *(reinforce(0.9, baseline) for baseline in BASELINES.values())]
)
def test_finds_the_best_action_of_a_one_step_task(method):
    networks, algorithm = make(Target(), method, num_envs=64, episode_length=2, learning_rate=1e-2)
    state, _ = jax.jit(lambda key: train_scan(algorithm, key, 400))(new_key())
    act = deterministic_policy(networks, state.params, state.normalizer)
    assert float(act(jnp.ones(1))[0]) == pytest.approx(0.5, abs=0.1)


def equal_bits(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_scan_is_a_loop_over_steps():
    """One scan against update after update; separate programs, so equal to rounding."""
    _, algorithm = make(Counter(), td(0.9, 4, gae(0.95)))
    scanned, _ = jax.jit(lambda key: train_scan(algorithm, key, 5))(new_key())
    state, step = jax.jit(lambda key: initial_state(algorithm, key))(new_key()), jax.jit(algorithm.step)
    for i in range(5):
        state, _ = step(state, jax.random.fold_in(new_key(), i + 1))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), scanned, state)


@pytest.mark.optimized
@pytest.mark.parametrize("method", [td(0.9, 4, gae(0.95)), reinforce(0.9, critic)])
def test_training_in_chunks_is_training_in_one_piece(method):
    """To the bit: state and metrics."""
    _, algorithm = make(Counter(), method)
    first = jax.jit(lambda key: initial_state(algorithm, key))(new_key())
    whole, metrics = jax.jit(lambda key: train_scan(algorithm, key, 6))(new_key())
    for chunk in (1, 3):
        advance = jax.jit(lambda key, state, chunk=chunk: train_scan(algorithm, key, chunk, state))
        state, pieces = first, []
        for _ in range(6 // chunk):
            state, piece = advance(new_key(), state)
            pieces.append(piece)
        equal_bits(whole, state)
        equal_bits(metrics, jax.tree.map(lambda *parts: np.concatenate(parts), *pieces))


def test_vmapped_seeds_are_single_seeds():
    _, algorithm = make(Counter(life=7), td(0.9, 4, gae(0.95)))
    train = lambda key: train_scan(algorithm, key, 10)  # noqa: E731
    # Off: under vmap JAX turns cond into a select over its operands, and its checker takes that for a second use.
    with jax.debug_key_reuse(False):
        together, _ = jax.jit(jax.vmap(train))(jnp.stack([new_key(seed) for seed in range(3)]))
    train_alone = jax.jit(train)
    for i in range(3):
        alone, _ = train_alone(new_key(i))
        one_of_them = jax.tree.map(operator.itemgetter(i), together.params)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), one_of_them, alone.params)


def test_training_is_one_outer_scan():
    """The jaxpr of the training has exactly one scan at its top, with rollout and update in its body."""
    _, algorithm = make(Counter(), td(0.9, 4, gae(0.95)))
    state = initial_state(algorithm, new_key())
    jaxpr = jax.make_jaxpr(lambda key, state: train_scan(algorithm, key, 5, state))(new_key(), state)
    scans = [eqn for eqn in jaxpr.eqns if eqn.primitive.name == "scan"]
    assert [eqn.params["length"] for eqn in scans] == [5]
    inner = str(scans[0].params["jaxpr"])
    assert "scan" in inner
    assert "dot_general" in inner


def test_policy_is_not_moved_by_the_critics_error():
    """With zero rewards, a zero discount and no normalization the advantage is -V(s): the actor learns, from V alone;
    with the advantage replaced by 0 it must not move at all, although the critic has an error."""

    def no_advantage(transition, weight, value, next_value, squared_score):
        estimate = td_lambda(transition.reward, 0.9, value, next_value, 0.95)
        return estimate._replace(advantage=jnp.zeros_like(value))

    method: Method = td(0.9, 4, gae(0.95))._replace(estimate=no_advantage)
    _, algorithm = make(Counter(), method, normalize_advantages=False)
    before = jax.jit(lambda key: initial_state(algorithm, key))(new_key())
    after, metrics = jax.jit(algorithm.step)(before, jax.random.key(1))
    equal_bits(before.params["actor"], after.params["actor"])
    assert float(metrics["value_loss"]) > 0
    moved = jax.tree.map(operator.ne, before.params["critic"], after.params["critic"])
    assert any(bool(leaf.any()) for leaf in jax.tree.leaves(moved))


def test_one_unclipped_step_of_ppo_is_td():
    """The surrogate's gradient at a ratio of 1 is the policy gradient; to rounding of the ratio."""
    _, once = make(Counter(), td(0.9, 4, gae(0.95)))
    _, reused = make(Counter(), td(0.9, 4, gae(0.95)), algorithm=ppo, epochs=1, clip=None)
    left, right = (jax.jit(lambda key, a=a: train_scan(a, key, 20))(new_key())[0] for a in (once, reused))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), left.params, right.params)
    _, again = make(Counter(), td(0.9, 4, gae(0.95)), algorithm=ppo, epochs=2, clip=None)
    other, _ = jax.jit(lambda key: train_scan(again, key, 20))(new_key())
    assert max(abs(a - b).max() for a, b in zip(*map(jax.tree.leaves, (left.params, other.params)), strict=True)) > 1e-3


@pytest.mark.parametrize("limit", [3, 5, 7])
def test_advantages_are_of_the_values_of_both_normalized_observations(limit):
    """A = 2 r + gamma V(s') - V(s) of TD(0), with the true next observation at time limits; rollouts short and long."""
    networks, _ = make(Counter(), td(0.9, 5, gae(0.0)))
    params, vector = networks.init(new_key()), vectorize(Counter(life=4), 12, limit)
    statistics = normalization.update(normalization.init(2), jnp.array([[1.0, 2.0], [4.0, -3.0]]))
    method, policy_fn = td(0.9, 5, gae(0.0)), sampling_policy(networks, params, statistics)
    _, steps = method.collect(vector, policy_fn, method.start(vector, new_key()), jax.random.key(1))
    batch = make_batch_fn(networks, method, limit, 2.0, False)(params, statistics, steps)
    value, next_value = (
        networks.value(params["critic"], normalization.normalize(statistics, x)) for x in (steps.obs, steps.next_obs)
    )
    expected = 2 * steps.reward + 0.9 * (1 - steps.terminated) * next_value - value
    np.testing.assert_allclose(batch.advantage, expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(batch.target, expected + value, rtol=1e-5, atol=1e-5)
    assert steps.truncated[:-1].sum() > 0
    assert (steps.terminated.sum() > 0) == (limit > 3)


def test_finds_the_best_action_from_few_rollouts():
    networks, algorithm = make(
        Target(),
        td(0.9, 4, gae(0.95)),
        num_envs=64,
        episode_length=2,
        learning_rate=1e-2,
        algorithm=ppo,
        minibatches=2,
        max_kl=0.1,
    )
    state, _ = jax.jit(lambda key: train_scan(algorithm, key, 40))(new_key())
    act = deterministic_policy(networks, state.params, state.normalizer)
    assert float(act(jnp.ones(1))[0]) == pytest.approx(0.5, abs=0.1)


def test_evaluation_counts_each_episode_once_to_its_end():
    def four_keys():
        return jax.random.split(new_key(), 4)

    episodes = evaluate(Counter(life=3), lambda obs: jnp.zeros((4, 1)), four_keys(), 10)
    np.testing.assert_array_equal(episodes.episode_return, 3)
    np.testing.assert_array_equal(episodes.length, 3)
    longer = evaluate(Counter(life=30), lambda obs: jnp.zeros((4, 1)), four_keys(), 10)
    np.testing.assert_array_equal(longer.episode_return, 10)


def test_state_fields_are_all_carried():
    """A checkpoint of the state is enough: nothing of the training is hidden elsewhere."""
    _, algorithm = make(Counter(), td(0.9, 4, gae(0.95)))
    state, _ = jax.jit(lambda key: train_scan(algorithm, key, 2))(new_key())
    copy = jax.tree.map(lambda x: jnp.array(np.asarray(x)), state)
    # Each is traced and compiled by itself.
    one, other = (jax.jit(lambda key, state: train_scan(algorithm, key, 2, state))(new_key(), x) for x in (state, copy))
    equal_bits(one, other)


class Sides:
    """Observes on which side it is, in some unit and from some origin; the best action is 0.8 times the side."""

    observation_size = action_size = 1

    def __init__(self, unit, origin=0.0):
        self.unit, self.origin = unit, origin

    def reset(self, rng):
        x, zero = jax.random.choice(rng, jnp.array([-1.0, -0.5, 0.5, 1.0])), jnp.zeros(())
        return State(x, self.observe(x), zero, zero)

    def observe(self, x):
        return (self.unit * (self.origin + x))[None]

    def step(self, state, action):
        reward = -((action[0] - 0.8 * jnp.sign(state.pipeline_state)) ** 2)
        return state.replace(reward=reward)


@jax.jit
def act_on_both_sides(unit, origin):
    """The actions on both sides that are learned in these units."""
    env, sides = Sides(unit, origin), jnp.array([-1.0, -0.5, 0.5, 1.0])
    networks, made = make(env, td(0.5, 5, gae(0.9)), num_envs=32, episode_length=5, learning_rate=1e-2)
    state, _ = train_scan(made, new_key(), 150)
    return deterministic_policy(networks, state.params, state.normalizer)(jax.vmap(env.observe)(sides))[:, 0]


@pytest.mark.parametrize(("unit", "origin"), [(1.0, 0.0), (1e-6, 0.0), (1e-3, 3.0), (1e5, 0.0), (0.1, 1e5)])
def test_units_of_the_observations_do_not_matter(unit, origin):
    """Micrometres, an offset of 10^4 with a deviation of 0.1: the sides are told apart as in units of size 1."""
    action = act_on_both_sides(unit, origin)
    assert np.sign(action).tolist() == [-1, -1, 1, 1]
    assert (np.abs(action) > 0.4).all()
