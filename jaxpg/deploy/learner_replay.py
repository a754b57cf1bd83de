"""Replays the same steps through JAX and through an exported learner, to compare them."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxpg import divergence
from jaxpg.config.schema import Online
from jaxpg.networks import Networks, linear_mean
from jaxpg.online import Traces, find_learnable_steps, trace_update
from jaxpg.policy import sampling_policy
from jaxpg.program.networks import make_networks
from jaxpg.program.state import Policy
from jaxpg.rollout import rollout
from jaxpg.store.policies import StoredPolicy
from jaxpg.types import PyTree, Transition
from jaxpg.vector_env import vectorize

NUM_STEPS = 1000


def collect_steps(stored: StoredPolicy) -> Transition:
    """Steps of one environment under the stochastic policy, `[T, 1, ...]`, T <= `NUM_STEPS`.

    If training would ignore a step (`jaxpg.online.find_learnable_steps`), its episode is left out up to that step.
    """
    networks = make_networks(stored.config, stored.env)
    vector = vectorize(stored.env, 1, stored.config.env.episode_length)
    key_reset, key_rollout = jax.random.split(jax.random.key(1))

    @jax.jit
    def play(policy):
        act = sampling_policy(networks, policy.params, policy.normalizer)
        return rollout(act, vector.step, vector.reset(key_reset), key_rollout, NUM_STEPS)[1]

    transition = play(stored.policy)
    sound = find_learnable_steps(transition, stored.policy.normalizer, stored.config.algo.normalize_observations)
    is_learned = np.asarray(divergence.find_sound_steps(~sound, transition.ended))[:, 0]
    return jax.tree.map(lambda x: x[is_learned], transition)


def to_rows(transition: Transition) -> np.ndarray:
    """Steps as the exported example reads them, `[T, 2 n + m + 3]`."""
    one = jax.tree.map(lambda x: np.asarray(x)[:, 0], transition)
    rest = one.reward, one.next_obs, one.terminated, one.truncated
    return np.concatenate([x.reshape(len(one.obs), -1) for x in (one.obs, one.u, *rest)], axis=1)


def learn(
    networks: Networks, options: Online, policy: Policy, log_std: np.ndarray, transition: Transition
) -> jax.Array:
    """W, b, log sigma, w and c after each of the steps, `[T, P]`, by `jaxpg.online.trace_update`.

    Args:
      networks: linear networks.
      options: options of the algorithm.
      policy: the policy before the first step; its observation statistics stay fixed.
      log_std: log sigma `[m]`, used if it is not a parameter.
      transition: steps of one environment, `[T, 1, ...]`.
    """
    names = ("gamma", "lambda_actor", "lambda_critic", "actor_lr", "critic_lr", "reward_scale", "discounted")
    update = trace_update(networks, **{name: getattr(options, name) for name in names})

    def flat(params: PyTree) -> jax.Array:
        weight, bias = linear_mean(params["actor"])
        sigma = params["actor"]["params"].get("log_std", log_std)
        value = params["critic"]["params"]["Dense_0"]
        return jnp.concatenate([weight.T.ravel(), bias, sigma, value["kernel"].ravel(), value["bias"]])

    def step(carry, transition):
        params, traces = carry
        params, traces, _ = update(params, traces, policy.normalizer, transition, True)
        return (params, traces), flat(params)

    def replay(params, transition):
        zeros = jax.tree.map(lambda x: jnp.zeros((1, *x.shape), x.dtype), params)
        traces = Traces(zeros["actor"], zeros["critic"], jnp.ones_like(transition.reward[0]))
        return jax.lax.scan(step, (params, traces), transition)[1]

    return jax.jit(replay)(policy.params, transition)


def compare(found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """max |a - b| / max(1, |b|) over the parameters after each step, `[T, P]` to `[T]`; NaN if any is.

    >>> compare(np.array([[1.5, 200.0]]), np.array([[1.0, 100.0]])).tolist()
    [1.0]
    """
    with np.errstate(all="ignore"):  # diverged numbers
        return np.max(np.abs(found - expected) / np.maximum(1, np.abs(expected)), axis=1)


def rounding_effect(
    learn: Callable[[Transition], jax.Array], transition: Transition, expected: np.ndarray
) -> np.ndarray:
    """The effect of float rounding on the parameters after each step, `[T]`, measured as in `compare`.

    The largest difference so far when every number of the steps changes by one float32 epsilon; infinite once a number
    is not finite.

    Args:
      learn: `learn(transition) -> parameters`, `[T, P]`.
      transition: the steps.
      expected: the parameters learned from them.
    """
    epsilon = float(np.finfo(np.float32).eps)

    def relearn(factor):
        numbers = {name: factor * getattr(transition, name) for name in ("obs", "u", "reward", "next_obs")}
        return np.asarray(learn(transition._replace(**numbers)))

    largest = np.maximum(*(compare(relearn(1 + sign * epsilon), expected) for sign in (-1, 1)))
    return np.maximum.accumulate(np.where(np.isnan(largest), np.inf, largest))
