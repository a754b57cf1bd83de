"""Every estimator can be asked for by name, is another one than the others, and trains."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from jaxpg.actor_critic import BASELINES, ESTIMATORS
from jaxpg.run.config import compose
from jaxpg.run.program import make_algorithm, make_method
from jaxpg.training import train_scan
from jaxpg.types import Transition

LADDER = [
    *(("td", f"algo.estimator={name}") for name in ESTIMATORS),
    *(("reinforce", f"algo.baseline={name}") for name in BASELINES),
    ("reinforce", "algo.returns=whole"),
    ("reinforce", "algo.discounted=true"),
]


def configured(*options):
    return compose(["env=pendulum", "num_envs=4", "env.episode_length=8", "network.widths=[8]", *options])


@pytest.mark.parametrize(("algo", "option"), LADDER, ids=[option for _, option in LADDER])
def test_estimators_train(algo, option):
    algorithm = make_algorithm(configured(f"algo={algo}", option), envs.make("pendulum"))
    state, metrics = jax.jit(lambda key: train_scan(algorithm, key, 20))(jax.random.key(0))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(state.params))
    assert np.isfinite(metrics["policy_loss"]).all()


def advantages(*options):
    """What the estimator of a command line makes of the same random rollout, with a cut in it."""
    random = np.random.default_rng(0)
    reward, value, next_value, squared_score = jnp.asarray(random.uniform(0.5, 2.0, (4, 8, 3)), jnp.float32)
    zero = jnp.zeros((8, 3))
    steps = Transition(zero, zero, reward, zero, zero.at[3, 0].set(1.0), zero, zero, zero)
    method = make_method(configured(*options))
    return np.asarray(method.estimate(steps, method.weight(steps), value, next_value, squared_score).advantage)


@pytest.mark.parametrize("algo", ["td", "reinforce"])
def test_each_name_is_an_estimator_of_its_own(algo):
    options = [option for name, option in LADDER if name == algo]
    found = [advantages(f"algo={algo}", option) for option in options]
    for i, left in enumerate(found):
        same = [options[j] for j, right in enumerate(found[:i]) if np.abs(left - right).max() < 1e-3]
        assert same == [], options[i]


@pytest.mark.parametrize(
    ("left", "right"),
    [
        (["algo.estimator=td_zero"], ["algo.lambda_=0"]),
        (["algo.estimator=monte_carlo"], ["algo.lambda_=1"]),
        (["algo.estimator=n_step", "algo.n=1"], ["algo.estimator=td_zero"]),
        (["algo.estimator=n_step", "algo.n=99"], ["algo.estimator=monte_carlo"]),
    ],
)
def test_names_for_the_same(left, right):
    np.testing.assert_allclose(advantages(*left), advantages(*right), rtol=1e-5)
