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
from jaxpg.distributions import gaussian_kl, gaussian_sample
from jaxpg.estimators import Estimate
from jaxpg.losses import (
    clipped_surrogate_loss,
    clipped_value_loss,
    entropy_loss,
    policy_gradient_loss,
    value_loss,
)
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


class Reuse(NamedTuple):
    """How often one rollout is learned from, and how far that may move the policy: PPO.

    Attributes:
      epochs: passes over the rollout, each in another order.
      minibatches: gradient steps of a pass, each on its share of the environments; a divisor of their number.
      clip: epsilon of `jaxpg.losses.clipped_surrogate_loss`; None does not clip.
      value_clip: c of `jaxpg.losses.clipped_value_loss`; None does not clip.
      max_kl: the rest of the rollout's gradient steps is left out once the policy that acted is further than this from
        the one that it has become, as the mean over a minibatch; None takes all of them.
    """

    epochs: int
    minibatches: int
    clip: float | None = 0.2
    value_clip: float | None = None
    max_kl: float | None = None


def actor_critic(
    env: VectorEnv,
    networks: Networks,
    optimizer: optax.GradientTransformation,
    method: Method,
    *,
    reuse: Reuse | None = None,
    reward_scale: float = 1.0,
    entropy_coef: float = 0.0,
    normalize_observations: bool = True,
    normalize_advantages: bool = True,
) -> Algorithm:
    """Policy-gradient training of an actor and a critic, one or several gradient steps for each rollout.

    Args:
      env: N environments.
      networks: policy and value; their parameters are apart, so the two losses may be added.
      optimizer: of `{"actor": ..., "critic": ...}`.
      method: `td(...)` or `reinforce(...)`.
      reuse: several steps on the clipped surrogate; None: one step on the policy-gradient loss.
      reward_scale: factor on the rewards that the estimator and the critic see; reported returns are not scaled.
      entropy_coef: weight of the policy's entropy; of a squashed one estimated by its samples.
      normalize_observations: feed the networks (s - mean) / std with running statistics, updated after each step.
      normalize_advantages: mean 0 and standard deviation 1 over the rollout.

    Returns:
      `Algorithm(init, step)`; metrics are scalars, of which `return_sum` and `episodes` are to be summed over updates
      and the others averaged.
    """
    prepare = batch_of(networks, method, reward_scale, normalize_advantages)
    loss = actor_critic_loss(networks, entropy_coef, reuse)
    learn = one_step(loss, optimizer) if reuse is None else several_steps(loss, optimizer, reuse)

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
        key_rollout, key_learn = jax.random.split(key)
        policy_fn = sampling_policy(networks, state.params, state.normalizer)
        env_state, transition = method.collect(env, policy_fn, state.env_state, key_rollout)
        batch = prepare(state.params, state.normalizer, transition)
        params, opt_state, metrics = learn(state.params, state.opt_state, batch, key_learn)
        normalizer = state.normalizer
        if normalize_observations:
            normalizer = normalization.update(normalizer, transition.obs)
        metrics = metrics | {
            "return_sum": jnp.sum(transition.episode_return),
            "episodes": jnp.sum(transition.episode_end),
        }
        return TrainState(params, opt_state, normalizer, env_state, state.update + 1), metrics

    return Algorithm(init, step)


class Batch(NamedTuple):
    """A rollout as the losses see it, `[T, N, ...]`; constants, of the parameters that acted.

    Attributes:
      obs: normalized.
      u: what the policy's Gaussian drew.
      mean, log_std, log_prob: of the policy that acted.
      value: V(s_t) of the critic at that time.
      advantage, target, weight: as in `Estimate` and `Method`.
    """

    obs: jax.Array
    u: jax.Array
    mean: jax.Array
    log_std: jax.Array
    log_prob: jax.Array
    value: jax.Array
    advantage: jax.Array
    target: jax.Array
    weight: jax.Array


def batch_of(
    networks: Networks, method: Method, reward_scale: float, normalize_advantages: bool
) -> Callable[[PyTree, PyTree, Transition], Batch]:
    """`prepare(params, normalizer, transition) -> Batch`: the advantages of a rollout, and what they are made of.

    Args:
      networks, method, reward_scale, normalize_advantages: as in `actor_critic`.
    """

    def prepare(params, normalizer, transition):
        obs = normalization.normalize(normalizer, transition.obs)
        next_obs = normalization.normalize(normalizer, transition.next_obs)
        value, next_value = (networks.value(params["critic"], x) for x in (obs, next_obs))
        weight = method.weight(transition)
        scaled = transition._replace(reward=reward_scale * transition.reward)
        mean, log_std = networks.policy(params["actor"], obs)
        squared_score = jnp.sum(jnp.square((transition.u - mean) * jnp.exp(-2 * log_std)), axis=-1)
        advantage, target = method.estimate(scaled, weight, value, next_value, squared_score)
        if normalize_advantages:
            advantage = estimators.normalize_advantages(advantage, weight)
        log_prob = networks.distribution.log_prob(transition.u, mean, log_std)
        log_std = jnp.broadcast_to(log_std, mean.shape)
        return Batch(obs, transition.u, mean, log_std, log_prob, value, advantage, target, weight)

    return prepare


def actor_critic_loss(
    networks: Networks, entropy_coef: float, reuse: Reuse | None = None
) -> Callable[[PyTree, Batch], tuple[jax.Array, Metrics]]:
    """`loss(params, batch) -> (L, metrics)`: of actor and critic together.

        L(theta, w) = L_pi(theta) + 1/2 mean((V_w(s_t) - target_t)^2) - entropy_coef mean(H_t)

    Args:
      networks, entropy_coef: as in `actor_critic`.
      reuse: None for L_pi = -mean(log pi_theta(a_t | s_t) A_t); else the clipped surrogate.
    """

    def policy_loss(batch, mean, log_std):
        log_prob = networks.distribution.log_prob(batch.u, mean, log_std)
        if reuse is None:
            return policy_gradient_loss(log_prob, batch.advantage, batch.weight), {}
        moved = {"kl": jnp.mean(gaussian_kl(batch.mean, batch.log_std, mean, log_std))}
        loss = clipped_surrogate_loss(log_prob, batch.log_prob, batch.advantage, reuse.clip, batch.weight)
        return loss, jax.lax.stop_gradient(moved)

    def critic_loss(batch, value):
        if reuse is None or reuse.value_clip is None:
            return value_loss(value, batch.target, batch.weight)
        return clipped_value_loss(value, batch.value, batch.target, reuse.value_clip, batch.weight)

    def loss(params, batch):
        value = networks.value(params["critic"], batch.obs)
        mean, log_std = networks.policy(params["actor"], batch.obs)
        of_policy, moved = policy_loss(batch, mean, log_std)
        entropy = networks.distribution.entropy(batch.u, mean, log_std)
        losses = {
            "policy_loss": of_policy,
            "value_loss": critic_loss(batch, value),
            "entropy": -entropy_loss(entropy, batch.weight),
        }
        total = losses["policy_loss"] + losses["value_loss"] - entropy_coef * losses["entropy"]
        return total, losses | moved | {"sigma": jnp.mean(jnp.exp(log_std)), "value": jnp.mean(value)}

    return loss


# learn(params, opt_state, batch, key) -> (params, opt_state, metrics)
Learn = Callable[[PyTree, PyTree, Batch, jax.Array], tuple[PyTree, PyTree, Metrics]]


def one_step(loss: Callable, optimizer: optax.GradientTransformation) -> Learn:
    """One gradient step on the whole batch."""

    def learn(params, opt_state, batch, key=None):
        gradients, metrics = jax.grad(loss, has_aux=True)(params, batch)
        updates, opt_state = optimizer.update(gradients, opt_state, params)
        metrics = metrics | {"gradient_norm": optax.tree.norm(gradients)}
        return optax.apply_updates(params, updates), opt_state, metrics

    return learn


def several_steps(loss: Callable, optimizer: optax.GradientTransformation, reuse: Reuse) -> Learn:
    """`reuse.epochs` passes over the batch in `reuse.minibatches` parts; metrics are means over the steps taken."""
    once = one_step(loss, optimizer)

    def take(carry, part):
        params, opt_state, near = carry
        params, opt_state, metrics = once(params, opt_state, part)
        return (params, opt_state, near), metrics | {"gradient_steps": jnp.ones(())}

    def take_while_near(carry, part):
        def attempt():
            (params, opt_state, _), metrics = take(carry, part)
            near = metrics["kl"] <= reuse.max_kl  # of the parameters before the step
            taken = jax.tree.map(lambda new, old: jnp.where(near, new, old), (params, opt_state), carry[:2])
            return (*taken, near), jax.tree.map(lambda x: near * x, metrics)

        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(attempt)[1])
        return jax.lax.cond(carry[2], attempt, lambda: (carry, nothing))

    step = take if reuse.max_kl is None else take_while_near

    def learn(params, opt_state, batch, key):
        def epoch(carry, key):
            return jax.lax.scan(step, carry, shuffled_parts(batch, key, reuse.minibatches))

        carry = params, opt_state, jnp.array(True)
        (params, opt_state, _), metrics = jax.lax.scan(epoch, carry, jax.random.split(key, reuse.epochs))
        steps = jnp.sum(metrics["gradient_steps"])
        metrics = {name: jnp.sum(x) / jnp.maximum(steps, 1) for name, x in metrics.items()}
        return params, opt_state, metrics | {"gradient_steps": steps}

    return learn


def shuffled_parts(batch: PyTree, key: jax.Array, number: int) -> PyTree:
    """The environments of a batch `[T, N, ...]` in `number` parts `[number, T, N / number, ...]`, all steps of each.

    Neighbours stay neighbours: the parts begin at a random environment, which costs a copy and not a gather.
    """
    num_envs = batch.advantage.shape[1]
    shift = jax.random.randint(key, (), 0, num_envs)

    def parts(x):
        x = jnp.roll(x, shift, axis=1)
        return jnp.moveaxis(x.reshape(len(x), number, num_envs // number, *x.shape[2:]), 1, 0)

    return jax.tree.map(parts, batch)


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
