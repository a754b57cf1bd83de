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

from jaxpg import collectives, divergence, estimators, normalization
from jaxpg.distributions import gaussian_sample
from jaxpg.estimators import Estimate, Estimator
from jaxpg.learning import Batch, Reuse, actor_critic_loss, one_step, several_steps
from jaxpg.networks import Networks
from jaxpg.returns import discount_factors
from jaxpg.rollout import PolicyFn, rollout
from jaxpg.shapes import select
from jaxpg.types import Algorithm, Metrics, PyTree, TrainState, Transition
from jaxpg.vector_env import VectorEnv, VectorState, episode_metrics, stagger


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


def td(gamma: float, num_steps: int, estimate: Estimator = estimators.gae(0.95)) -> Method:
    """Temporal differences: short rollouts that go on where the last one stopped, and bootstrap.

    Termination sets the discount to 0. A time limit or the end of the rollout stops the lambda-sum and bootstraps
    from the value of the true next observation.

    Args:
      gamma: discount, in [0, 1].
      num_steps: T, length of a rollout.
      estimate: `estimators.gae(lambda_)`, `estimators.n_rewards(n)`, or one's own function of the same arguments.
    """

    def start(env, key):
        key_reset, key_stagger = jax.random.split(key)
        return stagger(env.reset(key_reset), key_stagger, env.episode_length)

    def collect(env, policy_fn, env_state, key):
        return rollout(policy_fn, env.step, env_state, key, num_steps)

    def estimate_of(transition, weight, value, next_value, squared_score):
        discount = gamma * (1 - transition.terminated)
        return estimate(transition.reward, discount, value, next_value, 1 - transition.truncated)

    return Method(start, collect, lambda transition: jnp.ones_like(transition.reward), estimate_of)


# baseline(returns, weight, value, squared_score) -> what is subtracted from the returns
Baseline = Callable[[jax.Array, jax.Array, jax.Array, jax.Array], jax.Array | float]


def of_returns(baseline: Callable[[jax.Array, jax.Array], jax.Array]) -> Baseline:
    """A baseline of the returns and their weights alone, such as `baselines.leave_one_out`."""
    return lambda returns, weight, value, squared_score: baseline(returns, weight)


def of_scores(baseline: Callable[[jax.Array, jax.Array, jax.Array], jax.Array]) -> Baseline:
    """A baseline that looks at the squared scores too, as `baselines.optimal`."""
    return lambda returns, weight, value, squared_score: baseline(returns, squared_score, weight)


def critic(returns: jax.Array, weight: jax.Array, value: jax.Array, squared_score: jax.Array) -> jax.Array:
    """The critic's V(s_t) as baseline."""
    return value


def no_baseline(returns: jax.Array, weight: jax.Array, value: jax.Array, squared_score: jax.Array) -> float:
    """0 as baseline."""
    return 0.0


def reinforce(
    gamma: float,
    baseline: Baseline = critic,
    returns: Callable[[jax.Array, jax.Array], Estimate] = estimators.reinforce,
    discounted: bool = False,
) -> Method:
    """REINFORCE: whole episodes from a fresh reset to the time limit, masked after termination; no bootstrap.

    Args:
      gamma: discount, in [0, 1].
      baseline: `critic`, `no_baseline`, or one of `jaxpg.baselines` made by `of_returns` or `of_scores`.
      returns: `estimators.reinforce` counts them from each step on, `estimators.reinforce_whole` for the episode.
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
        earned, target = returns(reward, discount)
        advantage = earned - baseline(earned, weight, value, squared_score)
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
    reuse: Reuse | None = None,
    reward_scale: float = 1.0,
    entropy_coef: float = 0.0,
    normalize_observations: bool = True,
    normalize_advantages: bool = True,
    axis_name: str | None = None,
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
        Episodes whose physics diverges in the rollout are left out of them. What is learned leaves out these and those
        that are about to diverge (`learned_from`); where nothing is left, the parameters stay as they are.
      normalize_advantages: mean 0 and standard deviation 1 over the rollout.
      axis_name: a mapped axis, along which further parts of the agent's environments are (`jaxpg.shards`); not with
        `reinforce`, whose baselines and masks are of one part.

    Returns:
      `Algorithm(init, step)`; metrics are scalars, of which `return_sum`, `episodes` and `diverged` are to be summed
      over updates and the others averaged.
    """
    prepare = batch_of(networks, method, env.episode_length, reward_scale, normalize_advantages, axis_name)
    loss = actor_critic_loss(networks, entropy_coef, reuse)
    learn = one_step(loss, optimizer, axis_name) if reuse is None else several_steps(loss, optimizer, reuse, axis_name)

    def init(key: jax.Array) -> TrainState:
        key_params, key_env = jax.random.split(key)
        params = networks.init(key_params)
        return TrainState(
            params=params,
            opt_state=optimizer.init(params),
            normalizer=normalization.init(env.observation_size),
            env_state=method.start(env, collectives.own(key_env, axis_name)),
            update=jnp.zeros((), jnp.int32),
        )

    def step(state: TrainState, key: jax.Array) -> tuple[TrainState, Metrics]:
        key_rollout, key_learn = jax.random.split(key)
        policy_fn = sampling_policy(networks, state.params, state.normalizer)
        key_rollout = collectives.own(key_rollout, axis_name)
        env_state, transition = method.collect(env, policy_fn, state.env_state, key_rollout)
        sound = divergence.lasting(transition.diverged > 0, transition.ended)
        statistics = normalization.update(state.normalizer, transition.obs, axis_name, sound)
        counts = learned_from(transition, statistics)
        batch = prepare(state.params, state.normalizer, transition, counts)
        learned = learn(state.params, state.opt_state, batch, key_learn, state.update)
        something = collectives.largest(jnp.max(batch.weight), axis_name) > 0
        params, opt_state = select(something, learned[:2], (state.params, state.opt_state))
        normalizer = statistics if normalize_observations else state.normalizer
        metrics = learned[2] | episode_metrics(transition, axis_name)
        return TrainState(params, opt_state, normalizer, env_state, state.update + 1), metrics

    return Algorithm(init, step)


def batch_of(
    networks: Networks,
    method: Method,
    episode_length: int,
    reward_scale: float,
    normalize_advantages: bool,
    axis_name: str | None = None,
) -> Callable[[PyTree, PyTree, Transition], Batch]:
    """`prepare(params, normalizer, transition, counts) -> Batch`: a rollout's advantages, and what they are made of.

    Steps that do not count, `[T, N]` of bool, have the weight 0; their numbers are replaced before anything is computed
    with them, so that none of it can overflow.

    Args:
      networks, method, reward_scale, normalize_advantages, axis_name: as in `actor_critic`.
      episode_length: the time limit.
    """

    def prepare(params, normalizer, transition, counts=True):
        counts = jnp.broadcast_to(counts, transition.reward.shape)
        transition = harmless(transition, counts, normalizer)
        obs = normalization.normalize(normalizer, transition.obs)
        value = networks.value(params["critic"], obs)

        def value_fn(x):
            return networks.value(params["critic"], normalization.normalize(normalizer, x))

        next_value = next_values(value_fn, value, transition, episode_length)
        weight = jnp.where(counts, method.weight(transition), 0.0)
        scaled = transition._replace(reward=reward_scale * transition.reward)
        mean, log_std = networks.policy(params["actor"], obs)
        squared_score = jnp.sum(jnp.square((transition.u - mean) * jnp.exp(-2 * log_std)), axis=-1)
        advantage, target = method.estimate(scaled, weight, value, next_value, squared_score)
        if normalize_advantages:
            advantage = estimators.normalize_advantages(advantage, weight, axis_name=axis_name)
        advantage = jnp.where(weight > 0, advantage, 0.0)
        log_prob = networks.distribution.log_prob(transition.u, mean, log_std)
        log_std = jnp.broadcast_to(log_std, mean.shape)
        return Batch(obs, transition.u, mean, log_std, log_prob, value, advantage, target, weight)

    return prepare


def learned_from(transition: Transition, statistics: normalization.RunningStatistics) -> jax.Array:
    """Which steps are learned from, `[T, N]` of bool: those of episodes that stay sound to their end or the rollout's.

    An episode does not where its physics diverges, or where it is about to: an observation is further than
    `jaxpg.divergence.FAR` deviations from the mean, or the policy drew a number that is not finite. All of its steps
    before that are left out too: a joint that explodes passes through any size on its way.

    Args:
      transition: of a rollout.
      statistics: of the observations, this rollout's sound ones included.
    """
    at_home = [normalization.near(statistics, x, divergence.FAR) for x in (transition.obs, transition.next_obs)]
    drawn = jnp.all(jnp.isfinite(transition.u), axis=-1)
    bad = (transition.diverged > 0) | ~at_home[0] | ~at_home[1] | ~drawn
    return divergence.lasting(bad, transition.ended)


def harmless(transition: Transition, counts: jax.Array, statistics: normalization.RunningStatistics) -> Transition:
    """The rollout with steps that do not count replaced: mean observations, drawn and earned 0."""
    mean = jnp.broadcast_to(statistics.mean, transition.obs.shape)
    replaced = {
        "obs": mean,
        "next_obs": mean,
        "u": jnp.zeros_like(transition.u),
        "reward": jnp.zeros_like(transition.reward),
    }
    return transition._replace(**{name: select(counts, getattr(transition, name), x) for name, x in replaced.items()})


def next_values(
    value_fn: Callable[[jax.Array], jax.Array], value: jax.Array, transition: Transition, episode_length: int
) -> jax.Array:
    """V(s_{t+1}) of the true next observations, `[T, N]`; any number where the episode terminated.

    Where an episode goes on it is the value of the next row. A time limit is reached at most once in T <=
    episode_length steps: of each environment two more values are needed, at its time limit and after the last step.

    Args:
      value_fn: `value_fn(obs) -> V`.
      value: V(s_t), `[T, N]`.
      transition: of the rollout.
      episode_length: the time limit; the values of all next observations are computed where the rollout is longer.
    """
    if len(value) > episode_length:
        return value_fn(transition.next_obs)
    when = jnp.argmax(transition.truncated, axis=0)
    at_limit = jnp.take_along_axis(transition.next_obs, when[None, :, None], axis=0)[0]
    of_limit, of_last = value_fn(jnp.stack([at_limit, transition.next_obs[-1]]))
    return jnp.where(transition.truncated > 0, of_limit, jnp.concatenate([value[1:], of_last[None]]))


def sampling_policy(networks: Networks, params: PyTree, normalizer: PyTree) -> PolicyFn:
    """`policy_fn(obs, key) -> (u, action)`, drawn from the Gaussian."""

    def policy_fn(obs, key):
        mean, log_std = networks.policy(params["actor"], normalization.normalize(normalizer, obs))
        u = gaussian_sample(key, mean, log_std)
        return u, networks.distribution.action(u)

    return policy_fn
