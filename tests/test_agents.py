"""Agents: each setting with each seed."""

import jax
import numpy as np

from jaxpg.config.parsing import compose
from jaxpg.program.agents import get_setting, list_agents, select_agent

SWEEP = ("seed=5", "num_seeds=3", "vmap_seeds=6", "sweep.algo.gamma=[0.5,0.75]", "sweep.network.sigma=[0.25,1]")


def test_all_seeds_of_a_setting_come_before_the_next_setting():
    agents = list_agents(compose(SWEEP))
    np.testing.assert_array_equal(agents.seed, [5, 6, 7] * 4)
    np.testing.assert_array_equal(agents.values["algo.gamma"], [0.5] * 6 + [0.75] * 6)
    np.testing.assert_array_equal(agents.values["network.sigma"], ([0.25] * 3 + [1] * 3) * 2)


def test_an_agent_alone_is_the_run_that_one_would_ask_for():
    config = compose(SWEEP)
    agents = list_agents(config)
    for k, (seed, gamma, sigma) in enumerate(zip(agents.seed, *agents.values.values(), strict=True)):
        assert select_agent(config, k) == compose([f"seed={seed}", f"algo.gamma={gamma}", f"network.sigma={sigma}"])
        assert get_setting(config, k) == {"algo.gamma": gamma, "network.sigma": sigma}


def test_without_a_sweep_the_program_has_no_argument_but_the_seed():
    """So that it is the program that it was, with its bits."""
    (seeds,) = jax.tree.leaves(list_agents(compose(["seed=2", "num_seeds=3"])))
    np.testing.assert_array_equal(seeds, [2, 3, 4])
    assert seeds.dtype == np.uint32
