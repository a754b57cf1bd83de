"""What a run will need is estimated from below and close enough, and refused where it cannot fit."""

import re

import jax
import numpy as np
import pytest

from jaxpg.config.parsing import compose
from jaxpg.errors import UserError
from jaxpg.program import memory
from jaxpg.program.algorithms import make_algorithm
from jaxpg.program.environment import make_env
from jaxpg.training import initial_state, train_scan

SIZES = {
    "many environments": ["env=pendulum", "algo=td", "num_envs=65536", "num_steps=4"],
    "long rollouts": ["env=pendulum", "algo=td", "num_envs=64", "num_steps=4096"],
    "wide networks": [
        "env=quadratic",
        "algo=td",
        "network=mlp",
        "num_envs=16",
        "num_steps=2",
        "network.widths=[1024,1024]",
    ],
    "wide and many": ["env=arm", "algo=td", "num_envs=4096", "num_steps=8", "network.widths=[256,256]"],
    "whole episodes": ["env=quadratic", "algo=reinforce", "num_envs=4096", "env.episode_length=64"],
    "traces": ["env=quadratic", "algo=online", "network=mlp", "num_envs=512", "num_steps=2", "network.widths=[64,64]"],
    "features": ["env=arm", "algo=td", "network=linear", "network.features=polynomial", "num_envs=4096", "num_steps=8"],
}


@pytest.mark.parametrize(
    "sizes", [pytest.param(name, marks=[] if "wide" in name else [pytest.mark.study]) for name in SIZES]
)
def test_the_estimate_is_from_below_and_not_far(sizes):
    """Of what XLA says that the compiled updates take, a fifth to all."""
    config = compose([*SIZES[sizes], "eval_episodes=2"])
    env = make_env(config)
    algorithm = make_algorithm(config, env)
    state = jax.eval_shape(lambda seed: initial_state(algorithm, jax.random.key(seed)), np.uint32(0))
    compiled = jax.jit(lambda state: train_scan(algorithm, jax.random.key(0), 2, state)).lower(state).compile()
    sizes = compiled.memory_analysis()
    taken = sizes.temp_size_in_bytes + sizes.argument_size_in_bytes + sizes.output_size_in_bytes
    assert taken / 5 < memory.estimate_memory(config, env) < taken, (memory.estimate_memory(config, env), taken)


def test_what_cannot_fit_is_refused_with_what_would(monkeypatch):
    config = compose(["env=quadratic", "algo=td", "num_envs=100000", "num_steps=16", "eval_episodes=2"])
    env = make_env(config)
    need = memory.estimate_memory(config, env)
    monkeypatch.setattr(memory, "find_available_memory", lambda: need)
    memory.check(config, env)
    monkeypatch.setattr(memory, "find_available_memory", lambda: need // 2)
    with pytest.raises(UserError, match=r"num_envs=100000: this training needs at least .* would fit") as refusal:
        memory.check(config, env)
    fits = int(re.search(r"num_envs=(\d+) would fit", str(refusal.value))[1])
    assert 40_000 < fits < 50_000, "what all environments share takes as much for fewer"
    fitting = compose(["env=quadratic", "algo=td", f"num_envs={fits}", "num_steps=16", "eval_episodes=2"])
    memory.check(fitting, env)
    monkeypatch.setattr(memory, "find_available_memory", lambda: None)
    memory.check(config, env)


def test_more_agents_need_more():
    one, many = (compose(["env=quadratic", f"num_seeds={number}"]) for number in (1, 1000))
    env = make_env(one)
    assert memory.estimate_memory(many, env) > 100 * memory.estimate_memory(one, env)


def test_a_limit_of_the_process_counts():
    import resource

    before = resource.getrlimit(resource.RLIMIT_AS)
    limit = 2**45
    resource.setrlimit(resource.RLIMIT_AS, (limit, before[1]))
    try:
        assert limit in list(memory._read_limits())
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
    assert 2**20 < memory.find_available_memory() < 2**45
