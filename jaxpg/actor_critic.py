"""The actor-critic: rollout, advantage estimate and one gradient step as a pure `Algorithm`.

REINFORCE and TD are the same program. They differ in one argument, the `Method`: how the steps are collected and what
is made of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxpg import baselines, estimators, normalization
from jaxpg.distributions import gaussian_sample
from jaxpg.estimators import Estimate
from jaxpg.losses import entropy_loss, policy_gradient_loss, value_loss
from jaxpg.networks import Networks
from jaxpg.returns import discount_factors
from jaxpg.rollout import PolicyFn, rollout
from jaxpg.types import Algorithm, Metrics, PyTree, TrainState, Transition
from jaxpg.vector_env import VectorEnv, VectorState, stagger


class Method(NamedTuple):
    """What REINFORCE and TD do differently.

    Attributes:
      start: `start(env, key) -> env_state`, the environments before the first update.
      collect: `collect(env, policy_fn, env_state, key) -> (env_state, Transition)`.
      weight: `weight(transition) -> [T, N]`, 1 where a step counts.
      estimate: `estimate(transition, weight, value, next_value, squared_score) -> Estimate`, all `[T, N]`; the score is
        the gradient of log pi(a_t | s_t) in the Gaussian's mean.
    """

    start: Callable[[VectorEnv, jax.Array], VectorState]
    collect: Callable[[VectorEnv, PolicyFn, VectorState, jax.Array], tuple[VectorState, Transition]]
    weight: Callable[[Transition], jax.Array]
    estimate: Callable[[Transition, jax.Array, jax.Array, jax.Array, jax.Array], Estimate]


ESTIMATORS = ("td_lambda", "td_zero", "n_step", "monte_carlo")


def td(gamma: float, lambda_: float, num_steps: int, estimator: str = "td_lambda", n: int = 5) -> Method:
    """Temporal differences: short rollouts that go on where the last one stopped, and bootstrap.

    Termination sets the discount to 0. A time limit or the end of the rollout stops the lambda-sum and bootstraps
    from the value of the true next observation.

    Args:
      gamma: discount, in [0, 1].
      lambda_: 0 for the one-step TD error, 1 for Monte Carlo with a bootstrap at cuts.
      num_steps: T, length of a rollout.
      estimator: one of `ESTIMATORS`; td_zero and monte_carlo are td_lambda with lambda 0 and 1.
      n: rewards that n_step sums.
    """
    lambda_ = {"td_zero": 0.0, "monte_carlo": 1.0}.get(estimator, lambda_)

    def start(env, key):
        key_reset, key_stagger = jax.random.split(key)
        return stagger(env.reset(key_reset), key_stagger, env.episode_length)

    def collect(env, policy_fn, env_state, key):
        return rollout(policy_fn, env.step, env_state, key, num_steps)

    def estimate(transition, weight, value, next_value, squared_score):
        discount = gamma * (1 - transition.terminated)
        continues = 1 - transition.truncated
        if estimator == "n_step":
            return estimators.n_step(transition.reward, discount, value, next_value, n, continues)
        return estimators.td_lambda(transition.reward, discount, value, next_value, lambda_ * continues)

    return Method(start, collect, lambda transition: jnp.ones_like(transition.reward), estimate)


# What is subtracted from the returns, of (returns, weight, value, squared_score).
BASELINES: dict[str, Callable[..., jax.Array | float]] = {
    "none": lambda *_: 0.0,
    "mean": lambda returns, weight, *_: baselines.batch_mean(returns, weight),
    "time_mean": lambda returns, weight, *_: baselines.time_mean(returns, weight),
    "leave_one_out": lambda returns, weight, *_: baselines.leave_one_out(returns, weight),
    "optimal": lambda returns, weight, _, squared_score: baselines.optimal(returns, squared_score, weight),
    "value": lambda _, weight, value, squared_score: value,
}
RETURNS = {"to_go": estimators.reinforce, "whole": estimators.reinforce_whole}


def reinforce(gamma: float, baseline: str, returns: str = "to_go", discounted: bool = False) -> Method:
    """REINFORCE: whole episodes from a fresh reset to the time limit, masked after termination; no bootstrap.

    Args:
      gamma: discount, in [0, 1].
      baseline: a name in `BASELINES`.
      returns: a name in `RETURNS`: "to_go" is from each step on, "whole" that of the episode, at each of its steps.
      discounted: advantages times gamma^t, which makes the estimate that of the gradient of J; with whole returns it is
        so without.
    """

    def collect(env, policy_fn, env_state, key):
        key_reset, key_rollout = jax.random.split(key)
        return rollout(policy_fn, env.step, env.reset(key_reset), key_rollout, env.episode_length)

    def weight(transition):
        """1 up to and with the step that ends the episode, 0 in the one that the reset began."""
        ended = jnp.cumsum(transition.terminated, axis=0) - transition.terminated
        return (ended == 0).astype(transition.reward.dtype)

    def estimate(transition, weight, value, next_value, squared_score):
        reward = weight * transition.reward
        discount = gamma * (1 - transition.terminated)
        earned, target = RETURNS[returns](reward, discount)
        advantage = earned - BASELINES[baseline](earned, weight, value, squared_score)
        if discounted:
            advantage = discount_factors(discount) * advantage
        return Estimate(advantage, target)

    return Method(lambda env, key: env.reset(key), collect, weight, estimate)


def actor_critic(
    env: VectorEnv,
    networks: Networks,
    optimizer: optax.GradientTransformation,
    method: Method,
    *,
    reward_scale: float = 1.0,
    entropy_coef: float = 0.0,
    normalize_observations: bool = True,
    normalize_advantages: bool = True,
) -> Algorithm:
    """Policy-gradient training of an actor and a critic, one gradient step on `actor_critic_loss` for each rollout.

    Args:
      env: N environments.
      networks: policy and value; their parameters are apart, so the two losses may be added.
      optimizer: of `{"actor": ..., "critic": ...}`.
      method: `td(...)` or `reinforce(...)`.
      reward_scale: factor on the rewards that the estimator and the critic see; reported returns are not scaled.
      entropy_coef: weight of the policy's entropy; of a squashed one estimated by its samples.
      normalize_observations: feed the networks (s - mean) / std with running statistics, updated after each step.
      normalize_advantages: mean 0 and standard deviation 1 over the batch.

    Returns:
      `Algorithm(init, step)`; metrics are scalars, of which `return_sum` and `episodes` are to be summed over updates
      and the others averaged.
    """

    loss_fn = actor_critic_loss(networks, method, reward_scale, entropy_coef, normalize_advantages)

    def init(key: jax.Array) -> TrainState:
        key_params, key_env = jax.random.split(key)
        params = networks.init(key_params)
        return TrainState(
            params=params,
            opt_state=optimizer.init(params),
            normalizer=normalization.init(env.observation_size),
            env_state=method.start(env, key_env),
            update=jnp.zeros((), jnp.int32),
        )

    def step(state: TrainState, key: jax.Array) -> tuple[TrainState, Metrics]:
        policy_fn = sampling_policy(networks, state.params, state.normalizer)
        env_state, transition = method.collect(env, policy_fn, state.env_state, key)
        gradients, losses = jax.grad(loss_fn, has_aux=True)(state.params, state.normalizer, transition)
        updates, opt_state = optimizer.update(gradients, state.opt_state, state.params)
        normalizer = state.normalizer
        if normalize_observations:
            normalizer = normalization.update(normalizer, transition.obs)
        metrics = losses | {
            "gradient_norm": optax.tree.norm(gradients),
            "return_sum": jnp.sum(transition.episode_return),
            "episodes": jnp.sum(transition.episode_end),
        }
        params = optax.apply_updates(state.params, updates)
        return TrainState(params, opt_state, normalizer, env_state, state.update + 1), metrics

    return Algorithm(init, step)


def actor_critic_loss(
    networks: Networks, method: Method, reward_scale: float, entropy_coef: float, normalize_advantages: bool
) -> Callable[[PyTree, PyTree, Transition], tuple[jax.Array, Metrics]]:
    """`loss(params, normalizer, transition) -> (L, metrics)` of a rollout.

        L(theta, w) = -mean(log pi_theta(a_t | s_t) stop(A_t)) + 1/2 mean((V_w(s_t) - stop(target_t))^2)
                      - entropy_coef mean(H_t)

    Args:
      networks, method, reward_scale, entropy_coef, normalize_advantages: as in `actor_critic`.
    """

    def loss(params, normalizer, transition):
        obs = normalization.normalize(normalizer, transition.obs)
        next_obs = normalization.normalize(normalizer, transition.next_obs)
        value = networks.value(params["critic"], obs)
        next_value = networks.value(jax.lax.stop_gradient(params["critic"]), next_obs)
        weight = method.weight(transition)
        scaled = transition._replace(reward=reward_scale * transition.reward)
        mean, log_std = networks.policy(params["actor"], obs)
        score = jax.lax.stop_gradient((transition.u - mean) * jnp.exp(-2 * log_std))
        squared_score = jnp.sum(jnp.square(score), axis=-1)
        advantage, target = method.estimate(scaled, weight, value, next_value, squared_score)
        if normalize_advantages:
            advantage = estimators.normalize_advantages(advantage, weight)
        log_prob = networks.distribution.log_prob(transition.u, mean, log_std)
        entropy = networks.distribution.entropy(transition.u, mean, log_std)
        losses = {
            "policy_loss": policy_gradient_loss(log_prob, advantage, weight),
            "value_loss": value_loss(value, target, weight),
            "entropy": -entropy_loss(entropy, weight),
        }
        total = losses["policy_loss"] + losses["value_loss"] - entropy_coef * losses["entropy"]
        return total, losses | {"sigma": jnp.mean(jnp.exp(log_std)), "value": jnp.mean(value)}

    return loss


def sampling_policy(networks: Networks, params: PyTree, normalizer: PyTree) -> PolicyFn:
    """`policy_fn(obs, key) -> (u, action)`, drawn from the Gaussian."""

    def policy_fn(obs, key):
        mean, log_std = networks.policy(params["actor"], normalization.normalize(normalizer, obs))
        u = gaussian_sample(key, mean, log_std)
        return u, networks.distribution.action(u)

    return policy_fn


def deterministic_policy(networks: Networks, params: PyTree, normalizer: PyTree) -> Callable[[jax.Array], jax.Array]:
    """`policy(obs) -> action`: that of the Gaussian's mean."""

    def policy(obs):
        mean, _ = networks.policy(params["actor"], normalization.normalize(normalizer, obs))
        return networks.distribution.action(mean)

    return policy
