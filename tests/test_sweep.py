"""Sweeps: what can be swept, and that it does what the option does."""

import jax
import numpy as np
import pytest

from jaxpg.config.configuration import from_dict
from jaxpg.config.entries import GROUPS
from jaxpg.config.parsing import compose
from jaxpg.config.sweep import find_sweepable_options, list_settings
from jaxpg.program.agents import combine, replace_values
from jaxpg.program.algorithms import make_algorithm
from jaxpg.program.environment import make_env
from jaxpg.program.mapping import map_over_agents
from jaxpg.training import train_scan

SIZES = ("env=quadratic", "num_envs=4", "total_steps=400", "env.episode_length=8")
NETWORK = ("network=linear", "network.sigma_is=learned")  # a fixed sigma leaves the entropy alone
# Far enough from the defaults to change two updates; for all others half the default is.
CHANGED = {"algo.max_gradient_norm": 1e-5, "algo.entropy_coef": 1.0}
CHANGED |= {"algo.clip": 1e-3, "algo.value_clip": 1e-6, "algo.max_kl": 1e-6}
NUMBERS = {"algo.value_clip": 1e9, "algo.max_kl": 1e9}  # where the default is null, which is another program


@pytest.mark.parametrize("algo", GROUPS["algo"])
def test_what_can_be_swept_has_an_effect(algo):
    """Each option in turn has another value, all in one program; every agent's parameters differ from the first's."""
    config = compose([*SIZES, *NETWORK, f"algo={algo}"])
    env = make_env(config)

    def train(agent):
        return train_scan(make_algorithm(replace_values(config, agent.values), env), jax.random.key(agent.seed), 2)[0]

    defaults = {
        name: NUMBERS.get(name, field.default) for name, field in find_sweepable_options(config.choices).items()
    }
    every = [defaults] + [defaults | {name: CHANGED.get(name, defaults[name] / 2)} for name in defaults]
    agents = combine(every, seeds=[0])
    step = jax.jit(map_over_agents(train, 1))
    trained = [step(jax.tree.map(lambda x, i=i: x[i : i + 1], agents)).params for i in range(len(every))]
    flat = [np.concatenate([np.ravel(x) for x in jax.tree.leaves(params)]) for params in trained]
    same = [name for name, params in zip(defaults, flat[1:], strict=True) if np.array_equal(params, flat[0])]
    assert not same


def test_counts_names_and_switches_are_part_of_the_program():
    """And nothing of the environment or the run can be swept."""
    found = find_sweepable_options({"env": "pendulum", "algo": "ppo", "network": "mlp"})
    assert {"algo.gamma", "algo.clip", "network.sigma"} <= set(found)
    assert {name.partition(".")[0] for name in found} == {"algo", "network"}
    assert all(field.type in ("float", "float | None") for field in found.values())


def test_settings_are_all_combinations():
    config = compose(["sweep.algo.actor_lr=[0.1,0.2,0.3]", "sweep.algo.gamma=[0,1]"])
    found = list_settings(config.sweep)
    assert len(found) == len({tuple(setting.items()) for setting in found}) == 6
    assert found[1] == {"algo.actor_lr": 0.1, "algo.gamma": 1.0}
    assert list_settings({}) == [{}]


def test_a_configuration_keeps_its_sweep():
    """Configurations that were written before there were sweeps have none."""
    config = compose(["num_seeds=4", "sweep.algo.gamma=[0.9,1]", "sweep.network.sigma=[0.5]"])
    assert config.sweep == {"algo.gamma": [0.9, 1.0], "network.sigma": [0.5]}
    assert config.num_agents == 8
    assert from_dict(config.to_dict()) == config
    old = config.to_dict()
    del old["sweep"]
    assert from_dict(old).sweep == {}
