"""The command of a run, given once more, is the same run; and the page marks what its defaults are not."""

import dataclasses
import shlex

import pytest

from jaxpg.config import repeat
from jaxpg.config.parsing import compose, parse


@pytest.mark.parametrize(
    "options",
    [
        [],
        ["env=arm"],
        ["env=arm", "algo=td", "seed=3", "num_seeds=4"],
        ["num_envs=10"],  # shards and minibatches are fitted to it
        ["num_envs=10", "algo.minibatches=1", "algo.num_shards=1"],
        ["network=linear", "network.features=fourier"],
        ["network.widths=[16,8,4]", "algo.lambda_=0.123456789", "algo.actor_lr=1e-05"],
        ["env=quadratic", "algo=reinforce", "sweep.algo.gamma=[0.5,0.9]", "stop_return=-1e-3"],
        ["algo.value_clip=0.5", "algo.clip=null", "report=false", "env.physics=mujoco"],
        ["env=brax", "env.name=inverted_pendulum"],
    ],
)
def test_the_command_given_once_more_is_the_same_run(options):
    config = compose([*options, "run_dir=a folder, (with) odd=letters"])
    program, arguments = shlex.split(repeat.format_command(config))[:3], shlex.split(repeat.format_command(config))[3:]
    assert program[1:] == ["-m", "jaxpg.train"]
    again = compose(arguments)
    assert dataclasses.replace(again, run=dataclasses.replace(again.run, run_dir=config.run.run_dir)) == config
    named = [argument.partition("=")[0] for argument in arguments]
    assert "run_dir" not in named
    assert len(named) <= len(options) + 3  # no more than was given, the environment and what is fitted


@pytest.mark.parametrize("word", ["a b", "it's", "1e5", "null", "true", "[x]", "a,b", "x=y", "-", "${x}", "\u00e9", ""])
def test_any_word_is_read_as_itself(word):
    assert parse([repeat.format_argument("env.name", word)]) == {"env.name": word}


def test_defaults_are_those_of_the_same_members():
    config = compose(["env=arm", "algo=td", "algo.gamma=0.5", "env.dt=0.1"])
    defaults = repeat.compose_defaults(config)
    assert (defaults["algo"], defaults["env.dt"]) == ("td", 0.05)
    assert defaults["algo.gamma"] == compose(["env=arm", "algo=td"]).algo.gamma != 0.5
