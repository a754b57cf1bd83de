"""Releases of jaxlib that compute wrong numbers are refused."""

import jax
import jaxlib
import pytest
from wrong_sums import wrong_sums

from jaxpg.compatibility import WRONG_SUMS, check_jaxlib
from jaxpg.config.parsing import compose
from jaxpg.program.agents import list_agents
from jaxpg.program.algorithms import make_algorithm
from jaxpg.program.environment import make_env
from jaxpg.training import train_scan


@pytest.mark.parametrize("version", WRONG_SUMS)
def test_releases_with_wrong_sums_are_refused_by_name(version):
    with pytest.raises(ImportError, match=version):
        check_jaxlib(version)


def test_the_installed_release_sums_right_or_is_refused():
    """Where a release of `WRONG_SUMS` is installed, `python tests/wrong_sums.py` reproduces them."""
    check_jaxlib(jaxlib.__version__)
    assert wrong_sums() == 0


@pytest.mark.parametrize("environment", ["pendulum", pytest.param("arm", marks=pytest.mark.study)])
def test_the_training_program_makes_no_lapack_call(environment):
    """Neither the start nor the updates of two agents at once: batched LAPACK calls hang on some releases."""
    sizes = ("num_seeds=2", "num_envs=8", "num_steps=2", "total_steps=32", "eval_episodes=2")
    config = compose([f"env={environment}", *sizes])
    env = make_env(config)
    algorithm = make_algorithm(config, env)
    train = jax.jit(jax.vmap(lambda seed: train_scan(algorithm, jax.random.key(seed), 2)))
    with jax.debug_key_reuse(False):  # see test_vmapped_seeds_are_single_seeds
        compiled = train.lower(list_agents(config).seed).compile().as_text()
    assert 'custom_call_target="lapack' not in compiled
