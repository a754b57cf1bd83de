"""The per-step actor-critic against the lesson's equations, written out in numpy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.quadratic import LinearQuadratic, QuadraticConfig, chain
from jaxpg import normalization
from jaxpg.distributions import GAUSSIAN
from jaxpg.networks import learned as learned_sigma
from jaxpg.networks import linear_mean, linear_networks, mlp_networks
from jaxpg.online import Traces, online_actor_critic, trace_update
from jaxpg.training import initial_state, train_scan
from jaxpg.types import Transition
from jaxpg.vector_env import vectorize

OPTIONS = {
    "gamma": 0.9,
    "lambda_actor": 0.7,
    "lambda_critic": 0.4,
    "actor_lr": 1e-3,
    "critic_lr": 5e-3,
    "normalize_observations": False,
}


def transcription(params, steps, *, gamma, lambda_actor, lambda_critic, actor_lr, critic_lr, discounted=False, **_):
    """The lesson's listing in float64: linear mean and value, one log sigma, one environment, numpy only.

    Args:
      params: W `[m, n]`, b `[m]`, log_sigma `[m]`, w `[n]`, c.
      steps: (s, a, r, s_next, terminated, truncated) of each step.
    """
    W, b, log_sigma, w, c = params
    n, m = len(w), len(b)
    traces = [np.zeros((m, n)), np.zeros(m), np.zeros(m), np.zeros(n), 0.0]
    factor = 1.0
    for s, a, r, s_next, terminated, truncated in steps:
        next_value = 0.0 if terminated else w @ s_next + c
        delta = r + gamma * next_value - (w @ s + c)
        variance = np.exp(2 * log_sigma)
        difference = a - (W @ s + b)
        in_mean = difference / variance
        score = [np.outer(in_mean, s), in_mean, difference**2 / variance - 1]
        for i in range(3):
            traces[i] = gamma * lambda_actor * traces[i] + factor * score[i]
        traces[3] = gamma * lambda_critic * traces[3] + s
        traces[4] = gamma * lambda_critic * traces[4] + 1.0
        W = W + actor_lr * delta * traces[0]
        b = b + actor_lr * delta * traces[1]
        log_sigma = log_sigma + actor_lr * delta * traces[2]
        w = w + critic_lr * delta * traces[3]
        c = c + critic_lr * delta * traces[4]
        factor = gamma * factor if discounted else 1.0
        if terminated or truncated:
            traces, factor = [0 * z for z in traces], 1.0
    return W, b, log_sigma, w, c


class Noted(LinearQuadratic):
    """The linear-quadratic problem that terminates when the first variable is above a line."""

    line = 0.9

    def step(self, state, action):
        state = super().step(state, action)
        return state.replace(done=(state.obs[0] > self.line).astype(state.reward.dtype))


def noted(batch, log):
    """The environments, with the steps written down in order while they are played."""

    def step(state, action, key):
        following, outcome = batch.step(state, action, key)
        entry = (state.obs, action, outcome.reward, outcome.next_obs, outcome.terminated, outcome.truncated)
        jax.debug.callback(lambda *x: log.append([np.asarray(part, np.float64)[0] for part in x]), *entry, ordered=True)
        return following, outcome

    return batch._replace(step=step)


def unpacked(params):
    critic = params["critic"]["params"]["Dense_0"]
    log_std = params["actor"]["params"]["log_std"]
    arrays = *linear_mean(params["actor"]), log_std, critic["kernel"][:, 0], critic["bias"][0]
    return [np.asarray(x, np.float64) for x in arrays]


@functools.cache
def play(num_steps=60, **options):
    """Parameters before and after, and the steps: two variables, terminations and time limits, one environment."""
    env, log = Noted(chain(QuadraticConfig(state_size=2, start_spread=0.3, noise=0.3))), []
    networks = linear_networks(2, 2, sigma=learned_sigma(0.5), distribution=GAUSSIAN)
    algorithm = online_actor_critic(noted(vectorize(env, 1, 7), log), networks, num_steps=num_steps, **options)
    with jax.enable_x64(True):
        state = initial_state(algorithm, jax.random.key(0))
        learned = jax.tree.map(lambda x: x.astype(jnp.float64), (state.params, state.opt_state))
        state = state._replace(params=learned[0], opt_state=learned[1])
        after, _ = jax.jit(algorithm.step)(state, jax.random.key(1))
        jax.effects_barrier()
        return unpacked(state.params), unpacked(after.params), log


@pytest.mark.parametrize("options", [{}, {"discounted": True}, {"lambda_actor": 0.0, "lambda_critic": 0.0}], ids=str)
def test_updates_are_the_lessons(options):
    """To 1e-6 of each array's size: also without statistics the normalizer divides by sqrt(1 + 1e-6)."""
    options = OPTIONS | options
    before, after, log = play(**options)
    terminated, truncated = np.array([entry[4:] for entry in log]).T
    assert terminated.sum() > 2
    assert truncated.sum() > 2
    for mine, true in zip(after, transcription(before, log, **options), strict=True):
        np.testing.assert_allclose(mine, true, rtol=0, atol=1e-6 * np.abs(true).max())


def test_update_of_several_environments_is_the_mean_of_theirs():
    """From the same parameters, with traces of their own."""
    networks = linear_networks(2, 2, sigma=learned_sigma(0.5), distribution=GAUSSIAN)
    update = trace_update(networks, 0.9, 0.7, 0.4, 0.1, 0.2, 1.0, discounted=False)
    random, params, statistics = np.random.default_rng(0), networks.init(jax.random.key(0)), normalization.init(2)
    obs, u, next_obs = (jnp.asarray(random.normal(size=(3, 2)), jnp.float32) for _ in range(3))
    reward, zero = jnp.asarray(random.normal(size=3), jnp.float32), jnp.zeros(3)
    steps = Transition(obs, u, reward, zero, zero, next_obs, zero, zero, zero)
    traces = jax.tree.map(lambda x: jnp.asarray(random.normal(size=(3, *x.shape)), jnp.float32), params)
    traces = Traces(traces["actor"], traces["critic"], jnp.ones(3))
    together, *_ = update(params, traces, statistics, steps)
    rows = [jax.tree.map(lambda x, i=i: x[i : i + 1], (traces, steps)) for i in range(3)]
    alone = [update(params, own_traces, statistics, own)[0] for own_traces, own in rows]
    jax.tree.map(lambda x, *xs: np.testing.assert_allclose(x, sum(xs) / 3, rtol=1e-4, atol=1e-6), together, *alone)


WRONG = {
    "termination not noticed": lambda log: ([[*entry[:4], 0.0, entry[5]] for entry in log], {}),
    "time limit taken for a termination": lambda log: ([[*entry[:4], sum(entry[4:]), 0.0] for entry in log], {}),
    "traces go on through the time limit": lambda log: ([[*entry[:5], 0.0] for entry in log], {}),
    "the reset observation as the next one": lambda log: (
        [[*entry[:3], following[0], *entry[4:]] for entry, following in zip(log, log[1:] + log[:1], strict=True)],
        {},
    ),
    "traces of actor and critic exchanged": lambda log: (log, {"lambda_actor": 0.4, "lambda_critic": 0.7}),
    "factor gamma^t": lambda log: (log, {"discounted": True}),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_variants_are_seen(name):
    before, after, log = play(**OPTIONS)
    steps, options = WRONG[name](log)
    wrong = transcription(before, steps, **OPTIONS | options)
    assert max(np.abs(mine - other).max() for mine, other in zip(after, wrong, strict=True)) > 1e-5


def test_seeds_and_chunks():
    """vmapped seeds are single seeds, and training in pieces is training in one; to rounding, as programs differ."""
    env = LinearQuadratic(chain(QuadraticConfig(state_size=2)))
    algorithm = online_actor_critic(vectorize(env, 2, 20), mlp_networks(2, 2, (8,)), num_steps=30, **OPTIONS)
    train = jax.jit(lambda key: train_scan(algorithm, key, 6))
    with jax.debug_key_reuse(False):  # see test_vmapped_seeds_are_single_seeds
        both = jax.jit(jax.vmap(lambda key: train_scan(algorithm, key, 6)))(
            jnp.stack([jax.random.key(seed) for seed in (3, 4)])
        )[0]
    for i, seed in enumerate((3, 4)):
        one = train(jax.random.key(seed))[0]
        jax.tree.map(
            lambda x, y, i=i: np.testing.assert_allclose(x[i], y, rtol=1e-3, atol=1e-4), both.params, one.params
        )
    part, _ = jax.jit(lambda key: train_scan(algorithm, key, 2))(jax.random.key(3))
    rest, _ = jax.jit(lambda key, state: train_scan(algorithm, key, 4, state))(jax.random.key(3), part)
    whole, _ = train(jax.random.key(3))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-7), rest.params, whole.params)
